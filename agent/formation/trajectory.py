"""Desired navigation of the formation's reference point: c(t), its first and second derivative.

Pure, and in plain floats: `Trajectory.at` runs several times in every control tick, where an array
costs more than the arithmetic. Positions are in W (world ENU), SI units, t is fleet time in
seconds (0 at the mission's epoch). Robot i is to drive r_d,i(t) = c(t) + offset_i: all desired
velocities are equal, which is the paper's condition A rdot_d = 0 (below (23) and (36)).

Before the epoch (t < 0) every trajectory holds at c(0), at rest.

Waypoints
    The path is a chain of straight legs, leg k driven at its own constant velocity, so c is the
    twice integrated sum of one bump of acceleration at every waypoint::

        v(t) = sum over waypoints of dv_k S((t - b_k) / T_k),    S(s) = 3 s^2 - 2 s^3 on [0, 1]

    with dv_k the change of velocity there (from rest at the first, to rest at the last), b_k the
    begin of its blend and T_k its length. S is antisymmetric about its middle, so outside the
    blends the reference is exactly on the legs, and exactly at rest on the first and last
    waypoint. |a| = |dv_k| S' / T_k peaks at 1.5 |dv_k| / T_k, hence T_k = 1.5 |dv_k| / a_max, and
    the acceleration is continuous: zero at both ends of a blend.
    A corner is cut by ``3/32 |dv_k| T_k = 9/64 |dv_k|^2 / a_max`` (`corner_distances`); where the
    path turns back on itself the reference turns that far before the waypoint.

    Blends of two neighbouring waypoints must not overlap. Where a leg is too short for that it is
    driven slower than asked (`legs`), its neighbours as fast as they can: the acceleration
    limit always holds, the speed gives way.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, ceil, cos, hypot, inf, isfinite, sin, sqrt, tau
from typing import Final, Protocol

from handfast.agent.common.quantities import Vector
from handfast.agent.fleet.sections import TrajectorySection

Sample = tuple[float, float, float, float, float, float]
"""x, y (m), vx, vy (m/s), ax, ay (m/s^2), in W."""

_PEAK: Final = 1.5  # greatest S'(s), at s = 1/2
_CUT: Final = 3.0 / 32.0  # integral of S over [0, 1/2]
_SLOWER: Final = 0.98  # a leg too short for its blends is slowed by this factor until it is not
_CIRCLE_STEP: Final = 0.1  # rad: the path's points on a circle
PATH_ERROR: Final = 0.00125  # 1 - cos(_CIRCLE_STEP / 2)
_BLEND_STEPS: Final = 8  # pieces of the path in a blend
_SAME: Final = 1e-9  # waypoints nearer than this to the one before are that one, m


class Trajectory(Protocol):
    """A desired navigation."""

    def at(self, t: float) -> Sample:
        """Position, velocity and acceleration of the reference at fleet time `t` (s), in W."""
        ...

    def path(self, since: float, until: float) -> list[Vector]:
        """Where the reference goes from fleet time `since` to `until` (s): points that straight lines join,
        m, W. The line is at most `PATH_ERROR` of a circle's radius, or a quarter of the depth of a cut
        corner, off.
        """
        ...


class _Line:
    """Constant velocity from `start_m`, the paper's: moving at full speed from t = 0 on."""

    __slots__ = ("_rest", "_vx", "_vy", "_x", "_y")

    def __init__(self, start: Vector, velocity: Vector) -> None:
        self._x, self._y = start
        self._vx, self._vy = velocity
        self._rest: Sample = (self._x, self._y, 0.0, 0.0, 0.0, 0.0)

    def at(self, t: float) -> Sample:
        if t < 0.0:
            return self._rest
        return self._x + self._vx * t, self._y + self._vy * t, self._vx, self._vy, 0.0, 0.0

    def path(self, since: float, until: float) -> list[Vector]:
        return [self.at(since)[:2], self.at(until)[:2]]


class _Hold:
    """At rest, always."""

    __slots__ = ("_rest",)

    def __init__(self, place: Vector) -> None:
        self._rest: Sample = (place[0], place[1], 0.0, 0.0, 0.0, 0.0)

    def at(self, t: float) -> Sample:
        return self._rest

    def path(self, since: float, until: float) -> list[Vector]:
        return [self._rest[:2]]


