"""The MAVLink protocol of a simulated rover, one boot long: commands, answers, and what it says unasked."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.simulator.guided import (
    NotFinite,
    PositionTarget,
    of_attitude_target,
    of_position_target,
)
from handfast.bridges.mavlink.simulator.settings import SettingsError, type_of
from handfast.bridges.mavlink.simulator.telemetry import BUILDERS, Message, Port, heartbeat
from handfast.bridges.mavlink.simulator.vehicle import CRITICAL, INFO, WARNING, Vehicle

SET_MODE: Final = mavlink.MAVLINK_MSG_ID_SET_MODE
"""What ArduPilot acknowledges a SET_MODE as, although it is a message and not a command."""
FORCES_ARMING: Final = frozenset({constants.FORCE_ARM, 2989})
"""The standard's number, and the one that ArduPilot has for arming."""


@dataclass(frozen=True, slots=True)
class Context:
    """Of one command: the vehicle, the port that it came by, a way to answer there, and the time."""

    vehicle: Vehicle
    port: Port
    answer: Callable[[Message | None], None]
    now_ns: int


def set_mode(vehicle: Vehicle, base_mode: int, custom_mode: int) -> int:
    """MAV_RESULT of a request for a mode."""
    if not base_mode & constants.FLAG_CUSTOM_MODE:
        return constants.RESULT_DENIED
    return constants.RESULT_ACCEPTED if vehicle.set_mode(custom_mode) else constants.RESULT_FAILED


def _whole(value: float) -> int:
    """A parameter that is a number of something; -1 for one that is none."""
    return round(value) if isfinite(value) else -1


def _mode(context: Context, parameters: Sequence[float]) -> int:
    return set_mode(context.vehicle, max(0, _whole(parameters[0])), _whole(parameters[1]))


def _arm(context: Context, parameters: Sequence[float]) -> int:
    wish = _whole(parameters[0])
    if wish == 1:
        armed = context.vehicle.arm(forced=_whole(parameters[1]) in FORCES_ARMING)
        return constants.RESULT_ACCEPTED if armed else constants.RESULT_FAILED
    if wish == 0:
        context.vehicle.disarm()
        return constants.RESULT_ACCEPTED
    return constants.RESULT_UNSUPPORTED


def _check(context: Context, _parameters: Sequence[float]) -> int:
    vehicle = context.vehicle
    if vehicle.armed:
        return constants.RESULT_TEMPORARILY_REJECTED
    if why := vehicle.arming_refused():
        vehicle.say(CRITICAL, f"PreArm: {why}")
    return constants.RESULT_ACCEPTED


def _reboot(context: Context, parameters: Sequence[float]) -> int:
    if _whole(parameters[0]) not in (1, 3):
        return constants.RESULT_UNSUPPORTED
    return constants.RESULT_FAILED if context.vehicle.armed else constants.RESULT_ACCEPTED


def _home(context: Context, _parameters: Sequence[float]) -> int:
    context.answer(BUILDERS[constants.MESSAGE_HOME_POSITION](context.vehicle, context.now_ns))
    return constants.RESULT_ACCEPTED if context.vehicle.navigation.ready else constants.RESULT_FAILED


def _message(context: Context, parameters: Sequence[float]) -> int:
    build = BUILDERS.get(_whole(parameters[0]))
    if build is None:
        return constants.RESULT_FAILED
    context.answer(build(context.vehicle, context.now_ns))
    return constants.RESULT_ACCEPTED


def _no_such_message(vehicle: Vehicle, message: int) -> int:
    vehicle.say(INFO, f"No ap_message for mavlink id ({message})")
    return constants.RESULT_DENIED


