"""Telemetry of a simulated rover: its fields in MAVLink's units, and the streams of each of its ports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, degrees, sin
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.random_streams import stream, uniform
from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.identity import timestamp_at
from handfast.bridges.mavlink.simulator.vehicle import Vehicle

MANUAL_MODES: Final = frozenset(
    {constants.MODE_MANUAL, constants.MODE_ACRO, constants.MODE_STEERING, constants.MODE_SIMPLE}
)
NOT_AUTOPILOT: Final = MANUAL_MODES | {constants.MODE_HOLD, constants.MODE_INITIALISING}
SENSORS: Final = constants.SENSOR_GPS | constants.SENSOR_AHRS | constants.SENSOR_PREARM_CHECK
CAPABILITIES: Final = (
    mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
EMPTY_BATTERY_V: Final = 10.5
FULL_BATTERY_V: Final = 12.6
NO_CELL: Final = 65535

Message = Any
"""A pymavlink message; the library has no types."""


def heartbeat(vehicle: Vehicle, _now_ns: int) -> Message:
    """Mode, arming and state."""
    mode = vehicle.mode
    base = constants.FLAG_CUSTOM_MODE
    if mode in MANUAL_MODES:
        base |= constants.FLAG_MANUAL_INPUT
    if mode not in NOT_AUTOPILOT:
        base |= constants.FLAG_GUIDED
    if vehicle.armed:
        base |= constants.FLAG_ARMED
    if vehicle.failsafe or vehicle.ekf_failsafe:
        state = constants.STATE_CRITICAL
    else:
        state = constants.STATE_STANDBY if mode == constants.MODE_HOLD else constants.STATE_ACTIVE
    settings = vehicle.settings
    return mavlink.MAVLink_heartbeat_message(settings.vehicle_type, settings.autopilot, base, mode, state, 3)


def _boot_ms(vehicle: Vehicle, now_ns: int) -> int:
    return (now_ns - vehicle.boot_ns) // 1_000_000 & 0xFFFFFFFF


def _attitude(vehicle: Vehicle, now_ns: int) -> Message:
    navigation = vehicle.navigation
    return mavlink.MAVLink_attitude_message(
        _boot_ms(vehicle, now_ns), 0.0, 0.0, navigation.yaw, 0.0, 0.0, navigation.yaw_rate
    )


def _local_position(vehicle: Vehicle, now_ns: int) -> Message | None:
    navigation = vehicle.navigation
    if navigation.origin is None:
        return None
    return mavlink.MAVLink_local_position_ned_message(
        _boot_ms(vehicle, now_ns),
        navigation.north,
        navigation.east,
        0.0,
        navigation.v_north,
        navigation.v_east,
        0.0,
    )


def _e7(place: Geodetic) -> tuple[int, int]:
    return round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)


def _global_position(vehicle: Vehicle, now_ns: int) -> Message:
    navigation = vehicle.navigation
    return mavlink.MAVLink_global_position_int_message(
        _boot_ms(vehicle, now_ns),
        *((0, 0) if navigation.origin is None else _e7(navigation.place)),
        round(navigation.place.altitude_m * 1e3),
        0,
        round(navigation.v_north * 100.0),
        round(navigation.v_east * 100.0),
        0,
        round(degrees(navigation.yaw) * 100.0) % 36000,
    )


def _gps(vehicle: Vehicle, now_ns: int) -> Message:
    navigation, truth = vehicle.navigation, vehicle.truth
    fixed = navigation.fix >= constants.GPS_3D_FIX
    course = degrees(truth.yaw) + (180.0 if truth.speed < 0.0 else 0.0)
    return mavlink.MAVLink_gps_raw_int_message(
        (now_ns - vehicle.boot_ns) // 1000,
        navigation.fix,
        *(_e7(navigation.place) if fixed else (0, 0)),
        round(navigation.place.altitude_m * 1e3) if fixed else 0,
        121 if fixed else 9999,
        200 if fixed else 9999,
        round(abs(truth.speed) * 100.0),
        round(course * 100.0) % 36000,
        navigation.satellites,
    )


def _ekf(vehicle: Vehicle, _now_ns: int) -> Message:
    navigation = vehicle.navigation
    velocity, position, compass = navigation.variances
    if not navigation.ready:
        velocity = position = 0.0
    return mavlink.MAVLink_ekf_status_report_message(
        navigation.flags, velocity, position, 0.01, compass, 0.0, 0.0
    )


def _fence(vehicle: Vehicle, now_ns: int) -> Message | None:
    if not vehicle.parameters[constants.FENCE_ENABLE]:
        return None
    fence = vehicle.fence
    breach = mavlink.FENCE_BREACH_BOUNDARY if fence.breached else mavlink.FENCE_BREACH_NONE
    held = constants.MITIGATE_SPEED if fence.limits(now_ns) else constants.MITIGATE_NONE
    return mavlink.MAVLink_fence_status_message(int(fence.breached), fence.breaches, breach, 0, held)


def _charge(vehicle: Vehicle) -> int:
    share = (vehicle.parameters["SIM_BATT_VOLTAGE"] - EMPTY_BATTERY_V) / (FULL_BATTERY_V - EMPTY_BATTERY_V)
    return round(100.0 * min(1.0, max(0.0, share)))


def _system(vehicle: Vehicle, _now_ns: int) -> Message:
    health = SENSORS
    if vehicle.navigation.fix < constants.GPS_3D_FIX:
        health &= ~constants.SENSOR_GPS
    if not vehicle.navigation.ready:
        health &= ~constants.SENSOR_AHRS
    if not vehicle.armed and vehicle.arming_refused():
        health &= ~constants.SENSOR_PREARM_CHECK
    voltage = round(vehicle.parameters["SIM_BATT_VOLTAGE"] * 1e3)
    return mavlink.MAVLink_sys_status_message(
        SENSORS, SENSORS, health, 120, voltage, 250, _charge(vehicle), 0, 0, 0, 0, 0, 0
    )


def _battery(vehicle: Vehicle, _now_ns: int) -> Message:
    voltage = round(vehicle.parameters["SIM_BATT_VOLTAGE"] * 1e3)
    cells = [voltage] + [NO_CELL] * 9
    return mavlink.MAVLink_battery_status_message(
        0,
        mavlink.MAV_BATTERY_FUNCTION_UNKNOWN,
        mavlink.MAV_BATTERY_TYPE_UNKNOWN,
        32767,
        cells,
        250,
        0,
        0,
        _charge(vehicle),
    )


def _system_time(vehicle: Vehicle, now_ns: int) -> Message:
    unix = now_ns // 1000 if vehicle.navigation.fix >= constants.GPS_3D_FIX else 0
    return mavlink.MAVLink_system_time_message(unix, _boot_ms(vehicle, now_ns))


def _origin(vehicle: Vehicle, now_ns: int) -> Message | None:
    origin = vehicle.navigation.origin
    if origin is None:
        return None
    altitude = round(origin.altitude_m * 1e3)
    return mavlink.MAVLink_gps_global_origin_message(
        *_e7(origin), altitude, (now_ns - vehicle.boot_ns) // 1000
    )


def _home(vehicle: Vehicle, now_ns: int) -> Message | None:
    if not vehicle.navigation.ready:
        return None
    home = vehicle.settings.home
    return mavlink.MAVLink_home_position_message(
        *_e7(home),
        round(home.altitude_m * 1e3),
        vehicle.navigation.north,
        vehicle.navigation.east,
        0.0,
        [cos(0.5 * vehicle.settings.yaw), 0.0, 0.0, sin(0.5 * vehicle.settings.yaw)],
        0.0,
        0.0,
        0.0,
        (now_ns - vehicle.boot_ns) // 1000,
    )


def _version(vehicle: Vehicle, _now_ns: int) -> Message:
    major, minor, patch = vehicle.settings.firmware
    version = major << 24 | minor << 16 | patch << 8
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES, version, 0, 0, 0, list(b"handfast"), [0] * 8, [0] * 8, 0, 0, vehicle.system
    )


BUILDERS: Final[Mapping[int, Callable[[Vehicle, int], Message | None]]] = {
    constants.MESSAGE_HEARTBEAT: heartbeat,
    constants.MESSAGE_SYS_STATUS: _system,
    constants.MESSAGE_SYSTEM_TIME: _system_time,
    constants.MESSAGE_GPS_RAW_INT: _gps,
    constants.MESSAGE_ATTITUDE: _attitude,
    constants.MESSAGE_LOCAL_POSITION_NED: _local_position,
    constants.MESSAGE_GLOBAL_POSITION_INT: _global_position,
    constants.MESSAGE_GPS_GLOBAL_ORIGIN: _origin,
    constants.MESSAGE_BATTERY_STATUS: _battery,
    constants.MESSAGE_AUTOPILOT_VERSION: _version,
    constants.MESSAGE_EKF_STATUS_REPORT: _ekf,
    constants.MESSAGE_HOME_POSITION: _home,
    constants.MESSAGE_FENCE_STATUS: _fence,
}
"""All that can be asked for by its id. None: it has nothing to say yet, and sends nothing."""
DEFAULT_STREAMS: Final = (
    constants.MESSAGE_HEARTBEAT,
    constants.MESSAGE_SYS_STATUS,
    constants.MESSAGE_SYSTEM_TIME,
    constants.MESSAGE_GPS_RAW_INT,
    constants.MESSAGE_ATTITUDE,
    constants.MESSAGE_LOCAL_POSITION_NED,
    constants.MESSAGE_GLOBAL_POSITION_INT,
    constants.MESSAGE_BATTERY_STATUS,
    constants.MESSAGE_EKF_STATUS_REPORT,
)
"""What is sent at 1 Hz by itself."""


DEFAULT_INTERVAL_NS: Final = round(NS_PER_S / constants.STREAM_RATE_HZ)
LATE: Final = 0.02
"""Share of the streamed messages that a busy autopilot sends a loop late."""
PARAMETER_LIST_SLOWS: Final = 4
"""By this factor streams are slower while a list of parameters is sent."""
UNSIGNED_ALWAYS: Final = frozenset({mavlink.MAVLINK_MSG_ID_RADIO, mavlink.MAVLINK_MSG_ID_RADIO_STATUS})


class _Stream:
    __slots__ = ("due_ns", "interval_ns", "late")

    def __init__(self, interval_ns: int, due_ns: int) -> None:
        self.interval_ns, self.due_ns = interval_ns, due_ns
        self.late = False


class Port:
    """One port from one boot on.

    Args:
        number: 0 is the first serial port, which takes unsigned messages even when there is a key.
        now_ns: its streams start within a second of this.
        key: names its draws.

    Attributes: `next_parameter`: how far the list of parameters that was asked for has come, or None.
    """

    def __init__(self, number: int, system: int, now_ns: int, *key: int | str) -> None:
        self.number = number
        self._mav = mavlink.MAVLink(None, system, constants.COMPONENT_AUTOPILOT)
        self._mav.robust_parsing = True
        self._draws = stream("rover port", number, *key)
        self._drawn = 0
        step = DEFAULT_INTERVAL_NS // len(DEFAULT_STREAMS)
        self._streams = {
            message: _Stream(DEFAULT_INTERVAL_NS, now_ns + step * k)
            for k, message in enumerate(DEFAULT_STREAMS)
        }
        self.next_parameter: int | None = None

    def sign(self, key: bytes, timestamp: int) -> None:
        """Signs with `key` (32 bytes) and takes what is signed with it; an empty one ends that."""
        signing = self._mav.signing
        signing.secret_key = key or None
        signing.sign_outgoing = bool(key)
        signing.link_id = self.number
        signing.timestamp = max(signing.timestamp, timestamp)
        first = self.number == 0
        signing.allow_unsigned_callback = lambda _mav, message: first or message in UNSIGNED_ALWAYS

    def read(self, data: bytes, now_ns: int) -> list[Message]:
        """The messages that these bytes complete. Garbage, and what signing refuses, is left out."""
        self._set_signing_time(now_ns)
        messages: list[Any] = self._mav.parse_buffer(data) or []
        return [m for m in messages if m.get_msgId() >= 0 and not isinstance(m, mavlink.MAVLink_unknown)]

    def pack(self, message: Message, now_ns: int) -> bytes:
        """The bytes of a message of the vehicle's own."""
        self._set_signing_time(now_ns)
        data: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) & 0xFF
        return data

    def _set_signing_time(self, now_ns: int) -> None:
        signing = self._mav.signing
        if signing.secret_key is not None:
            signing.timestamp = max(signing.timestamp, timestamp_at(now_ns))

    def interval_ns(self, message: int) -> int | None:
        """How often a message is sent; 0: not at all; None: it is not one of this vehicle's."""
        if message not in BUILDERS:
            return None
        found = self._streams.get(message)
        return 0 if found is None else found.interval_ns

    def set_interval(self, message: int, interval_ns: int, now_ns: int) -> None:
        """Streams a message every `interval_ns`; 0 ends that, less than 0 brings its default back."""
        if interval_ns < 0:
            interval_ns = DEFAULT_INTERVAL_NS if message in DEFAULT_STREAMS else 0
        if interval_ns:
            self._streams[message] = _Stream(interval_ns, now_ns + interval_ns)
        else:
            self._streams.pop(message, None)

    def due(self, now_ns: int) -> list[int]:
        """Ids of the messages to send in this loop."""
        slow = 1 if self.next_parameter is None else PARAMETER_LIST_SLOWS
        ids = []
        for message, each in self._streams.items():
            if now_ns < each.due_ns:
                continue
            self._drawn += 1
            each.late = not each.late and uniform(self._draws, self._drawn) < LATE
            if each.late:
                continue
            ids.append(message)
            each.due_ns += each.interval_ns * slow
        return ids