class _Circle:
    """Constant speed on a circle, from the angle `phase` (counter-clockwise from east) at t = 0."""

    __slots__ = ("_phase", "_radius", "_rate", "_rest", "_x", "_y")

    def __init__(self, centre: Vector, radius: float, rate: float, phase: float) -> None:
        self._x, self._y = centre
        self._radius = radius
        self._rate = rate  # rad/s, negative when clockwise
        self._phase = phase
        self._rest: Sample = (
            self._x + radius * cos(phase), self._y + radius * sin(phase), 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip

    def at(self, t: float) -> Sample:
        if t < 0.0:
            return self._rest
        rate = self._rate
        angle = self._phase + rate * t
        x = self._radius * cos(angle)
        y = self._radius * sin(angle)
        square = rate * rate
        return self._x + x, self._y + y, -rate * y, rate * x, -square * x, -square * y

    def path(self, since: float, until: float) -> list[Vector]:
        since = max(0.0, since)
        turned = min(abs(self._rate) * max(0.0, until - since), tau)
        count = ceil(turned / _CIRCLE_STEP)
        step = turned / (abs(self._rate) * max(1, count))
        return [self.at(since + k * step)[:2] for k in range(count + 1)]


class _Waypoints:
    """Straight legs with blended corners; see the module's head."""

    __slots__ = ("_begins", "_pieces", "_rest")

    def __init__(self, points: tuple[Vector, ...], speeds: tuple[float, ...], acceleration: float) -> None:
        changes = _velocity_changes(points, speeds)
        times = [_PEAK * hypot(*change) / acceleration for change in changes]
        # A piece is (begin, x, y, vx, vy, T, dvx, dvy): state at its begin and, in a blend, the
        # change of velocity over its length T; T = 0 marks a stretch of constant velocity.
        pieces: list[tuple[float, float, float, float, float, float, float, float]] = []
        middle = 0.5 * times[0]  # when the reference would be at waypoint 0 if it did not blend
        for k, (dvx, dvy) in enumerate(changes):
            if k > 0:
                middle += _length(points[k - 1], points[k]) / speeds[k - 1]
            vx, vy = _velocity(points, speeds, k - 1)
            window = times[k]
            if window > 0.0:
                # Places are computed from the waypoint, not summed up: no error adds along the path.
                x = points[k][0] - vx * 0.5 * window
                y = points[k][1] - vy * 0.5 * window
                pieces.append((middle - 0.5 * window, x, y, vx, vy, window, dvx, dvy))
            vx, vy = _velocity(points, speeds, k)
            x = points[k][0] + vx * 0.5 * window
            y = points[k][1] + vy * 0.5 * window
            pieces.append((middle + 0.5 * window, x, y, vx, vy, 0.0, 0.0, 0.0))
        self._pieces = pieces
        self._begins = [piece[0] for piece in pieces]
        self._rest: Sample = (points[0][0], points[0][1], 0.0, 0.0, 0.0, 0.0)

    @property
    def end(self) -> float:
        """When the reference comes to rest on the last waypoint, s."""
        return self._begins[-1]

    def at(self, t: float) -> Sample:
        if t <= 0.0:
            return self._rest
        begin, x, y, vx, vy, window, dvx, dvy = self._pieces[bisect_right(self._begins, t) - 1]
        since = t - begin
        if window == 0.0:
            return x + vx * since, y + vy * since, vx, vy, 0.0, 0.0
        s = since / window
        square = s * s
        share = square * (3.0 - 2.0 * s)  # S
        swept = window * square * s * (1.0 - 0.5 * s)  # T times the integral of S
        bump = 6.0 * s * (1.0 - s) / window  # S' / T
        return (
            x + vx * since + dvx * swept,
            y + vy * since + dvy * swept,
            vx + dvx * share,
            vy + dvy * share,
            dvx * bump,
            dvy * bump,
        )

    def path(self, since: float, until: float) -> list[Vector]:
        times = [since, until]
        for begin, _, _, _, _, window, _, _ in self._pieces:
            times += [begin + k * window / _BLEND_STEPS for k in range(_BLEND_STEPS if window else 1)]
        return [self.at(t)[:2] for t in sorted({min(max(t, since), until) for t in times})]


@dataclass(frozen=True, slots=True)
class Leg:
    """One straight leg of a waypoint trajectory.

    Attributes:
        length: m.
        speed: at which it is driven, m/s: less than asked where the leg is too short for its corners.
    """

    length: float
    speed: float


def make_trajectory(section: TrajectorySection) -> Trajectory:
    """The trajectory that a fleet file's [trajectory] describes.

    Raises:
        ValueError: a field that this kind needs is missing, not finite or out of range; it is named.
    """
    if section.kind == "hold":
        return _Hold(_pair("start_m", section.start_m))
    if section.kind == "line":
        return _Line(_pair("start_m", section.start_m), _pair("velocity_mps", section.velocity_mps))
    if section.kind == "circle":
        radius = _positive("radius_m", section.radius_m)
        speed = _positive("speed_mps", section.speed_mps)
        rate = -speed / radius if section.clockwise else speed / radius
        if not isfinite(section.phase_rad):
            raise ValueError(f"trajectory.phase_rad must be finite, not {section.phase_rad}")
        return _Circle(_pair("centre_m", section.centre_m), radius, rate, section.phase_rad)
    if section.kind == "waypoints":
        return _make_waypoints(section)
    raise ValueError(f"trajectory.kind must be line, hold, circle or waypoints, not {section.kind!r}")


def duration(section: TrajectorySection) -> float | None:
    """When the reference has come to rest for good, s; None when it never does."""
    if section.kind == "waypoints":
        trajectory = _make_waypoints(section)
        return trajectory.end if isinstance(trajectory, _Waypoints) else 0.0
    make_trajectory(section)  # raises on a bad section
    return 0.0 if maximum_speed(section) == 0.0 else None


def maximum_speed(section: TrajectorySection) -> float:
    """Greatest speed that the reference ever has, m/s."""
    make_trajectory(section)
    if section.kind == "line":
        return hypot(*_pair("velocity_mps", section.velocity_mps))
    if section.kind == "circle":
        return _positive("speed_mps", section.speed_mps)
    if section.kind == "waypoints":
        # In a blend the velocity is between those of the two legs: never above the faster one.
        return max((leg.speed for leg in legs(section)), default=0.0)
    return 0.0


def maximum_speed_along(section: TrajectorySection, nx: float, ny: float) -> float:
    """Greatest speed that the reference ever has along the line of the unit vector (nx, ny), W, m/s."""
    if section.kind == "line":
        vx, vy = _pair("velocity_mps", section.velocity_mps)
        return abs(nx * vx + ny * vy)
    if section.kind == "waypoints":  # in a blend the velocity is between those of the two legs
        points, speed, acceleration = _waypoint_fields(section)
        speeds = _leg_speeds(points, speed, acceleration)
        velocities = [_velocity(points, speeds, k) for k in range(len(speeds))]
        return max((abs(nx * vx + ny * vy) for vx, vy in velocities), default=0.0)
    return maximum_speed(section)


def maximum_acceleration(section: TrajectorySection) -> float:
    """Greatest |acceleration| that the reference ever has, m/s^2 (a line's start at speed not counted)."""
    make_trajectory(section)
    if section.kind == "circle":
        return _positive("speed_mps", section.speed_mps) ** 2 / _positive("radius_m", section.radius_m)
    if section.kind == "waypoints":
        return section.corner_acceleration if legs(section) else 0.0
    return 0.0


def legs(section: TrajectorySection) -> tuple[Leg, ...]:
    """Legs of a waypoint trajectory, with the speeds that they are driven at; empty for other kinds.

    A waypoint within 1e-9 m of the one before it makes no leg.
    """
    if section.kind != "waypoints":
        return ()
    points, speed, acceleration = _waypoint_fields(section)
    speeds = _leg_speeds(points, speed, acceleration)
    return tuple(Leg(_length(points[k], points[k + 1]), v) for k, v in enumerate(speeds))


def corner_distances(section: TrajectorySection) -> tuple[float, ...]:
    """How near the reference passes each waypoint at the middle of its blend, m.

    9/64 |dv|^2 / a_max; 0 at the first and the last waypoint, where it is at rest. One number for
    every waypoint that is not on the one before it; empty for other kinds.
    """
    if section.kind != "waypoints":
        return ()
    points, speed, acceleration = _waypoint_fields(section)
    changes = _velocity_changes(points, _leg_speeds(points, speed, acceleration))
    inner = [_CUT * _PEAK * (x * x + y * y) / acceleration for x, y in changes[1:-1]]
    return (0.0, *inner, 0.0) if len(points) > 1 else (0.0,)


def corner_turns(section: TrajectorySection) -> tuple[float, ...]:
    """By how much the reference turns at each waypoint, rad, 0 to pi; 0 at the first and the last one.

    One number for every waypoint that is not on the one before it; empty for other kinds.
    """
    if section.kind != "waypoints":
        return ()
    points, _, _ = _waypoint_fields(section)
    ways = [(bx - ax, by - ay) for (ax, ay), (bx, by) in pairwise(points)]
    turns = [abs(atan2(ax * by - ay * bx, ax * bx + ay * by)) for (ax, ay), (bx, by) in pairwise(ways)]
    return (0.0, *turns, 0.0) if ways else (0.0,)


def _make_waypoints(section: TrajectorySection) -> _Waypoints | _Hold:
    points, speed, acceleration = _waypoint_fields(section)
    if len(points) == 1:
        return _Hold(points[0])
    return _Waypoints(points, _leg_speeds(points, speed, acceleration), acceleration)


def _waypoint_fields(section: TrajectorySection) -> tuple[tuple[Vector, ...], float, float]:
    """Distinct waypoints, wanted speed and acceleration limit."""
    if not section.waypoints_m:
        raise ValueError("trajectory.waypoints_m must list at least one waypoint")
    points: list[Vector] = []
    for k, waypoint in enumerate(section.waypoints_m):
        point = _pair(f"waypoints_m[{k + 1}]", waypoint)
        if not points or _length(points[-1], point) > _SAME:
            points.append(point)
    speed = _positive("speed_mps", section.speed_mps)
    return tuple(points), speed, _positive("corner_acceleration", section.corner_acceleration)


def _leg_speeds(points: tuple[Vector, ...], speed: float, acceleration: float) -> tuple[float, ...]:
    """Speed of every leg: as asked, or as much slower as its two blends need to fit in it.

    The blends of leg k's ends take (T_k + T_k+1) / 2 of its time, length / v_k: it fits while
    0.75 v_k (|dv_k| + |dv_k+1|) <= a length. Slowing one leg changes dv for its neighbours, so the
    sweep repeats. Speeds only ever fall, and with v_k <= a length / (3 speed) a leg always fits
    (|dv| <= 2 speed): it ends.
    """
    lengths = [_length(a, b) for a, b in pairwise(points)]
    # From rest no leg is faster than this: v_k^2 - v_k-1^2 <= 2 v_k |dv_k| <= 8/3 a length. It only
    # saves steps.
    speeds = [min(speed, sqrt(8.0 / 3.0 * acceleration * sum(lengths)))] * len(lengths)
    waiting = set(range(len(lengths)))
    while waiting:
        k = min(waiting)
        waiting.discard(k)
        slowed = False
        while not _fits(points, lengths, speeds, k, acceleration):
            speeds[k] *= _SLOWER
            slowed = True
        if slowed:
            waiting.update(j for j in (k - 1, k + 1) if 0 <= j < len(lengths))
    return tuple(speeds)


def _fits(
    points: tuple[Vector, ...], lengths: list[float], speeds: list[float], k: int, acceleration: float
) -> bool:
    here = _velocity(points, speeds, k)
    before = _velocity(points, speeds, k - 1)
    after = _velocity(points, speeds, k + 1)
    change = hypot(here[0] - before[0], here[1] - before[1]) + hypot(after[0] - here[0], after[1] - here[1])
    return 0.5 * _PEAK * speeds[k] * change <= acceleration * lengths[k]


def _velocity_changes(points: tuple[Vector, ...], speeds: tuple[float, ...]) -> list[Vector]:
    """Change of velocity at every waypoint."""
    changes = []
    for k in range(len(points)):
        before, after = _velocity(points, speeds, k - 1), _velocity(points, speeds, k)
        changes.append((after[0] - before[0], after[1] - before[1]))
    return changes


def _velocity(points: tuple[Vector, ...], speeds: tuple[float, ...] | list[float], k: int) -> Vector:
    """Velocity on leg k; zero before the first and after the last."""
    if not 0 <= k < len(speeds):
        return 0.0, 0.0
    (ax, ay), (bx, by) = points[k], points[k + 1]
    scale = speeds[k] / _length(points[k], points[k + 1])
    return (bx - ax) * scale, (by - ay) * scale


def _length(a: Vector, b: Vector) -> float:
    return hypot(b[0] - a[0], b[1] - a[1])


def _pair(name: str, value: Vector | None) -> Vector:
    if value is None or not (isfinite(value[0]) and isfinite(value[1])):
        raise ValueError(f"trajectory.{name} must be two finite numbers, not {value}")
    return float(value[0]), float(value[1])


def _positive(name: str, value: float | None) -> float:
    if value is None or not 0.0 < value < inf:
        raise ValueError(f"trajectory.{name} must be above zero, not {value}")
    return float(value)