def _set_interval(context: Context, parameters: Sequence[float]) -> int:
    message = _whole(parameters[0])
    vehicle, port = context.vehicle, context.port
    if message not in BUILDERS:
        return _no_such_message(vehicle, message)
    asked_us = _whole(parameters[1])
    if asked_us in (-1, 0):
        port.set_interval(message, 0 if asked_us == -1 else -1, context.now_ns)
        return constants.RESULT_ACCEPTED
    asked_ms = max(1, asked_us // 1000)
    fastest_hz = constants.STREAM_RATE_PART * vehicle.parameters["SCHED_LOOP_RATE"]
    if asked_us < 0 or asked_ms * fastest_hz < 1000.0:
        return constants.RESULT_DENIED
    port.set_interval(message, asked_ms * 1_000_000, context.now_ns)
    return constants.RESULT_ACCEPTED


def _get_interval(context: Context, parameters: Sequence[float]) -> int:
    message = _whole(parameters[0])
    interval_ns = context.port.interval_ns(message)
    if interval_ns is None:
        return _no_such_message(context.vehicle, message)
    context.answer(mavlink.MAVLink_message_interval_message(message, interval_ns // 1000 or -1))
    return constants.RESULT_ACCEPTED


COMMANDS: Final[Mapping[int, Callable[[Context, Sequence[float]], int]]] = {
    constants.CMD_DO_SET_MODE: _mode,
    constants.CMD_COMPONENT_ARM_DISARM: _arm,
    constants.CMD_RUN_PREARM_CHECKS: _check,
    constants.CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    constants.CMD_GET_HOME_POSITION: _home,
    constants.CMD_GET_MESSAGE_INTERVAL: _get_interval,
    constants.CMD_SET_MESSAGE_INTERVAL: _set_interval,
    constants.CMD_REQUEST_MESSAGE: _message,
}
"""By their number: from the first three parameters to MAV_RESULT."""


PARAMETERS_PER_LOOP: Final = 2
TIMESYNC_PERIOD_NS: Final = 10 * NS_PER_S
NO_SUCH_PARAMETER: Final = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
HEARD_MAX: Final = 500
"""Messages that wait for the next loop; what comes on top is lost, as in a full buffer."""


class Protocol:
    """The MAVLink side of one vehicle from one boot on.

    Args:
        ready_ns: when it begins to stream.
        key: for signing, or empty.

    Attributes: `out`: port and bytes of what is to be sent; `key`: for signing, as it was set last; `log`:
    for people; `reboot_asked`.
    """

    def __init__(self, vehicle: Vehicle, ready_ns: int, key: bytes) -> None:
        settings = vehicle.settings
        self.out: list[tuple[int, bytes]] = []
        self.log: list[str] = []
        self.key = key
        self.reboot_asked = False
        self._vehicle = vehicle
        self._ports = [
            Port(number, vehicle.system, ready_ns, settings.seed, vehicle.system, vehicle.boots)
            for number in range(settings.ports)
        ]
        for port in self._ports:
            port.sign(key, 0)
        self._heard: deque[tuple[int, Port, Message]] = deque()
        self._timesync_ns = ready_ns + TIMESYNC_PERIOD_NS
        self._origin_said = vehicle.navigation.origin is not None
        self._open: Sequence[bool] = [True] * settings.ports
        self._handlers: dict[int, Callable[[Port, Message, int], None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            mavlink.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: self._on_parameter_read,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: self._on_parameter_list,
            mavlink.MAVLINK_MSG_ID_PARAM_SET: self._on_parameter_set,
            mavlink.MAVLINK_MSG_ID_SET_GPS_GLOBAL_ORIGIN: self._on_origin,
            mavlink.MAVLINK_MSG_ID_COMMAND_INT: self._on_command,
            mavlink.MAVLINK_MSG_ID_COMMAND_LONG: self._on_command,
            mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: self._on_position_target,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            mavlink.MAVLINK_MSG_ID_SETUP_SIGNING: self._on_setup_signing,
        }

    def receive(self, port: int, data: bytes, now_ns: int) -> None:
        """Bytes that arrived at a port; their messages wait for the next loop."""
        at = self._ports[port]
        for message in at.read(data, now_ns):
            if len(self._heard) < HEARD_MAX:
                self._heard.append((now_ns, at, message))

    def serve(self, now_ns: int, opened: Sequence[bool]) -> None:
        """The first half of a loop: answers what was heard, streams what is due.

        Args:
            opened: for each port whether anybody is there.
        """
        self._open = opened
        while self._heard and self._heard[0][0] <= now_ns:
            _, port, message = self._heard.popleft()
            if self._accepted(message):
                handler = self._handlers.get(message.get_msgId())
                if handler is not None:
                    handler(port, message, now_ns)
            if self._vehicle.crashed or self.reboot_asked:
                return
        for port in self._ports:
            self._stream(port, now_ns)

    def announce(self, now_ns: int) -> None:
        """The second half, after the vehicle's step: what it says at once, to everybody."""
        vehicle = self._vehicle
        for severity, text in vehicle.texts:
            self.log.append(text)
            self._send_all(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]), now_ns)
        vehicle.texts.clear()
        if vehicle.changed:
            # Only a mode is said at once. Arming and failsafes wait for the heartbeat that is due anyway.
            vehicle.changed = False
            self.log.append(
                f"{constants.mode_name(vehicle.mode)}, {'armed' if vehicle.armed else 'disarmed'}"
            )
            self._send_all(heartbeat(vehicle, now_ns), now_ns)
        if vehicle.navigation.origin is not None and not self._origin_said:
            self._origin_said = True
            self._send_all(BUILDERS[constants.MESSAGE_GPS_GLOBAL_ORIGIN](vehicle, now_ns), now_ns)
        if now_ns >= self._timesync_ns:
            # It asks for the time itself, too: whoever takes that for an answer gets it wrong.
            self._timesync_ns = now_ns + TIMESYNC_PERIOD_NS
            self._send_all(mavlink.MAVLink_timesync_message(0, now_ns - vehicle.boot_ns), now_ns)

    def _stream(self, port: Port, now_ns: int) -> None:
        due = port.due(now_ns)
        if not self._open[port.number]:
            return
        for id_ in due:
            self._send(port, BUILDERS[id_](self._vehicle, now_ns), now_ns)
        if port.next_parameter is not None:
            names = self._vehicle.parameters.names
            upto = min(port.next_parameter + PARAMETERS_PER_LOOP, len(names))
            for name in names[port.next_parameter : upto]:
                self._send(port, self._parameter(name), now_ns)
            port.next_parameter = upto if upto < len(names) else None

    def _send(self, port: Port, message: Message | None, now_ns: int) -> None:
        if message is not None and self._open[port.number]:
            self.out.append((port.number, port.pack(message, now_ns)))

    def _send_all(self, message: Message | None, now_ns: int) -> None:
        for port in self._ports:
            self._send(port, message, now_ns)

    def _accepted(self, message: Message) -> bool:
        """Whether it is addressed to this vehicle, or to everybody, by a system that it obeys."""
        # SET_MODE has a system but no component; what is for everybody has neither.
        if getattr(message, "target_system", 0) not in (0, self._vehicle.system):
            return False
        if getattr(message, "target_component", 0) not in (0, constants.COMPONENT_AUTOPILOT):
            return False
        parameters = self._vehicle.parameters
        if not int(parameters["SYSID_ENFORCE"]) & constants.OPTION_ENFORCE:
            return True
        return message.get_srcSystem() in (round(parameters["SYSID_MYGCS"]), self._vehicle.system)

    def _on_heartbeat(self, _port: Port, message: Message, now_ns: int) -> None:
        if message.get_srcSystem() == round(self._vehicle.parameters["SYSID_MYGCS"]):
            self._vehicle.ground_station_ns = now_ns

    def _acknowledge(self, port: Port, message: Message, command: int, result: int, now_ns: int) -> None:
        ack = mavlink.MAVLink_command_ack_message(
            command,
            result,
            target_system=message.get_srcSystem(),
            target_component=message.get_srcComponent(),
        )
        self._send(port, ack, now_ns)

    def _on_set_mode(self, port: Port, message: Message, now_ns: int) -> None:
        result = set_mode(self._vehicle, message.base_mode, message.custom_mode)
        self._acknowledge(port, message, SET_MODE, result, now_ns)

    def _on_command(self, port: Port, message: Message, now_ns: int) -> None:
        command = COMMANDS.get(message.command)
        result = constants.RESULT_UNSUPPORTED
        if command is not None:

            def answer(reply: Message | None) -> None:
                self._send(port, reply, now_ns)

            context = Context(self._vehicle, port, answer, now_ns)
            result = command(context, [message.param1, message.param2, message.param3])
        self._acknowledge(port, message, message.command, result, now_ns)
        if message.command == constants.CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            self.reboot_asked = result == constants.RESULT_ACCEPTED

    def _parameter(self, name: str) -> Message:
        parameters = self._vehicle.parameters
        names = parameters.names
        return mavlink.MAVLink_param_value_message(
            name.encode(), parameters[name], type_of(name), len(names), names.index(name)
        )

    def _on_parameter_read(self, port: Port, message: Message, now_ns: int) -> None:
        names = self._vehicle.parameters.names
        name = message.param_id
        if message.param_index >= 0:
            if message.param_index >= len(names):
                return
            name = names[message.param_index]
        if name in self._vehicle.parameters:
            self._send(port, self._parameter(name), now_ns)
        elif self._vehicle.settings.new_names:
            asker = message.get_srcSystem(), message.get_srcComponent()
            error = mavlink.MAVLink_param_error_message(*asker, name.encode(), -1, NO_SUCH_PARAMETER)
            self._send(port, error, now_ns)

    def _on_parameter_list(self, port: Port, _message: Message, _now_ns: int) -> None:
        port.next_parameter = 0

    def _on_parameter_set(self, _port: Port, message: Message, now_ns: int) -> None:
        name = message.param_id
        if name not in self._vehicle.parameters:
            return
        # A value that it cannot have is answered with the one that it keeps.
        with suppress(SettingsError):
            self._vehicle.parameters.set(name, message.param_value)
        self._send_all(self._parameter(name), now_ns)

    def _on_origin(self, _port: Port, message: Message, _now_ns: int) -> None:
        latitude, longitude = message.latitude * 1e-7, message.longitude * 1e-7
        if abs(latitude) <= 90.0 and abs(longitude) <= 180.0:
            self._vehicle.navigation.set_origin(Geodetic(latitude, longitude, message.altitude * 1e-3))

    def _on_position_target(self, _port: Port, message: Message, now_ns: int) -> None:
        vehicle = self._vehicle
        if not vehicle.takes_setpoints:
            return
        asked = PositionTarget(
            message.coordinate_frame,
            message.type_mask,
            message.x,
            message.y,
            message.vx,
            message.vy,
            message.yaw,
            message.yaw_rate,
        )
        try:
            target = of_position_target(asked, vehicle.pose, vehicle.parameters["WP_SPEED"])
        except NotFinite as error:
            vehicle.crash(str(error))
            return
        if target is not None:
            vehicle.guided.take(target, now_ns)

    def _on_attitude_target(self, _port: Port, message: Message, now_ns: int) -> None:
        vehicle = self._vehicle
        if not vehicle.takes_setpoints:
            return
        q0, q1, q2, q3 = message.q
        try:
            target = of_attitude_target(
                message.type_mask,
                (q0, q1, q2, q3),
                message.body_yaw_rate,
                message.thrust,
                vehicle.parameters["WP_SPEED"],
            )
        except NotFinite as error:
            vehicle.crash(str(error))
            return
        if target is not None:
            vehicle.guided.take(target, now_ns)

    def _on_timesync(self, port: Port, message: Message, now_ns: int) -> None:
        if message.tc1 == 0:
            reply = mavlink.MAVLink_timesync_message(now_ns - self._vehicle.boot_ns, message.ts1)
            self._send(port, reply, now_ns)

    def _on_setup_signing(self, _port: Port, message: Message, _now_ns: int) -> None:
        if self._vehicle.armed:
            self._vehicle.say(WARNING, "ERROR: Won't setup signing when armed")
            return
        key = bytes(message.secret_key)
        self.key = key if any(key) or message.initial_timestamp else b""
        self.log.append("signs from now on" if self.key else "signs no more")
        for port in self._ports:
            port.sign(self.key, message.initial_timestamp)
