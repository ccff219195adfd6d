"""Takes what a rover says in a MAVLink session: the half of
`bridges.mavlink.session.session.Session` that listens."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session import reports
from handfast.bridges.mavlink.session.boot_clock import BootClock
from handfast.bridges.mavlink.session.codec import Codec
from handfast.bridges.mavlink.session.identity import SessionSettings
from handfast.bridges.mavlink.session.reports import (
    AttitudeSample,
    Ekf,
    Gps,
    Participant,
    Participants,
    PositionSample,
    Status,
    Text,
    Texts,
)
from handfast.bridges.mavlink.session.requests import Commands, Parameters
from handfast.bridges.mavlink.session.streams import Streams, wanted_messages

QUEUE_MAX: Final = 256
TIMESYNC_KEPT: Final = 16
OWN_TIMES_KEPT: Final = 64
"""Own questions of the last 16 s: an echo of one is nobody else's."""
_TIME_MAX: Final = 2**62
_STAMPS: Final = 2**32


class Receiver:
    """Takes bytes; its attributes, to be read only, are what is known of the vehicle. Only messages of the
    vehicle's autopilot (component 1) change them. No bytes make any method raise.

    Attributes:
        system: the vehicle's id, 1 to 254, None until its heartbeat came. `type` MAV_TYPE, `autopilot`
            MAV_AUTOPILOT.
        firmware: its version, "" while unknown.
        problem: why it is not to be driven, as "is a quadrotor (MAV_TYPE 2), not a rover"; "" when nothing is
            known against it.
        heartbeat_ns: arrival of its last heartbeat; None: none since the (re)start of link or vehicle.
        mode: custom mode (`constants.mode_name`), None while unknown. armed: whether it may move.
        vehicle_signs: whether its last heartbeat was signed, with whatever key, though none may be known.
        epoch: grows with each restart of the connection or of the vehicle.
        clock: its boot clock against ours.
        ekf, gps, status: the last reports, None before the first.
        origin: of its EKF, None while unknown.
        heard_since_ns: arrival of its first heartbeat since the (re)start. answered_ns: of the last message
            from it that could only answer one of ours; None: none since then.
        fence_breached: whether it is beyond its own fence, as it said last.
        held_back_ns: when it last said that it holds itself back before its own fence, None: never.
        counts: what was refused or was odd, by kind.
    """

    def __init__(self, settings: SessionSettings) -> None:
        self.settings: Final = settings
        self.counts: Counter[str] = Counter()
        self.epoch = 0
        self.clock = BootClock()
        self._parameters: Final = Parameters(settings.parameters)
        self._handlers: dict[int, Callable[[int, Any], None]] = {
            dialect.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            dialect.MAVLINK_MSG_ID_ATTITUDE: self._on_attitude,
            dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._on_position,
            dialect.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._on_ekf,
            dialect.MAVLINK_MSG_ID_GPS_RAW_INT: self._on_gps,
            dialect.MAVLINK_MSG_ID_SYS_STATUS: self._on_status,
            dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._on_origin,
            dialect.MAVLINK_MSG_ID_FENCE_STATUS: self._on_fence,
            dialect.MAVLINK_MSG_ID_STATUSTEXT: self._on_text,
            dialect.MAVLINK_MSG_ID_COMMAND_ACK: self._on_ack,
            dialect.MAVLINK_MSG_ID_PARAM_VALUE: self._on_parameter,
            dialect.MAVLINK_MSG_ID_PARAM_ERROR: self._on_no_parameter,
            dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._on_version,
        }
        self._codec = Codec(self._handlers, settings.signing)
        self._codec.srcSystem = settings.system or 1
        self._codec.srcComponent = settings.component
        self._commands = Commands()
        self._streams = Streams(wanted_messages(settings.state_rate_hz))
        self._participants = Participants()
        self._positions: deque[PositionSample] = deque(maxlen=QUEUE_MAX)
        self._attitudes: deque[AttitudeSample] = deque(maxlen=QUEUE_MAX)
        self._texts: deque[Text] = deque(maxlen=QUEUE_MAX)
        self._modes: deque[tuple[int | None, bool]] = deque(maxlen=QUEUE_MAX)
        self._asked: deque[int] = deque(maxlen=TIMESYNC_KEPT)
        self._own_times: deque[int] = deque(maxlen=OWN_TIMES_KEPT)
        self._replies: deque[int] = deque(maxlen=4)
        self._due: dict[str, int] = {}
        self._forget_identity()
        self._forget_vehicle()

    def _forget_identity(self) -> None:
        self.system: int | None = None
        self.type = 0
        self.autopilot = 0
        self.problem = ""

    def _forget_vehicle(self) -> None:
        """Drops what a vehicle that has begun anew no longer is, or has forgotten."""
        self.heartbeat_ns: int | None = None
        self.mode: int | None = None
        self.armed = False
        self.vehicle_signs = False
        self.firmware = ""
        self.ekf: Ekf | None = None
        self.gps: Gps | None = None
        self.status: Status | None = None
        self.origin: Geodetic | None = None
        self.heard_since_ns: int | None = None
        self.answered_ns: int | None = None
        self.held_back_ns: int | None = None
        self.fence_breached = False
        self._parameters.restart()
        self._commands.restart()
        self._streams.restart()
        self._positions.clear()
        self._attitudes.clear()
        self._stamps: dict[int, int] = {}
        self._text_parts = Texts()
        self._due = {name: sent_ns for name, sent_ns in self._due.items() if name == "heartbeat"}

    def restart(self) -> None:
        """The connection was opened (again): nothing is believed before a fresh heartbeat."""
        self.epoch += 1
        self.clock = BootClock()
        self._asked.clear()
        self._replies.clear()
        self._codec.forget()
        self._participants.clear()
        self._forget_identity()
        self._forget_vehicle()
        self._due.clear()

    @property
    def own(self) -> tuple[int, int]:
        """The system and component as which we speak."""
        return self._codec.srcSystem, self._codec.srcComponent

    def receive(self, arrival_ns: int, data: bytes) -> None:
        """Takes bytes and when they came."""
        for message in self._codec.parse(data):
            header = message.get_header()
            number = header.msgId
            handler = self._handlers.get(number)
            if handler is None:
                if number == dialect.MAVLINK_MSG_ID_BAD_DATA:
                    self.counts["bad data"] += 1
                continue
            sender = header.srcSystem, header.srcComponent
            if number == dialect.MAVLINK_MSG_ID_HEARTBEAT:
                self._on_any_heartbeat(arrival_ns, message, sender)
            elif number == dialect.MAVLINK_MSG_ID_TIMESYNC and not message.tc1:
                self._on_time_asked(arrival_ns, message, sender)
                continue
            if sender == (self.system, constants.COMPONENT_AUTOPILOT):
                self._streams.heard(number, arrival_ns)
                handler(arrival_ns, message)

    def _on_time_asked(self, arrival_ns: int, message: Any, sender: tuple[int, int]) -> None:
        """ArduPilot passes no heartbeat on to a port where it has heard its sender's identity, but this it
        does: so a twin with its own way to the vehicle is found.
        """
        if sender == (self.system, constants.COMPONENT_AUTOPILOT):
            self._replies.append(message.ts1)
        elif sender == self.own and self.system is not None and message.ts1 not in self._own_times:
            twin = Participant(*sender, constants.TYPE_ONBOARD_CONTROLLER, arrival_ns)
            self._participants.heard(twin, vehicle=False)

    def _on_any_heartbeat(self, arrival_ns: int, message: Any, sender: tuple[int, int]) -> None:
        system, component = sender
        autopilot = (
            component == constants.COMPONENT_AUTOPILOT
            and message.autopilot != constants.AUTOPILOT_INVALID
            and message.type != constants.TYPE_GCS
        )
        meant = self.settings.system in (None, system) and 1 <= system < constants.SYSTEM_GROUND_STATION
        if autopilot and self.system is None and meant:
            self.system = system
            self._codec.srcSystem = system
        if autopilot and system == self.system:
            return
        token = self.settings.token
        if sender == self.own and token and message.custom_mode == token:
            return  # an echo
        self._participants.heard(Participant(system, component, message.type, arrival_ns), vehicle=autopilot)

    def _on_heartbeat(self, arrival_ns: int, message: Any) -> None:
        if message.autopilot == constants.AUTOPILOT_INVALID or message.type == constants.TYPE_GCS:
            return
        self.type, self.autopilot = message.type, message.autopilot
        self.problem = _problem(message.type, message.autopilot)
        self.heartbeat_ns = arrival_ns
        if self.heard_since_ns is None:
            self.heard_since_ns = arrival_ns
        mode = message.custom_mode if message.base_mode & constants.FLAG_CUSTOM_MODE else None
        self._stands(mode, bool(message.base_mode & constants.FLAG_ARMED))
        self.vehicle_signs = bool(message.get_header().incompat_flags & dialect.MAVLINK_IFLAG_SIGNED)

    def _stands(self, mode: int | None, armed: bool) -> None:
        """It is in that mode, and armed or not."""
        if mode != self.mode:
            self._commands.no_more(constants.CMD_DO_SET_MODE)
        if armed != self.armed or (mode != self.mode and mode != constants.MODE_GUIDED):
            self._commands.no_more(constants.CMD_COMPONENT_ARM_DISARM)
        self.mode, self.armed = mode, armed
        if not self._modes or self._modes[-1] != (mode, armed):
            self._modes.append((mode, armed))

    def _valid_ns(self, message: Any, arrival_ns: int) -> int | None:
        """The wall time of a message with a stamp; None for one that is not newer than the last."""
        clock, number, stamp_ms = self.clock, message.get_msgId(), message.time_boot_ms
        reboots = clock.reboots
        valid_ns = clock.take(stamp_ms, arrival_ns)
        if clock.reboots != reboots:
            self._rebooted()
        # The stamp wraps every 49.7 days: what is behind by less than half of that is late.
        if (self._stamps.get(number, stamp_ms - 1) - stamp_ms) % _STAMPS < _STAMPS // 2:
            self.counts["out of order"] += 1
            return None
        self._stamps[number] = stamp_ms
        return valid_ns

    def _rebooted(self) -> None:
        self.epoch += 1
        self._forget_vehicle()

    def _on_position(self, arrival_ns: int, message: Any) -> None:
        valid_ns = self._valid_ns(message, arrival_ns)
        if valid_ns is not None:
            sample = reports.position_sample(message, valid_ns, arrival_ns)
            if sample is None:
                self.counts["not finite"] += 1
            else:
                self._positions.append(sample)

    def _on_attitude(self, arrival_ns: int, message: Any) -> None:
        valid_ns = self._valid_ns(message, arrival_ns)
        if valid_ns is not None:
            sample = reports.attitude_sample(message, valid_ns, arrival_ns)
            if sample is None:
                self.counts["not finite"] += 1
            else:
                self._attitudes.append(sample)

    def _on_timesync(self, arrival_ns: int, message: Any) -> None:
        if message.ts1 in self._asked and 0 < message.tc1 < _TIME_MAX:
            self._asked.remove(message.ts1)
            reboots = self.clock.reboots
            self.clock.exchange(message.ts1, message.tc1, arrival_ns)
            if self.clock.reboots != reboots:
                self._rebooted()
            self.answered_ns = arrival_ns

    def _on_ekf(self, arrival_ns: int, message: Any) -> None:
        self.ekf = reports.ekf(message, arrival_ns)

    def _on_gps(self, arrival_ns: int, message: Any) -> None:
        self.gps = reports.gps(message, arrival_ns)

    def _on_status(self, arrival_ns: int, message: Any) -> None:
        self.status = reports.status(message, arrival_ns)

    def _on_fence(self, arrival_ns: int, message: Any) -> None:
        if reports.held_back(message):
            self.held_back_ns = arrival_ns
        self.fence_breached = bool(message.breach_status)

    def _on_origin(self, _arrival_ns: int, message: Any) -> None:
        origin = reports.origin(message)
        if origin is None:
            self.counts["no place"] += 1
        else:
            self.origin = origin

    def _on_text(self, arrival_ns: int, message: Any) -> None:
        texts = self._text_parts.take(message, arrival_ns)
        self._texts.extend(texts)
        if self.armed and any(text.text == constants.DISARMED_TEXT for text in texts):
            self._stands(self.mode, False)  # armed again at once, no heartbeat would have told

    def _on_ack(self, arrival_ns: int, message: Any) -> None:
        system, component = self.own
        ours = message.target_system in (0, system) and message.target_component in (0, component)
        if ours and self._commands.answered(arrival_ns, message.command, message.result):
            self.answered_ns = arrival_ns

    def _on_parameter(self, _arrival_ns: int, message: Any) -> None:
        if not self._parameters.received(message.param_id, message.param_value):
            self.counts["not finite"] += 1

    def _on_no_parameter(self, arrival_ns: int, message: Any) -> None:
        if (message.target_system, message.target_component) == self.own:
            self.answered_ns = arrival_ns
            self._parameters.missing(message.param_id)

    def _on_version(self, _arrival_ns: int, message: Any) -> None:
        self.firmware = reports.firmware(message)


def _problem(kind: int, autopilot: int) -> str:
    if kind not in constants.ROVER_TYPES:
        name = constants.TYPE_NAMES.get(kind, "vehicle of another kind")
        return f"is a {name} (MAV_TYPE {kind}), not a rover"
    if autopilot != constants.AUTOPILOT_ARDUPILOT:
        name = "PX4" if autopilot == constants.AUTOPILOT_PX4 else "another autopilot"
        return f"runs {name} (MAV_AUTOPILOT {autopilot}), not ArduPilot"
    return ""
