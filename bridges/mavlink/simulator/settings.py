"""Settings of a simulated rover before it boots: who and where it is, and its parameters (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, radians
from typing import Final, Literal

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import Robot
from handfast.bridges.mavlink.ardupilot import constants, steering
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, datum_of, world_to_geodetic, yaw_from_heading

SIGNING_KEY_BYTES: Final = 32
SYSTEM_MAX: Final = 250
"""Largest system id that a fleet's simulated rover is given; ground stations have those above."""
DEFAULT_HOME: Final = Geodetic(-35.363262, 149.165237, 584.0)
"""Where ArduPilot's own simulator stands when it is not told otherwise."""

PARAMETERS: Final[Mapping[str, tuple[float, int]]] = {
    "SYSID_THISMAV": (1, constants.PARAM_TYPE_INT16),
    "SYSID_MYGCS": (constants.SYSTEM_GROUND_STATION, constants.PARAM_TYPE_INT16),
    "SYSID_ENFORCE": (0, constants.PARAM_TYPE_INT8),
    "ARMING_CHECK": (1, constants.PARAM_TYPE_INT32),
    "ARMING_REQUIRE": (1, constants.PARAM_TYPE_INT8),
    "ATC_ACCEL_MAX": (constants.DEFAULT_ATC_ACCEL_MAX_MPS2, constants.PARAM_TYPE_REAL32),
    "ATC_STR_RAT_MAX": (constants.DEFAULT_ATC_STR_RAT_MAX_DPS, constants.PARAM_TYPE_REAL32),
    "ATC_TURN_MAX_G": (constants.DEFAULT_ATC_TURN_MAX_G, constants.PARAM_TYPE_REAL32),
    "AVOID_ENABLE": (3, constants.PARAM_TYPE_INT8),
    "BATT_CRT_VOLT": (0, constants.PARAM_TYPE_REAL32),
    "BATT_FS_CRT_ACT": (0, constants.PARAM_TYPE_INT8),
    "BATT_FS_LOW_ACT": (0, constants.PARAM_TYPE_INT8),
    "BATT_LOW_TIMER": (10, constants.PARAM_TYPE_INT16),
    "BATT_LOW_VOLT": (10.5, constants.PARAM_TYPE_REAL32),
    "BATT_MONITOR": (4, constants.PARAM_TYPE_INT8),
    "CRUISE_SPEED": (2, constants.PARAM_TYPE_REAL32),
    "FENCE_ACTION": (1, constants.PARAM_TYPE_INT8),
    "FENCE_ENABLE": (0, constants.PARAM_TYPE_INT8),
    "FENCE_MARGIN": (2, constants.PARAM_TYPE_REAL32),
    "FENCE_RADIUS": (300, constants.PARAM_TYPE_REAL32),
    "FRAME_CLASS": (1, constants.PARAM_TYPE_INT8),
    "FRAME_TYPE": (0, constants.PARAM_TYPE_INT8),
    "FS_ACTION": (2, constants.PARAM_TYPE_INT8),
    "FS_CRASH_CHECK": (0, constants.PARAM_TYPE_INT8),
    "FS_EKF_ACTION": (1, constants.PARAM_TYPE_INT8),
    "FS_EKF_THRESH": (0.8, constants.PARAM_TYPE_REAL32),
    "FS_GCS_ENABLE": (0, constants.PARAM_TYPE_INT8),
    "FS_GCS_TIMEOUT": (5, constants.PARAM_TYPE_REAL32),
    "FS_THR_ENABLE": (1, constants.PARAM_TYPE_INT8),
    "FS_TIMEOUT": (1.5, constants.PARAM_TYPE_REAL32),
    "GUID_TIMEOUT": (3, constants.PARAM_TYPE_REAL32),
    "SCHED_LOOP_RATE": (constants.LOOP_RATE_HZ, constants.PARAM_TYPE_INT16),
    **dict.fromkeys(steering.ALL, (0, constants.PARAM_TYPE_INT16)),
    "SERVO1_FUNCTION": (steering.THROTTLE_LEFT, constants.PARAM_TYPE_INT16),
    "SERVO3_FUNCTION": (steering.THROTTLE_RIGHT, constants.PARAM_TYPE_INT16),
    "SIM_BATT_VOLTAGE": (12.6, constants.PARAM_TYPE_REAL32),
    "SIM_GPS1_ENABLE": (1, constants.PARAM_TYPE_INT8),
    "SIM_GPS1_JAM": (0, constants.PARAM_TYPE_INT8),
    "SIM_GPS1_LAG_MS": (100, constants.PARAM_TYPE_INT32),
    "WP_RADIUS": (2, constants.PARAM_TYPE_REAL32),
    "WP_SPEED": (constants.DEFAULT_WP_SPEED_MPS, constants.PARAM_TYPE_REAL32),
}
"""Name: default, MAV_PARAM_TYPE. Those that change what the simulated rover does, or that an audit reads."""
NEW_NAMES: Final = {
    "SYSID_THISMAV": "MAV_SYSID",
    "SYSID_MYGCS": "MAV_GCS_SYSID",
    "SYSID_ENFORCE": "MAV_OPTIONS",
}
"""What newer firmware calls these."""
_OLD_NAMES: Final = {new: old for old, new in NEW_NAMES.items()}
RANGES: Final = {
    "SYSID_THISMAV": (1, 254),
    "SYSID_MYGCS": (1, 255),
    "GUID_TIMEOUT": (0, 3600),
    "SCHED_LOOP_RATE": (10, 400),
}


class SettingsError(ValueError):
    """A setting that no rover can have. The text says which, and what would be right."""


