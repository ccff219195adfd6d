"""The safety filter: the acceleration nearest to what the law asks for that keeps every limit (PURE).

Each limit is a half plane of the hand's acceleration u (m/s^2, W); how they come about is in
docs/theory.md, (F1) to (F9). `project` finds the nearest u that meets all of them, exactly, by
adding one plane at a time (Seidel 1991; linearProgram2 and 3 of ORCA, van den Berg et al. 2011).
Where they cannot all be met, the body's own limits come first, then separation, then separation from robots
whose place is only supposed, then speed.
"""

from __future__ import annotations

from math import cos, exp, hypot, inf, sin, sqrt
from typing import Final, NamedTuple

from handfast.agent.common.models import new
from handfast.agent.common.quantities import DISTANCE_MIN
from handfast.agent.control.hand import PoseTuple

BODY: Final = 0
STANDING: Final = 1
SEPARATION: Final = 2
UNSURE: Final = 3
SPEED: Final = 4
"""Ranks: where planes contradict each other, those of a lower rank are met first. A robot that would
collide may drive too fast; it cannot do what its actuators cannot; and between one that stands before it and
one that follows it, the one that follows can still make way."""

HARDER: Final = 4.0
"""1/s: so much harder it brakes for one that stands, by each m/s that it is faster than it may be: what has
been learned too late is made good with all that the body can do."""
LEAST_MAX: Final = 1e6
"""A plane that asks for more than this (m/s^2) is taken to ask for this much."""
_TOLERANCE: Final = 1e-9
_PARALLEL: Final = 1e-12
_ROOM: Final = 1.15
"""Of the limit of the yaw rate, for one that braking swings up to it: then braking is within `quickest`."""
_INWARD: Final = 1.0 - 1e-15


class HalfPlane:
    """``n . u >= least`` (m/s^2): n a unit vector (W); a zero n says nothing. `cause`: for reports."""

    __slots__ = "cause", "least", "nx", "ny", "rank"

    def __init__(self, nx: float, ny: float, least: float, cause: str, rank: int = SEPARATION) -> None:
        self.nx: Final = nx
        self.ny: Final = ny
        self.least: Final = least
        self.cause: Final = cause
        self.rank: Final = rank

    def asking(self, least: float) -> HalfPlane:
        """The same, but for how much it asks, m/s^2."""
        return HalfPlane(self.nx, self.ny, least, self.cause, self.rank)

    def ranked(self, rank: int) -> HalfPlane:
        """The same, but for its rank."""
        return HalfPlane(self.nx, self.ny, self.least, self.cause, rank)


class Filtered(NamedTuple):
    """What `project` gives.

    Attributes:
        ux, uy: acceleration, m/s^2, W.
        causes: whose limits changed it, in the order of the planes; empty: it is as it was asked for.
        violation: by how much the worst plane of another rank than `BODY` is not met, m/s^2; 0: all are.
    """

    ux: float
    uy: float
    causes: tuple[str, ...]
    violation: float


