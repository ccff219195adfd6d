"""Reads a vehicle's reports, and who else is on its link, from messages (PURE).

The functions see objects with MAVLink's fields.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, wrapped

_UNKNOWN_U16: Final = 65535
_E7: Final = 1e7
_SAME_E7: Final = 2
_TEXT_LENGTH: Final = 50
_CHUNKS_MAX: Final = 20
_TEXTS_MAX: Final = 8
_CHUNK_TIMEOUT_NS: Final = NS_PER_S
_RELEASES: Final = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))


class PositionSample(NamedTuple):
    """LOCAL_POSITION_NED: m and m/s about the vehicle's own EKF origin.

    `stamp_ms` is the time by the vehicle's boot clock, `valid_ns` the same by the wall clock, as far as that
    was known when the message came.
    """

    stamp_ms: int
    arrival_ns: int
    north: float
    east: float
    v_north: float
    v_east: float
    valid_ns: int


class AttitudeSample(NamedTuple):
    """ATTITUDE: yaw (rad, clockwise from north) and its rate (rad/s, FRD). Times as in `PositionSample`."""

    stamp_ms: int
    arrival_ns: int
    yaw: float
    rate: float
    valid_ns: int


class Ekf(NamedTuple):
    """EKF_STATUS_REPORT: flags `constants.EKF_*`; variances are test ratios, 1 is the limit of good."""

    arrival_ns: int
    flags: int
    velocity_variance: float
    position_variance: float
    compass_variance: float


class Gps(NamedTuple):
    """GPS_RAW_INT: fix `constants.GPS_*`; `satellites` 0 and `hdop` None where unknown."""

    arrival_ns: int
    fix: int
    satellites: int
    hdop: float | None


class Battery(NamedTuple):
    """V and per cent (0 to 100), None where unknown."""

    voltage: float | None
    percent: int | None


class Status(NamedTuple):
    """SYS_STATUS: sensors as bits `constants.SENSOR_*`, and the battery."""

    arrival_ns: int
    present: int
    enabled: int
    health: int
    battery: Battery

    @property
    def prearm_ok(self) -> bool | None:
        """Whether the vehicle's own checks before arming pass; None: it does not say."""
        if not self.present & self.enabled & constants.SENSOR_PREARM_CHECK:
            return None
        return bool(self.health & constants.SENSOR_PREARM_CHECK)


class Text(NamedTuple):
    """A STATUSTEXT, its chunks joined; `severity` as MAV_SEVERITY, 0 (emergency) to 7 (debug)."""

    arrival_ns: int
    severity: int
    text: str


def position_sample(message: Any, valid_ns: int, arrival_ns: int) -> PositionSample | None:
    """None when a number is not finite."""
    numbers = message.x, message.y, message.vx, message.vy
    if not all(map(isfinite, numbers)):
        return None
    return PositionSample(message.time_boot_ms, arrival_ns, *numbers, valid_ns)


def attitude_sample(message: Any, valid_ns: int, arrival_ns: int) -> AttitudeSample | None:
    """None when a number is not finite."""
    if not (isfinite(message.yaw) and isfinite(message.yawspeed)):
        return None
    return AttitudeSample(message.time_boot_ms, arrival_ns, wrapped(message.yaw), message.yawspeed, valid_ns)


def ekf(message: Any, arrival_ns: int) -> Ekf:
    """A variance that is not finite is infinitely bad."""
    variances = (
        message.velocity_variance,
        message.pos_horiz_variance,
        message.compass_variance,
    )
    return Ekf(arrival_ns, message.flags, *(v if isfinite(v) else float("inf") for v in variances))


def gps(message: Any, arrival_ns: int) -> Gps:
    """The fix."""
    satellites = 0 if message.satellites_visible == 255 else message.satellites_visible
    hdop = None if message.eph == _UNKNOWN_U16 else message.eph / 100.0
    return Gps(arrival_ns, message.fix_type, satellites, hdop)


def status(message: Any, arrival_ns: int) -> Status:
    """Sensors and battery."""
    voltage = None if message.voltage_battery in (0, _UNKNOWN_U16) else message.voltage_battery / 1000.0
    percent = message.battery_remaining if 0 <= message.battery_remaining <= 100 else None
    return Status(
        arrival_ns,
        message.onboard_control_sensors_present,
        message.onboard_control_sensors_enabled,
        message.onboard_control_sensors_health,
        Battery(voltage, percent),
    )


def held_back(message: Any) -> bool:
    """Whether the vehicle slows itself down before its own fence, of FENCE_STATUS."""
    return bool(message.breach_mitigation == constants.MITIGATE_SPEED)


def origin(message: Any) -> Geodetic | None:
    """The EKF's origin; None for one that is no place on Earth, or the 0, 0 of one that is not set."""
    latitude, longitude = message.latitude / _E7, message.longitude / _E7
    if abs(latitude) > 90.0 or abs(longitude) > 180.0 or (message.latitude, message.longitude) == (0, 0):
        return None
    return Geodetic(latitude, longitude, message.altitude / 1000.0)


def scaled(place: Geodetic) -> tuple[int, int, int]:
    """Latitude and longitude in 1e-7 degrees, altitude in mm, as MAVLink sends a place."""
    return round(place.latitude_deg * _E7), round(place.longitude_deg * _E7), round(place.altitude_m * 1000.0)


