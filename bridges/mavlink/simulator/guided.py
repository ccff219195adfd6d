"""GUIDED mode of a simulated rover: which setpoints it takes, and what it then asks of itself (PURE).

NED and FRD throughout, yaw clockwise from north, SI units.
"""

from __future__ import annotations

from math import atan2, copysign, cos, hypot, isfinite, pi, sin, sqrt
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import wrapped

STEERING_P: Final = 2.0
"""rad/s of yaw rate per rad of heading error (ATC_STR_ANG_P)."""
PIVOT_ANGLE: Final = pi / 3.0
"""rad. Farther off its course than this, a rover turns on the spot first (WP_PIVOT_ANGLE)."""
STOPPING: Final = 0.5
"""m/s^2 with which it comes to a place."""
ATTITUDE_IGNORES_THRUST: Final = 0x40
ATTITUDE_IGNORES_YAW_RATE: Final = 0x04


class NotFinite(ArithmeticError):
    """A setpoint that is not a number where it is used: the autopilot's process ends of it."""


class YawRate(NamedTuple):
    """Drive at `speed` (negative: in reverse) and turn at `yaw_rate`."""

    speed: float
    yaw_rate: float


class Heading(NamedTuple):
    """Drive at `speed` and turn to `yaw`."""

    speed: float
    yaw: float


class Place(NamedTuple):
    """Go to `north`, `east` of the EKF origin and stand there."""

    north: float
    east: float


Target = YawRate | Heading | Place


class Pose(NamedTuple):
    """The vehicle's own estimate, about its EKF origin."""

    north: float
    east: float
    yaw: float


class PositionTarget(NamedTuple):
    """What Rover reads of SET_POSITION_TARGET_LOCAL_NED."""

    frame: int
    mask: int
    x: float
    y: float
    vx: float
    vy: float
    yaw: float
    yaw_rate: float


def _used(*values: float) -> None:
    if not all(map(isfinite, values)):
        raise NotFinite("a setpoint that is not finite")


def of_position_target(message: PositionTarget, pose: Pose, speed_max: float) -> Target | None:
    """The target of a message, None where the vehicle ignores it.

    Raises `NotFinite` for a number that is used and is none, as the autopilot dies of it.
    """
    frame, mask, x, y, vx, vy, yaw, yaw_rate = message
    if frame not in constants.ACCEPTED_FRAMES:
        return None
    in_body = frame in constants.BODY_FRAMES
    position = not mask & constants.IGNORE_POSITION
    velocity = not mask & constants.IGNORE_VELOCITY
    has_yaw = not mask & constants.IGNORE_YAW
    has_rate = not mask & constants.IGNORE_YAW_RATE
    used = (position, (x, y)), (velocity, (vx, vy)), (has_yaw, (yaw,)), (has_rate, (yaw_rate,))
    for is_used, values in used:
        if is_used:
            _used(*values)
    if not mask & constants.IGNORE_ACCELERATION:
        return None
    if position:
        return _place(frame, x, y, pose)
    turned = pose.yaw if in_body else 0.0
    speed = min(hypot(vx, vy), speed_max) if velocity else 0.0
    if has_rate and has_yaw:
        return None
    if has_rate:
        return YawRate(copysign(speed, vx) if velocity else 0.0, yaw_rate)
    if has_yaw:
        return Heading(copysign(speed, vx) if velocity else 0.0, wrapped(yaw + turned))
    if velocity:
        return Heading(speed, wrapped(atan2(vy, vx) + turned))
    return None


def _place(frame: int, x: float, y: float, pose: Pose) -> Place:
    if frame == constants.FRAME_LOCAL_NED:
        return Place(x, y)
    if frame == constants.FRAME_LOCAL_OFFSET_NED:
        return Place(pose.north + x, pose.east + y)
    c, s = cos(pose.yaw), sin(pose.yaw)
    return Place(pose.north + x * c - y * s, pose.east + x * s + y * c)


def of_attitude_target(
    mask: int, q: tuple[float, float, float, float], yaw_rate: float, thrust: float, speed: float
) -> Target | None:
    """The target of SET_ATTITUDE_TARGET: `thrust` (-1 to 1) times the vehicle's `speed` (WP_SPEED), with the
    yaw rate or the yaw of the quaternion `q`. Raises `NotFinite`."""
    if mask & ATTITUDE_IGNORES_THRUST:
        return None
    _used(thrust)
    wanted = max(-1.0, min(1.0, thrust)) * speed
    if not mask & ATTITUDE_IGNORES_YAW_RATE:
        _used(yaw_rate)
        return YawRate(wanted, yaw_rate)
    _used(*q)
    q0, q1, q2, q3 = q
    return Heading(wanted, atan2(2.0 * (q0 * q3 + q1 * q2), 1.0 - 2.0 * (q2 * q2 + q3 * q3)))


class Guided:
    """The target of GUIDED, from its arrival to its end."""

    def __init__(self) -> None:
        self._target: Target | None = None
        self._since_ns = 0

    def clear(self) -> None:
        """The mode was entered or left: it stands until a setpoint comes."""
        self._target = None

    def take(self, target: Target, now_ns: int) -> None:
        """A setpoint arrived and was taken."""
        self._target, self._since_ns = target, now_ns

    def timed_out(self, now_ns: int, timeout_s: float) -> bool:
        """Whether the setpoint has just become older than that; it is forgotten then. Places never do."""
        if self._target is None or isinstance(self._target, Place):
            return False
        if now_ns - self._since_ns <= timeout_s * NS_PER_S:
            return False
        self._target = None
        return True

    def demand(self, pose: Pose, speed_max: float, radius: float) -> tuple[float, float]:
        """Speed (m/s) and yaw rate (rad/s) that it asks of itself now."""
        target = self._target
        if target is None:
            return 0.0, 0.0
        if isinstance(target, YawRate):
            return target
        if isinstance(target, Heading):
            return target.speed, STEERING_P * wrapped(target.yaw - pose.yaw)
        north, east = target.north - pose.north, target.east - pose.east
        distance = hypot(north, east)
        if distance <= radius:
            return 0.0, 0.0
        off = wrapped(atan2(east, north) - pose.yaw)
        way = max(0.0, distance - 0.5 * radius)
        speed = 0.0 if abs(off) > PIVOT_ANGLE else min(speed_max, sqrt(2.0 * STOPPING * way))
        return speed, STEERING_P * off
