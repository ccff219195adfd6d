"""Numbers and names that ArduPilot Rover has for modes, messages, commands and parameters (PURE).

Numbers as in MAVLink's ``common`` and ``ardupilotmega`` dialects and in ArduPilot's ``Rover/mode.h``; what
the vehicle does with them is measured (``docs/rovers-measurements.md``). pymavlink's own enums stay out, so
that pure modules may import this one.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.messages.types import SEVERITIES

# Flight modes: HEARTBEAT.custom_mode, SET_MODE, MAV_CMD_DO_SET_MODE.
MODE_MANUAL: Final = 0
MODE_ACRO: Final = 1
MODE_STEERING: Final = 3
MODE_HOLD: Final = 4
MODE_LOITER: Final = 5
MODE_FOLLOW: Final = 6
MODE_SIMPLE: Final = 7
MODE_DOCK: Final = 8
MODE_CIRCLE: Final = 9
MODE_AUTO: Final = 10
MODE_RTL: Final = 11
MODE_SMART_RTL: Final = 12
MODE_GUIDED: Final = 15
MODE_INITIALISING: Final = 16

MODE_NAMES: Final = {
    MODE_MANUAL: "MANUAL",
    MODE_ACRO: "ACRO",
    MODE_STEERING: "STEERING",
    MODE_HOLD: "HOLD",
    MODE_LOITER: "LOITER",
    MODE_FOLLOW: "FOLLOW",
    MODE_SIMPLE: "SIMPLE",
    MODE_DOCK: "DOCK",
    MODE_CIRCLE: "CIRCLE",
    MODE_AUTO: "AUTO",
    MODE_RTL: "RTL",
    MODE_SMART_RTL: "SMART_RTL",
    MODE_GUIDED: "GUIDED",
    MODE_INITIALISING: "INITIALISING",
}
MODE_NUMBERS: Final = {name: number for number, name in MODE_NAMES.items()}


def mode_name(number: int) -> str:
    """Name of a mode of Rover, ``mode 42`` for one that is not known."""
    return MODE_NAMES.get(number, f"mode {number}")


# MAV_TYPE, MAV_AUTOPILOT, MAV_STATE, MAV_MODE_FLAG: of HEARTBEAT.
TYPE_GENERIC: Final = 0
TYPE_FIXED_WING: Final = 1
TYPE_QUADROTOR: Final = 2
TYPE_GCS: Final = 6
TYPE_GROUND_ROVER: Final = 10
TYPE_SURFACE_BOAT: Final = 11
TYPE_SUBMARINE: Final = 12
TYPE_ONBOARD_CONTROLLER: Final = 18
ROVER_TYPES: Final = frozenset({TYPE_GROUND_ROVER, TYPE_SURFACE_BOAT})
TYPE_NAMES: Final = {
    TYPE_GENERIC: "generic",
    TYPE_FIXED_WING: "fixed wing",
    TYPE_QUADROTOR: "quadrotor",
    3: "coaxial helicopter",
    4: "helicopter",
    5: "antenna tracker",
    TYPE_GCS: "ground station",
    TYPE_GROUND_ROVER: "ground rover",
    TYPE_SURFACE_BOAT: "surface boat",
    TYPE_SUBMARINE: "submarine",
    13: "hexarotor",
    14: "octorotor",
    TYPE_ONBOARD_CONTROLLER: "onboard controller",
    19: "vertical take-off plane",
    26: "gimbal",
    27: "ADS-B receiver",
    30: "camera",
}

AUTOPILOT_ARDUPILOT: Final = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA."""
AUTOPILOT_INVALID: Final = 8
"""What a ground station and a companion say of themselves."""
AUTOPILOT_PX4: Final = 12

STATE_STANDBY: Final = 3
STATE_ACTIVE: Final = 4
STATE_CRITICAL: Final = 5

FLAG_CUSTOM_MODE: Final = 1
"""MAV_MODE_FLAG_CUSTOM_MODE_ENABLED: HEARTBEAT.custom_mode has a meaning; needed in a request for a mode."""
FLAG_GUIDED: Final = 8
FLAG_MANUAL_INPUT: Final = 64
FLAG_ARMED: Final = 128
"""MAV_MODE_FLAG_SAFETY_ARMED."""

# Components.
COMPONENT_AUTOPILOT: Final = 1
COMPONENT_ONBOARD_COMPUTER: Final = 191
SYSTEM_GROUND_STATION: Final = 255
"""The system id that a ground station and SYSID_MYGCS have by default: never ours."""

# POSITION_TARGET_TYPEMASK: a bit set means "ignore". The vertical ones Rover does not read.
IGNORE_X: Final = 0x001
IGNORE_Y: Final = 0x002
IGNORE_VX: Final = 0x008
IGNORE_VY: Final = 0x010
IGNORE_AX: Final = 0x040
IGNORE_AY: Final = 0x080
IGNORE_YAW: Final = 0x400
IGNORE_YAW_RATE: Final = 0x800
IGNORE_POSITION: Final = IGNORE_X | IGNORE_Y
"""All bits of a group."""
IGNORE_VELOCITY: Final = IGNORE_VX | IGNORE_VY
IGNORE_ACCELERATION: Final = IGNORE_AX | IGNORE_AY