def keep_apart(
    cause: str,
    offset: tuple[float, float],
    velocity: tuple[float, float],
    other_velocity: tuple[float, float],
    gap: float,
    rate: float,
    *,
    growth: float = 0.0,
    alone: bool = False,
    straight: bool = False,
    other_acceleration: tuple[float, float] = (0.0, 0.0),
    rank: int = SEPARATION,
) -> HalfPlane:
    """Own part of keeping two hands apart, (F3), (F4).

    Args:
        offset: r_i - r_j, m, from the other to the own hand.
        velocity, other_velocity: of the own and the other's hand, m/s.
        gap: the distance to keep, m: r_s, a margin, and what is uncertain of the other's place.
        rate: p, 1/s; the same for all robots.
        growth: how fast the gap grows, m/s. The other knows nothing of it, so the own robot makes up for all
            of it, beyond what braking gives if need be (U2).
        alone: the other does not do its part: it brakes, is silent, or is no robot of ours.
        straight: it may be anywhere along a line across the offset, so that none is gained by driving along
            that, as in (F5).
        other_acceleration: what the other is known to do meanwhile, m/s^2; only counts if `alone`, and
            only as far as it brings the two together.
        rank: `STANDING`, `SEPARATION`, or `UNSURE`.
    """
    x, y = offset
    vx, vy = velocity
    ox, oy = other_velocity
    rho = hypot(x, y)
    if rho < DISTANCE_MIN:  # through each other: what parts them soonest is to go on
        x, y, rho = vx - ox, vy - oy, hypot(vx - ox, vy - oy)
        if rho == 0.0:
            return HalfPlane(0.0, 0.0, 0.0, cause, rank)
        nx, ny, rho, turn = x / rho, y / rho, 0.0, 0.0
    else:
        nx, ny = x / rho, y / rho
        across = nx * (vy - oy) - ny * (vx - ox)
        turn = 0.0 if straight else across * across / rho
    own, others = nx * vx + ny * vy, nx * ox + ny * oy
    both = -rate * (2.0 * (own - others) + rate * (rho - gap)) - turn  # (F2)
    # Half each, (F3), but never more than braking gives, of either of the two (F4).
    low, high = both - rate * others, -rate * own
    if low > high:  # they are closer than braking can mend
        least = 0.5 * (low + high)
    else:
        least = 0.5 * both  # in plain comparisons: this is asked for every robot around at every tick
        least = low if least < low else high if least > high else least
    if alone:
        push = nx * other_acceleration[0] + ny * other_acceleration[1]
        least = max(least, both + max(push, 0.0))
        if rank == STANDING:
            least += HARDER * max(0.0, others - own - rate * max(0.0, rho - gap))
    least += 2.0 * rate * growth
    return HalfPlane(nx, ny, least, cause, rank)


def keep_clear(
    cause: str,
    distance: float,
    nx: float,
    ny: float,
    velocity: tuple[float, float],
    clearance: float,
    rate: float,
) -> HalfPlane:
    """Keeps the hand `clearance` (m) away from what stands still, (F5).

    Args:
        distance: signed distance to it, m; `nx`, `ny`: its gradient, a unit vector towards the allowed side.
        velocity: of the own hand, m/s.
        rate: p, 1/s.
    """
    closing = nx * velocity[0] + ny * velocity[1]
    return HalfPlane(nx, ny, -rate * (2.0 * closing + rate * (distance - clearance)), cause)


def limit_speed(
    vx: float, vy: float, most: float, rate: float, cause: str = "speed", rank: int = SPEED
) -> tuple[HalfPlane, ...]:
    """Keeps the hand's speed at or below `most` (m/s), (F6); nothing at rest."""
    speed = hypot(vx, vy)
    if speed < DISTANCE_MIN:
        return ()
    return (HalfPlane(-vx / speed, -vy / speed, -rate * (most - speed), cause, rank),)


def limit_actuators(
    pose: PoseTuple,
    mass: float,
    inertia: float,
    reach: float,
    max_force: float | None,
    max_torque: float | None,
    cause: str = "actuators",
) -> tuple[HalfPlane, ...]:
    """The accelerations that the actuators can give the hand, (F7): a box along and across the heading.

    Args:
        mass (kg), inertia (kg m^2), reach: of the hand, L (m).
        max_force (N), max_torque (N m): None for no limit.
    """
    planes: tuple[HalfPlane, ...] = ()
    if max_force is None and max_torque is None:
        return planes
    _, _, heading, speed, yaw_rate = pose
    c, s = cos(heading), sin(heading)
    if max_force is not None:
        most, bias = max_force / mass, reach * yaw_rate * yaw_rate
        planes += (
            HalfPlane(c, s, -most - bias, cause, BODY),
            HalfPlane(-c, -s, -most + bias, cause, BODY),
        )
    if max_torque is not None:
        most, bias = reach * max_torque / inertia, -speed * yaw_rate
        planes += (
            HalfPlane(-s, c, -most - bias, cause, BODY),
            HalfPlane(s, -c, -most + bias, cause, BODY),
        )
    return planes


def turning_limit(speed: float, reach: float, most: float, rate: float) -> tuple[float, float]:
    """How fast a body may turn at a speed (m/s, along its heading), rad/s, and its derivative by that, (F9).

    `most`, but less for one that drives backwards faster than p L: to brake makes such a body swing round,
    and from this limit it swings up to `most` and no further.
    """
    backwards = -speed / (rate * reach)
    if backwards <= 1.0:
        return most, 0.0
    swing = most * exp(1.0 - backwards)
    return swing * backwards, swing * (backwards - 1.0) / (rate * reach)