@dataclass(frozen=True)
class Settings:
    """One simulated rover.

    Attributes:
        system: its MAVLink system id.
        home: where it stands at the start; its truth counts from there.
        yaw: where it points then, rad clockwise from north.
        boot: "cold": it is switched on now; "warm": it has been on for long enough to be ready.
        boot_s: how long after switching on its EKF and GPS are ready, s. Its own EKF origin is
            there after 17/40 of it, as measured.
        hand_over: its operator sets GUIDED and arms it, once, as soon as its pre-arm checks are good.
        parameters: what differs from `PARAMETERS`.
        new_names: it has `NEW_NAMES`, and says so of a parameter that it has not, as newer firmware.
        seed: of its creep at boot, its errors of estimation and its jitter.
        signing_key: 32 bytes that it was given before, or none.
        vehicle_type, autopilot: MAV_TYPE, MAV_AUTOPILOT of its heartbeat.
        firmware: version.
        ports: how many it has. Port 0 is the first serial one, which takes unsigned messages always.
    """

    system: int = 1
    home: Geodetic = DEFAULT_HOME
    yaw: float = 0.0
    boot: Literal["cold", "warm"] = "cold"
    boot_s: float = 40.0
    hand_over: bool = False
    parameters: Mapping[str, float] = field(default_factory=dict)
    new_names: bool = False
    seed: int = 0
    signing_key: bytes = b""
    vehicle_type: int = constants.TYPE_GROUND_ROVER
    autopilot: int = constants.AUTOPILOT_ARDUPILOT
    firmware: tuple[int, int, int] = (4, 7, 0)
    ports: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.system <= 254:
            raise SettingsError(f"a vehicle's system id is from 1 to 254, not {self.system}")
        if not (isfinite(self.boot_s) and self.boot_s > 0.0):
            raise SettingsError(f"the time to boot must be more than 0 s, not {self.boot_s}")
        if self.signing_key and len(self.signing_key) != SIGNING_KEY_BYTES:
            raise SettingsError(f"a signing key has 32 bytes, this one {len(self.signing_key)}")
        if self.ports < 1:
            raise SettingsError("a rover needs at least one port")
        for name, value in self.parameters.items():
            check_parameter(name, value)


def system_of(robot: Robot) -> int:
    """System id of a simulated rover: one for each robot, so that a ground station can watch several."""
    section = robot.section(MavlinkSection)
    wanted = section.system if section is not None else None
    return wanted or (robot.id - 1) % SYSTEM_MAX + 1


def settings_of(fleet: Fleet, robot: int) -> Settings:
    """A simulated rover where the fleet file has this robot start, on for a while and handed over."""
    body = fleet.robot(robot)
    return Settings(
        system=system_of(body),
        home=world_to_geodetic(datum_of(fleet), body.x_m, body.y_m),
        yaw=yaw_from_heading(body.heading_rad),
        boot="warm",
        hand_over=True,
        seed=fleet.fleet.seed * 10_000 + robot,
    )


def check_parameter(name: str, value: float) -> None:
    """Raises `SettingsError` for a parameter that the simulated rover lacks, or that cannot be so."""
    name = _OLD_NAMES.get(name, name)
    if name not in PARAMETERS:
        raise SettingsError(f"no parameter {name}; there are {', '.join(sorted(PARAMETERS))}")
    if not isfinite(value):
        raise SettingsError(f"the parameter {name} must be a finite number")
    least, most = RANGES.get(name, (-float("inf"), float("inf")))
    if not least <= value <= most:
        raise SettingsError(f"the parameter {name} is from {least} to {most}, not {value:g}")


def type_of(name: str) -> int:
    """MAV_PARAM_TYPE of a parameter, by either of its names."""
    return PARAMETERS[_OLD_NAMES.get(name, name)][1]


class Parameters:
    """The parameters of a vehicle, kept over a reboot. Code here knows them by their older names.

    Attributes: `names`: as whoever asks for them knows them; `turns_on_the_spot`: by what its outputs do.
    """

    def __init__(self, settings: Settings) -> None:
        self._values = {name: float(default) for name, (default, _) in PARAMETERS.items()}
        self._values["SYSID_THISMAV"] = float(settings.system)
        self.turns_on_the_spot = steering.turns_on_the_spot(self._values)
        self.names = tuple(NEW_NAMES.get(name, name) if settings.new_names else name for name in self._values)
        for name, value in settings.parameters.items():
            self.set(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[_OLD_NAMES.get(name, name)]

    def __contains__(self, name: object) -> bool:
        """Whether somebody outside can ask for it."""
        return name in self.names

    def set(self, name: str, value: float) -> None:
        """Raises `SettingsError`; whole numbers are rounded to."""
        check_parameter(name, value)
        name = _OLD_NAMES.get(name, name)
        self._values[name] = float(value if type_of(name) == constants.PARAM_TYPE_REAL32 else round(value))
        if name in steering.ALL or name == steering.FRAME_TYPE:
            self.turns_on_the_spot = steering.turns_on_the_spot(self._values)


def parse_home(text: str) -> tuple[Geodetic, float]:
    """Place and yaw (rad) of ``LAT,LON,ALT,YAW`` in degrees and m, as ArduPilot's simulator takes it."""
    parts = text.split(",")
    try:
        latitude, longitude, altitude, yaw = (float(part) for part in parts)
    except ValueError:
        raise SettingsError(f"{text!r} is not LAT,LON,ALT,YAW in degrees and m") from None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and isfinite(altitude) and isfinite(yaw)):
        raise SettingsError(f"{text!r}: latitude is within 90 degrees, longitude within 180, all are finite")
    return Geodetic(latitude, longitude, altitude), radians(yaw)


def parse_parameter(text: str) -> tuple[str, float]:
    """Name and value of ``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        raise SettingsError(f"{text!r} is not NAME=VALUE with a number") from None
    check_parameter(name.strip(), number)
    return name.strip(), number