MASK_SPEED_AND_YAW_RATE: Final = 0x5C7
"""Forward speed ``sqrt(vx^2 + vy^2) * sign(vx)`` in a body frame, with a yaw rate: what a bridge sends."""

# MAV_FRAME.
FRAME_LOCAL_NED: Final = 1
FRAME_LOCAL_OFFSET_NED: Final = 7
FRAME_BODY_NED: Final = 8
FRAME_BODY_OFFSET_NED: Final = 9
ACCEPTED_FRAMES: Final = frozenset(
    {FRAME_LOCAL_NED, FRAME_LOCAL_OFFSET_NED, FRAME_BODY_NED, FRAME_BODY_OFFSET_NED}
)
"""Setpoints in any other frame are ignored without a word."""
BODY_FRAMES: Final = frozenset({FRAME_BODY_NED, FRAME_BODY_OFFSET_NED})

# Ids of messages.
MESSAGE_HEARTBEAT: Final = 0
MESSAGE_SYS_STATUS: Final = 1
MESSAGE_SYSTEM_TIME: Final = 2
MESSAGE_GPS_RAW_INT: Final = 24
MESSAGE_ATTITUDE: Final = 30
MESSAGE_LOCAL_POSITION_NED: Final = 32
MESSAGE_GLOBAL_POSITION_INT: Final = 33
MESSAGE_GPS_GLOBAL_ORIGIN: Final = 49
MESSAGE_BATTERY_STATUS: Final = 147
MESSAGE_AUTOPILOT_VERSION: Final = 148
MESSAGE_FENCE_STATUS: Final = 162
MESSAGE_EKF_STATUS_REPORT: Final = 193
MESSAGE_HOME_POSITION: Final = 242

# MAV_CMD, and what COMMAND_ACK says of one (MAV_RESULT).
CMD_DO_SET_MODE: Final = 176
CMD_PREFLIGHT_REBOOT_SHUTDOWN: Final = 246
CMD_RUN_PREARM_CHECKS: Final = 401
CMD_COMPONENT_ARM_DISARM: Final = 400
CMD_GET_HOME_POSITION: Final = 410
CMD_GET_MESSAGE_INTERVAL: Final = 510
CMD_SET_MESSAGE_INTERVAL: Final = 511
CMD_REQUEST_MESSAGE: Final = 512
FORCE_ARM: Final = 21196
"""``param2`` of an arming command that skips the checks. Before the EKF is ready it can crash the vehicle."""

RESULT_ACCEPTED: Final = 0
RESULT_TEMPORARILY_REJECTED: Final = 1
RESULT_DENIED: Final = 2
RESULT_UNSUPPORTED: Final = 3
RESULT_FAILED: Final = 4
RESULT_IN_PROGRESS: Final = 5
RESULT_NAMES: Final = {
    RESULT_ACCEPTED: "accepted",
    RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    RESULT_DENIED: "denied",
    RESULT_UNSUPPORTED: "unsupported",
    RESULT_FAILED: "failed",
    RESULT_IN_PROGRESS: "in progress",
}

# EKF_STATUS_REPORT.flags.
EKF_ATTITUDE: Final = 1
EKF_VELOCITY_HORIZ: Final = 2
EKF_VELOCITY_VERT: Final = 4
EKF_POS_HORIZ_REL: Final = 8
EKF_POS_HORIZ_ABS: Final = 16
EKF_POS_VERT_ABS: Final = 32
EKF_CONST_POS_MODE: Final = 128
EKF_PRED_POS_HORIZ_REL: Final = 256
EKF_PRED_POS_HORIZ_ABS: Final = 512
EKF_UNINITIALIZED: Final = 1024
EKF_GPS_GLITCHING: Final = 1 << 15
EKF_NEEDED: Final = EKF_ATTITUDE | EKF_VELOCITY_HORIZ | EKF_POS_HORIZ_REL | EKF_POS_HORIZ_ABS

MITIGATE_NONE: Final = 1
MITIGATE_SPEED: Final = 2
"""FENCE_STATUS.breach_mitigation (FENCE_MITIGATE): whether the vehicle holds itself back before its fence."""

# SYS_STATUS sensors (MAV_SYS_STATUS_SENSOR).
SENSOR_GPS: Final = 0x20
SENSOR_AHRS: Final = 0x200000
SENSOR_PREARM_CHECK: Final = 0x10000000