def limit_turning(
    pose: PoseTuple, reach: float, most: float, rate: float, cause: str = "turning", *, quickest: float = inf
) -> tuple[HalfPlane, ...]:
    """Keeps the yaw rate within `turning_limit`, (F9): L wdot = u . (-sin, cos) - v w.

    A force that is held for a period while the body turns far points elsewhere at its end: what is asked of
    the hand is then not what it does. u = -p v of the hand meets both planes while the yaw rate is within.

    Args:
        reach: of the hand, L, m.
        most: rad/s.
        rate: p, 1/s; the yaw rate may come to its limit at twice that.
        quickest: the rate at which braking may take a turn away, or bring it to the limit, 1/s: held for a
            period, a quicker one would turn the body the other way, and faster.
    """
    _, _, heading, speed, turn = pose
    c, s = cos(heading), sin(heading)
    if speed >= -rate * reach:  # as below, with `most` for the limit and no slope: as nearly always
        bias, room = speed * turn, 2.0 * rate * reach
        left, right = bias + room * (most - turn), room * (most + turn) - bias
        braking = rate * reach * turn
        if turn > 0.0:
            right = max(right, min(braking, (quickest * reach - speed) * turn))
        elif turn < 0.0:
            left = max(left, min(-braking, (speed - quickest * reach) * turn))
        return HalfPlane(s, -c, -left, cause, BODY), HalfPlane(-s, c, -right, cause, BODY)
    limit, slope = turning_limit(speed, reach, most, rate)
    slope *= reach  # wdot <= 2 p (W - w) + W' vdot, with vdot = u . (cos, sin) + L w^2
    drift = reach * slope * turn * turn
    left = speed * turn + 2.0 * rate * reach * (limit - turn) + drift
    right = -speed * turn + 2.0 * rate * reach * (limit + turn) + drift
    # Whatever turn braking takes away may be taken away.
    braking, slowing = rate * reach * turn, slope * rate * speed
    if turn > 0.0:
        right = max(right, min(slowing + braking, (quickest * reach - speed) * turn))
    elif turn < 0.0:
        left = max(left, min(slowing - braking, (speed - quickest * reach) * turn))
    size = hypot(1.0, slope)
    planes = (
        HalfPlane((s + slope * c) / size, (slope * s - c) / size, -left / size, cause, BODY),
        HalfPlane((slope * c - s) / size, (slope * s + c) / size, -right / size, cause, BODY),
    )
    if quickest == inf:
        return planes
    # W' holds here, and one period may bring the body to where it is another one.
    bias, gain = speed * turn, quickest * reach
    return (
        *planes,
        HalfPlane(s, -c, -bias - gain * (_ROOM * most - turn), cause, BODY),
        HalfPlane(-s, c, bias - gain * (_ROOM * most + turn), cause, BODY),
    )


def project(ux: float, uy: float, planes: list[HalfPlane], most: float) -> Filtered:
    """The acceleration nearest to (ux, uy) that meets all `planes` and |u| <= `most`; m/s^2, W.

    Where no u meets all planes, those of rank `BODY` are met first, then of those of `STANDING` the largest
    violation is made least (then, of what is still free, the second largest, and so on), then of those of
    `SEPARATION`, `UNSURE` and `SPEED`; of what is left the nearest is taken. |u| <= `most` holds always.
    """
    size = hypot(ux, uy)
    tolerance = _TOLERANCE * (most if most > 1.0 else 1.0)
    if size <= most:
        for plane in planes:
            nx, ny = plane.nx, plane.ny
            if nx * ux + ny * uy < plane.least - tolerance and (nx or ny):
                break
        else:
            return new(Filtered, (ux, uy, (), 0.0))
    limits = [(plane.nx, plane.ny, _bounded(plane.least)) for plane in planes]
    found = _optimum(ux, uy, [limit for limit in limits if limit[0] or limit[1]], most, tolerance)
    if found is None:
        found = _compromise(ux, uy, limits, [plane.rank for plane in planes], most, tolerance)
    x, y = found
    size = hypot(x, y)
    if size > most:
        x, y = x * (most / size * _INWARD), y * (most / size * _INWARD)
    causes: list[str] = []
    violation = 0.0
    for (nx, ny, least), plane in zip(limits, planes, strict=True):
        short = least - nx * x - ny * y
        if short > -4.0 * tolerance and (nx or ny):
            if plane.cause not in causes:
                causes.append(plane.cause)
            if short > 4.0 * tolerance and short > violation and plane.rank != BODY:
                violation = short
    if size > most - tolerance:
        causes.append("acceleration")
    return new(Filtered, (x, y, tuple(causes), violation))


