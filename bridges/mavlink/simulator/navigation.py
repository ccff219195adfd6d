"""GPS, EKF and fence of a simulated rover: what they say of where it is, and when (PURE).

Measured: the EKF has its origin 17 s after the boot and its position 40 s after it; at rest it reports a
phantom 0.02 to 0.05 m/s; without a GPS the failsafe comes after 8.1 s, with a jammed one after 11.4 s (14.5 s
in another run), a second after the position is lost; a GPS that lags 300 ms instead of the 100 ms that it
expects puts it 0.19 m behind at 1 m/s. NED, SI units, times in s since the boot.
"""

from __future__ import annotations

from enum import Enum
from math import copysign, cos, hypot, sin, sqrt, tau
from typing import Final, NamedTuple, Protocol

from handfast.agent.common.random_streams import stream, uniform
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.dynamics import RoverDynamics
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, geodetic_to_local, local_to_geodetic, wrapped

INITIALISED: Final = 5.0 / 40.0
GPS_FIX: Final = 12.0 / 40.0
OWN_ORIGIN: Final = 17.0 / 40.0
"""Of the time to boot: when the EKF runs, the GPS has a fix, the EKF takes an origin by itself."""
EKF_READY: Final = (
    constants.EKF_NEEDED
    | constants.EKF_VELOCITY_VERT
    | constants.EKF_POS_VERT_ABS
    | constants.EKF_PRED_POS_HORIZ_REL
    | constants.EKF_PRED_POS_HORIZ_ABS
)
EKF_WITHOUT_POSITION: Final = (
    constants.EKF_ATTITUDE
    | constants.EKF_VELOCITY_HORIZ
    | constants.EKF_VELOCITY_VERT
    | constants.EKF_POS_VERT_ABS
    | constants.EKF_CONST_POS_MODE
)
FIX_LOST_S: Final = 1.0
POSITION_BACK_S: Final = 10.0
"""After this long with a GPS again the EKF has its position back."""
DRIFT: Final = 0.01
"""m/s^2 by which it drifts until then."""
WANDER: Final = 0.015
"""m by which its position is off, slowly varying."""
YAW_ERROR: Final = 0.005
"""rad by which its yaw is off at most, constant over a boot."""
PHANTOM: Final = (0.035, 0.013)
"""m/s: mean and swing of the speed that it reports at rest."""
PHANTOM_FADES: Final = 0.25
"""m/s at which that has faded to a fifth."""
EXPECTED_LAG_S: Final = 0.1
LAG_ERROR: Final = 0.95
"""m/s and s of lag that it does not expect, times this: by how many m it is behind."""


class Reception(Enum):
    """Of the GPS. The value is how long the EKF keeps its position with that, s; it gives it up then."""

    GOOD = 0.0
    JAMMED = 10.4
    OFF = 7.1


class Variances(NamedTuple):
    """Of EKF_STATUS_REPORT: test ratios of velocity, position and compass, 1 is the limit of good."""

    velocity: float = 0.02
    position: float = 0.03
    compass: float = 0.02

    def beyond(self, most: float) -> bool:
        """Rover's own check: one of the velocity is enough, of the two others it takes both."""
        return self.velocity >= most or (self.position >= most and self.compass >= most)