# GPS_RAW_INT.fix_type.
GPS_NO_GPS: Final = 0
GPS_NO_FIX: Final = 1
GPS_2D_FIX: Final = 2
GPS_3D_FIX: Final = 3
GPS_DGPS: Final = 4
GPS_RTK_FLOAT: Final = 5
GPS_RTK_FIXED: Final = 6
GPS_FIX_NAMES: Final = {
    GPS_NO_GPS: "no GPS",
    GPS_NO_FIX: "no fix",
    GPS_2D_FIX: "2D fix",
    GPS_3D_FIX: "3D fix",
    GPS_DGPS: "DGPS",
    GPS_RTK_FLOAT: "RTK float",
    GPS_RTK_FIXED: "RTK fixed",
}


def severity_name(number: int) -> str:
    """Name of a STATUSTEXT's severity, MAV_SEVERITY; of one that is none, the least."""
    return SEVERITIES[number] if 0 <= number < len(SEVERITIES) else SEVERITIES[-1]


# MAV_PARAM_TYPE of PARAM_VALUE.
PARAM_TYPE_INT8: Final = 2
PARAM_TYPE_INT16: Final = 4
PARAM_TYPE_INT32: Final = 6
PARAM_TYPE_REAL32: Final = 9

# Parameters. Newer firmware has renamed some: first today's name, then the older one.
FS_ACTION: Final = "FS_ACTION"
FS_THR_ENABLE: Final = "FS_THR_ENABLE"
FS_GCS_ENABLE: Final = "FS_GCS_ENABLE"
FS_EKF_ACTION: Final = "FS_EKF_ACTION"
FS_EKF_THRESH: Final = "FS_EKF_THRESH"
FS_CRASH_CHECK: Final = "FS_CRASH_CHECK"
SYSTEM_ID: Final = ("MAV_SYSID", "SYSID_THISMAV")
GROUND_STATION_ID: Final = ("MAV_GCS_SYSID", "SYSID_MYGCS")
OPTION_ENFORCE: Final = 1
"""Bit of MAV_OPTIONS, and the value of SYSID_ENFORCE."""
WP_SPEED: Final = "WP_SPEED"
ATC_ACCEL_MAX: Final = "ATC_ACCEL_MAX"
ATC_STR_RAT_MAX: Final = "ATC_STR_RAT_MAX"
ATC_TURN_MAX_G: Final = "ATC_TURN_MAX_G"
ARMING_CHECK: Final = ("ARMING_SKIPCHK", "ARMING_CHECK")
BATT_FS_LOW_ACT: Final = "BATT_FS_LOW_ACT"
BATT_FS_CRT_ACT: Final = "BATT_FS_CRT_ACT"
BATT_LOW_VOLT: Final = "BATT_LOW_VOLT"
RIGHT_FAILSAFES: Final = {
    FS_ACTION: 2.0,
    FS_THR_ENABLE: 1.0,
    FS_EKF_ACTION: 1.0,
    FS_EKF_THRESH: 0.8,
    FS_CRASH_CHECK: 1.0,
    BATT_FS_LOW_ACT: 2.0,
    BATT_FS_CRT_ACT: 2.0,
}
"""Failsafe parameters with one value that is right for every rover of a fleet. FS_GCS_ENABLE has none: it
depends on whether a ground station is always present."""
FENCE_ENABLE: Final = "FENCE_ENABLE"
GUID_TIMEOUT: Final = "GUID_TIMEOUT"
"""Since 2026: for how long the vehicle drives on in GUIDED without a setpoint, s. Older firmware has no such
parameter, and stops after `SETPOINT_TIMEOUT_NS`."""
AVOID_ENABLE: Final = "AVOID_ENABLE"
AVOID_FENCE: Final = 1
"""Bit of AVOID_ENABLE: it stops before its fence."""

SCHED_LOOP_RATE: Final = "SCHED_LOOP_RATE"
LOOP_RATE_HZ: Final = 50
"""Default of SCHED_LOOP_RATE."""
STREAM_RATE_PART: Final = 0.8
"""Of SCHED_LOOP_RATE: the most that SET_MESSAGE_INTERVAL grants (40 Hz)."""
STREAM_RATE_HZ: Final = 1.0
"""What is sent of position and attitude unless asked for more."""
SETPOINT_TIMEOUT_NS: Final = 3_000_000_000
"""After this silence in GUIDED the vehicle stops by itself, unless `GUID_TIMEOUT` says otherwise."""
SETPOINT_TIMEOUT_TEXT: Final = "target not received last 3secs, stopping"
DISARMED_TEXT: Final = "Throttle disarmed"
"""Said whenever it is disarmed, by whomever (Rover's AP_Arming.cpp)."""
DEFAULT_WP_SPEED_MPS: Final = 3.0
DEFAULT_ATC_ACCEL_MAX_MPS2: Final = 1.0
DEFAULT_ATC_STR_RAT_MAX_DPS: Final = 120.0
DEFAULT_ATC_TURN_MAX_G: Final = 0.6
"""Defaults of the four parameters: m/s, m/s^2, degrees per second, g."""