def same_place(one: Geodetic, other: Geodetic) -> bool:
    """Whether two origins are one, but for rounding (2e-7 degrees, 2 cm); height does not matter."""
    (latitude, longitude, _), (latitude2, longitude2, _) = scaled(one), scaled(other)
    turn = (longitude - longitude2 + 1_800_000_000) % 3_600_000_000 - 1_800_000_000
    return abs(latitude - latitude2) <= _SAME_E7 and abs(turn) <= _SAME_E7


def firmware(message: Any) -> str:
    """The version in AUTOPILOT_VERSION, as "4.5.7" or "4.7.0-dev (1a2b3c4d)"."""
    number = message.flight_sw_version
    release = next(name for least, name in _RELEASES if number & 0xFF >= least)
    text = f"{number >> 24}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}{release}"
    build = bytes(message.flight_custom_version).decode("ascii", errors="replace")
    build = "".join(letter for letter in build if letter.isalnum())
    return f"{text} ({build})" if build else text


class _Open:
    """A text whose end has not come."""

    __slots__ = ("arrival_ns", "next_chunk", "parts", "severity")

    def __init__(self, arrival_ns: int, severity: int, chunk: int) -> None:
        self.arrival_ns = arrival_ns
        self.severity = severity
        self.next_chunk = chunk
        self.parts = ["..."] if chunk else []  # its beginning was lost: the rest is still worth reading


class Texts:
    """Joins the chunks of long STATUSTEXTs. Bounded: whoever sends chunks without end gets them cut."""

    def __init__(self) -> None:
        self._open: dict[int, _Open] = {}

    def take(self, message: Any, arrival_ns: int) -> list[Text]:
        """The texts that a message completes."""
        text = "".join(letter for letter in message.text if letter.isprintable())
        number, chunk = message.id, message.chunk_seq
        if not number:
            return [Text(arrival_ns, message.severity, text)]
        out = []
        found = self._open.get(number)
        if found is not None and chunk != found.next_chunk:
            out.append(self._finish(number))
            found = None
        if found is None:
            if len(self._open) >= _TEXTS_MAX:
                out.append(self._finish(next(iter(self._open))))
            found = self._open[number] = _Open(arrival_ns, message.severity, chunk)
        found.parts.append(text)
        found.next_chunk = chunk + 1
        if len(message.text) < _TEXT_LENGTH or len(found.parts) >= _CHUNKS_MAX:
            out.append(self._finish(number))
        return out

    def overdue(self, now_ns: int) -> list[Text]:
        """Those whose last chunk does not come."""
        if not self._open:
            return []
        late = [n for n, found in self._open.items() if now_ns - found.arrival_ns > _CHUNK_TIMEOUT_NS]
        return [self._finish(number) for number in late]

    def _finish(self, number: int) -> Text:
        found = self._open.pop(number)
        return Text(found.arrival_ns, found.severity, "".join(found.parts))


HEARD_NS: Final = 5 * NS_PER_S
"""Who has sent no heartbeat for this long is gone."""
KEPT: Final = 32


PERIPHERAL: Final = 158
"""MAV_COMP_ID_PERIPHERAL: a device with a controller of its own, which steers nothing."""


class Participant(NamedTuple):
    """A sender of heartbeats that is not the vehicle: its identity, MAV_TYPE and when it was last heard."""

    system: int
    component: int
    type: int
    heard_ns: int


class Participants:
    """Those that were heard, `KEPT` at most; of more the first."""

    def __init__(self) -> None:
        self._heard: dict[tuple[int, int, bool], Participant] = {}

    def clear(self) -> None:
        """Nobody is here."""
        self._heard.clear()

    def heard(self, sender: Participant, *, vehicle: bool) -> None:
        """Takes a heartbeat; `vehicle`: of an autopilot."""
        key = sender.system, sender.component, vehicle
        if key not in self._heard and len(self._heard) >= KEPT:
            self._heard = {k: p for k, p in self._heard.items() if sender.heard_ns - p.heard_ns <= HEARD_NS}
            if len(self._heard) >= KEPT:
                return
        self._heard[key] = sender

    def _now(self, now_ns: int, *, vehicle: bool) -> list[Participant]:
        return [
            participant
            for (_, _, is_vehicle), participant in self._heard.items()
            if is_vehicle is vehicle and now_ns - participant.heard_ns <= HEARD_NS
        ]

    def ground_stations(self, now_ns: int) -> list[Participant]:
        """Those of MAV_TYPE_GCS."""
        return [p for p in self._now(now_ns, vehicle=False) if p.type == constants.TYPE_GCS]

    def vehicles(self, now_ns: int) -> list[Participant]:
        """Autopilots that are not the one of this link."""
        return self._now(now_ns, vehicle=True)

    def strangers(self) -> dict[int, int]:
        """MAV_TYPE by system id of such autopilots, also of those that have gone silent."""
        return {p.system: p.type for (_, _, vehicle), p in self._heard.items() if vehicle}

    def another_bridge(self, now_ns: int, own: tuple[int, int], vehicle: int) -> str:
        """Who else may steer the vehicle, "" nobody. A ground station is the operator's: it may be there."""
        for other in self._now(now_ns, vehicle=False):
            name = f"system {other.system}, component {other.component}"
            if (other.system, other.component) == own:
                return f"another program speaks as {name}, which is this bridge's own identity"
            is_controller = other.type == constants.TYPE_ONBOARD_CONTROLLER and other.component != PERIPHERAL
            if is_controller and other.system == vehicle:
                return f"another onboard controller is on this vehicle ({name})"
        return ""