class Navigation:
    """The estimate of one vehicle from one boot on.

    Attributes: `origin` (None before it has one); `ready`: EKF and GPS carry a position; `initialised`: the
    EKF runs; `north`, `east`, `v_north`, `v_east`, `yaw`, `yaw_rate`: as it reports them; `flags` of
    EKF_STATUS_REPORT, and its `variances`; `fix`, `satellites` and `place` of its GPS.
    """

    def __init__(self, home: Geodetic, boot_s: float, *key: int | str) -> None:
        self._home, self._boot_s = home, boot_s
        draws = stream("rover navigation", *key)
        self._phase = [tau * uniform(draws, i) for i in range(7)]
        self._yaw_error = YAW_ERROR * (2.0 * uniform(draws, 7) - 1.0)
        self.origin: Geodetic | None = None
        self.place = home
        self.north = self.east = self.v_north = self.v_east = self.yaw = self.yaw_rate = 0.0
        self.initialised = self.ready = False
        self.variances = Variances()
        self._fixed = False
        self._without_gps = self._with_gps = 0.0
        self._drift = self._drift_speed = 0.0

    def set_origin(self, origin: Geodetic) -> bool:
        """The origin that somebody sent; taken only while the EKF runs and has none."""
        if not self.initialised or self.origin is not None:
            return False
        self.origin = origin
        return True

    def step(self, time: float, dt: float, truth: RoverDynamics, gps: Reception, lag_s: float) -> None:
        """The estimate at `time` from the truth then.

        Args:
            lag_s: by how much the GPS's fixes are late.
        """
        self.initialised = time >= INITIALISED * self._boot_s
        self._look_at_gps(time, dt, gps)
        phase = self._phase
        turn = tau * time
        behind = LAG_ERROR * (lag_s - EXPECTED_LAG_S) * truth.speed
        c, s = cos(truth.yaw), sin(truth.yaw)
        north = truth.north + WANDER * sin(turn / 37.0 + phase[0]) - behind * c
        east = truth.east + WANDER * sin(turn / 53.0 + phase[1]) - behind * s
        if self._drift:
            north += self._drift * cos(phase[5])
            east += self._drift * sin(phase[5])
        self.place = local_to_geodetic(self._home, north, east)
        if self.origin is None and self._fixed and time >= OWN_ORIGIN * self._boot_s:
            # To the seventh decimal, as GPS_GLOBAL_ORIGIN says it.
            latitude, longitude, altitude = self.place
            self.origin = Geodetic(round(latitude, 7), round(longitude, 7), round(altitude, 2))
        self.yaw = wrapped(truth.yaw + self._yaw_error)
        self.yaw_rate = truth.yaw_rate
        if self.origin is None or not self.ready:
            self.v_north = self.v_east = 0.0
            return
        self.north, self.east = geodetic_to_local(self.origin, self.place)
        fading = max(0.2, 1.0 - 0.8 * abs(truth.speed) / PHANTOM_FADES)
        phantom = fading * (PHANTOM[0] + PHANTOM[1] * sin(turn / 23.0 + phase[2]))
        course = turn / 31.0 + phase[3]
        self.v_north = truth.speed * c + phantom * cos(course)
        self.v_east = truth.speed * s + phantom * sin(course)

    def _look_at_gps(self, time: float, dt: float, gps: Reception) -> None:
        if time < GPS_FIX * self._boot_s:
            return
        good = gps is Reception.GOOD
        if good:
            self._with_gps += dt
            self._without_gps = 0.0
            self._fixed = True
        else:
            self._without_gps += dt
            self._with_gps = 0.0
            self._fixed = self._fixed and self._without_gps < FIX_LOST_S
        if not self.ready:
            # After a loss it takes its while to trust the GPS again, at the boot the boot's time.
            if self._fixed and self._with_gps >= POSITION_BACK_S * min(1.0, self._boot_s / 40.0):
                self.ready = self.origin is not None and time >= self._boot_s
                self._drift = self._drift_speed = 0.0
            return
        if good:
            self._drift = self._drift_speed = 0.0
        else:
            self._drift_speed += DRIFT * dt
            self._drift += self._drift_speed * dt
            self.ready = self._without_gps < gps.value

    @property
    def flags(self) -> int:
        """Of EKF_STATUS_REPORT."""
        if not self.initialised:
            return constants.EKF_UNINITIALIZED
        return EKF_READY if self.ready else EKF_WITHOUT_POSITION

    @property
    def fix(self) -> int:
        """GPS_RAW_INT.fix_type."""
        return constants.GPS_3D_FIX if self._fixed else constants.GPS_NO_FIX

    @property
    def satellites(self) -> int:
        """How many its GPS sees."""
        return 10 if self._fixed else 0


LIMITS_NS: Final = 500_000_000
"""Avoidance is said to act for so long after it last did."""
ACCELERATION_MAX: Final = 1.0
"""m/s^2, of stopping before the fence: this at most, and half of what the vehicle can."""


class Parameters(Protocol):
    """The vehicle's."""

    def __getitem__(self, name: str, /) -> float: ...


class Fence:
    """The circular fence, from one boot on, and the avoidance before it. Places are m, NED about home.

    As in ArduPilot's AC_Avoid (its stop behaviour) and AC_Fence: with bit 0 of AVOID_ENABLE the speed that is
    asked for is lowered until the rover stands FENCE_MARGIN before the fence, and it stays in GUIDED. Beyond
    FENCE_RADIUS it does what FENCE_ACTION says. It does not back away from its fence, as the real one does
    where it has rolled far into the margin.

    Attributes: `breached`: it is outside; `breaches`: how often it went there.
    """

    def __init__(self) -> None:
        self.breached = False
        self.breaches = 0
        self._limited_ns: int | None = None

    def limits(self, now_ns: int) -> bool:
        """Whether avoidance holds the vehicle back."""
        return self._limited_ns is not None and now_ns - self._limited_ns < LIMITS_NS

    def slowed(
        self, parameters: Parameters, speed: float, yaw: float, place: tuple[float, float], now_ns: int
    ) -> float:
        """The speed (m/s, negative in reverse) that is left of the one asked for."""
        avoids = int(parameters[constants.AVOID_ENABLE]) & constants.AVOID_FENCE
        if not (avoids and parameters[constants.FENCE_ENABLE]) or self.breached or speed == 0.0:
            return speed
        left = _left(parameters, speed, yaw, *place)
        if left != speed:
            self._limited_ns = now_ns
        return left

    def look(self, parameters: Parameters, north: float, east: float) -> bool:
        """Whether it has just gone outside."""
        outside = (
            bool(parameters[constants.FENCE_ENABLE]) and hypot(north, east) >= parameters["FENCE_RADIUS"]
        )
        new = outside and not self.breached
        self.breached = outside
        self.breaches += new
        return new


def _left(parameters: Parameters, speed: float, yaw: float, north: float, east: float) -> float:
    radius, margin = parameters["FENCE_RADIUS"], parameters["FENCE_MARGIN"]
    acceleration = min(0.5 * parameters["ATC_ACCEL_MAX"], ACCELERATION_MAX)
    sign = copysign(1.0, speed)
    ahead_north, ahead_east = sign * cos(yaw), sign * sin(yaw)
    distance, inner = hypot(north, east), radius - margin
    outward = north * ahead_north + east * ahead_east
    if distance >= inner:
        stopping = margin + 0.5 * speed * speed / acceleration
        nearer = hypot(north + stopping * ahead_north, east + stopping * ahead_east) < distance
        return speed if nearer else 0.0
    way = sqrt(outward * outward + inner * inner - distance * distance) - outward
    return copysign(min(abs(speed), sqrt(2.0 * acceleration * way)), speed)
