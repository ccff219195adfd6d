"""The MAVLink protocol of a simulated rover, one boot long: what it answers, and what it says unasked."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.simulator.commands import COMMANDS, SET_MODE, Context, set_mode
from handfast.bridges.mavlink.simulator.guided import (
    NotFinite,
    PositionTarget,
    of_attitude_target,
    of_position_target,
)
from handfast.bridges.mavlink.simulator.port import Port
from handfast.bridges.mavlink.simulator.settings import SettingsError, type_of
from handfast.bridges.mavlink.simulator.telemetry import BUILDERS, Message, heartbeat
from handfast.bridges.mavlink.simulator.vehicle import WARNING, Vehicle

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
