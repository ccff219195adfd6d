"""Makes a simulated rover's telemetry: from the vehicle to MAVLink's fields and units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, degrees, sin
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
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