def _bounded(least: float) -> float:
    return -LEAST_MAX if least < -LEAST_MAX else LEAST_MAX if least > LEAST_MAX else least


_Limit = tuple[float, float, float]


def _optimum(
    x: float, y: float, limits: list[_Limit], most: float, tolerance: float, *, linear: bool = False
) -> tuple[float, float] | None:
    """The point nearest to (x, y), or if `linear` farthest in the direction (x, y), within the circle `most`
    that meets all limits; None if there is none.

    One limit at a time: if the optimum so far does not meet the next one, the new optimum is on its line.
    """
    size = hypot(x, y)
    if size == inf:
        x, y = 0.25 * x, 0.25 * y
        size = hypot(x, y)
    if size > most or (linear and size > 0.0):
        ux, uy = x / size * most, y / size * most
    else:
        ux, uy = x, y
    for count, (nx, ny, least) in enumerate(limits):
        if nx * ux + ny * uy >= least:
            continue
        if least > most:
            if least > most + tolerance:
                return None
            least = most
        # On the line: u = least n + s t with t = (-ny, nx).
        high = sqrt(most * most - least * least) if least > -most else 0.0
        low = -high
        for index in range(count):
            ax, ay, needed = limits[index]
            slope = ay * nx - ax * ny
            missing = needed - least * (ax * nx + ay * ny)
            if slope > _PARALLEL:
                if missing > low * slope:
                    low = missing / slope
            elif slope < -_PARALLEL:
                if missing > high * slope:
                    high = missing / slope
            elif missing > tolerance:
                return None
        if low > high:
            return None
        s = y * nx - x * ny
        if linear:
            s = high if s > 0.0 else low
        elif s > high:
            s = high
        elif s < low:
            s = low
        ux, uy = least * nx - s * ny, least * ny + s * nx
    return ux, uy


def _compromise(
    x: float, y: float, limits: list[_Limit], ranks: list[int], most: float, tolerance: float
) -> tuple[float, float]:
    """As `_optimum`, where the limits contradict each other: some are violated by as little as possible."""
    kept: list[_Limit] = []
    best = 0.0, 0.0
    for rank in (BODY, STANDING, SEPARATION, UNSURE, SPEED):
        left = [
            limit for limit, its in zip(limits, ranks, strict=True) if its == rank and (limit[0] or limit[1])
        ]
        while True:
            found = _optimum(x, y, kept + left, most, tolerance)
            if found is not None or not left:
                break
            index, short, best = _least_violation(kept, left, most, tolerance, best)
            nx, ny, least = left.pop(index)
            kept.append((nx, ny, least - short - tolerance))
        if found is not None:
            best = found
        kept += left
    return best


def _least_violation(
    kept: list[_Limit], left: list[_Limit], most: float, tolerance: float, best: tuple[float, float]
) -> tuple[int, float, tuple[float, float]]:
    """The least that the worst of `left` has to be violated by while `kept` is met.

    Returns a limit that is violated by so much wherever the worst is, the amount, and a point.
    `best`: a point that meets `kept`.
    """
    worst, index = 0.0, 0
    for count, (nx, ny, least) in enumerate(left):
        if least - nx * best[0] - ny * best[1] <= worst:
            continue
        # Adding this one makes the least violation larger, so this one has it: no other one more.
        bisectors = list(kept)
        for ax, ay, needed in left[:count]:
            bx, by = ax - nx, ay - ny
            size = hypot(bx, by)
            if size > _PARALLEL:
                bisectors.append((bx / size, by / size, (needed - least) / size - tolerance))
        found = _optimum(nx, ny, bisectors, most, tolerance, linear=True)
        if found is not None:
            best = found
        larger = least - nx * best[0] - ny * best[1]
        if larger > worst + 4.0 * tolerance:  # else it came to meet another that has it already
            index = count
        worst = max(worst, larger)
    return index, worst, best
