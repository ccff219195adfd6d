"""The circular fence of a simulated rover, and the avoidance that stops it before that (PURE).

As in ArduPilot's AC_Avoid (its stop behaviour) and AC_Fence: with bit 0 of AVOID_ENABLE the speed that is
asked for is lowered until the rover stands FENCE_MARGIN before the fence, and it stays in GUIDED; one that is
beyond FENCE_RADIUS does what FENCE_ACTION says. It does not back away from its fence by itself, as the real
one does where it has rolled far into the margin.
"""

from __future__ import annotations

from math import copysign, cos, hypot, sin, sqrt
from typing import Final, Protocol

from handfast.bridges.mavlink.ardupilot import constants

LIMITS_NS: Final = 500_000_000
"""Avoidance is said to act for so long after it last did."""
ACCELERATION_MAX: Final = 1.0
"""m/s^2, of stopping before the fence: this at most, and half of what the vehicle can."""


class Parameters(Protocol):
    """The vehicle's."""

    def __getitem__(self, name: str, /) -> float: ...


class Fence:
    """From one boot on. Places are m, NED about home.

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
