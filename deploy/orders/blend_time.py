"""How long a fleet needs to come from one plan's motion to the next one's (PURE, numpy).

The blended motion of `agent.formation.reference` is, with p = r_new - r_old and S of the share of the blend
that is over,

    r_d' = (1 - S) r_old' + S r_new' + S' p
    r_d'' = (1 - S) r_old'' + S r_new'' + 2 S' p' + S'' p

What the blend adds to the accelerations of the two is kept below a third of what a robot can do, so that two
thirds are left to the law; the speed below the greatest one. S' is 15/8 at most, |S''| 10/sqrt(3).

r_old may be in a blend itself. The motion of the reference point, the mean of the places from there and each
place from that mean are blended alike, each by itself; so a mission says what is left of them at some times
of its blend (`left_of`): of the first two as it is, of places how far any is off at most. (Where more than
`WITHIN_MAX` blends are within one another the motion is another one, and this is only near.)
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.limits import speed_max
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.formation.points import Floats
from handfast.agent.formation.reference import BEND_MAX, RATE_MAX, blend_shape
from handfast.agent.messages.types import Left

BLEND_MIN_S: Final = 1.0
BLEND_MAX_S: Final = 600.0
_ACCELERATION_SHARE: Final = 1.0 / 3.0
_SPEED_SHARE: Final = 0.25
_SPEED_OVER: Final = 1.1
"""Where blends meet: so many times the greatest speed, as a bound says, may be less in truth."""
_WORTH: Final = 2.0
"""No more than so many times as long for the speed: the fleet would go on with what is over."""
_LONGER: Final = 1.1
_STEP: Final = 5
"""A mission says what is left at each of so many shares."""
_SHARES: Final = np.linspace(0.0, 1.0, 12 * _STEP + 1)
_SHAPE: Final = np.array([blend_shape(float(share)) for share in _SHARES])


class _Motions(NamedTuple):
    """At `_SHARES` of a blend from one plan to the next, (samples, ...) each.

    way, faster: from the reference point before to the one after, and from the mean of the places there
        before to that after, (samples, 2, 2), m, and how fast that changes, m/s.
    velocity: of the mean place before, m/s.
    places, rate: how far any place may still be from where the plan before has it, from the mean, and how
        fast it comes there, m, m/s.
    reach: how far any place is from the mean at most, m.
    """

    way: Floats
    faster: Floats
    velocity: Floats
    places: Floats
    rate: Floats
    reach: Floats


class Peaks(NamedTuple):
    """The most of the members' desired motion in a blend: speed, m/s, and what the blend adds to the
    acceleration, m/s^2; and how far places are to go as it begins, m."""

    speed: float
    acceleration: float
    to_go: float


def blend_ns_for(before: Plan, after: Callable[[int], Plan], fleet: Fleet) -> int | None:
    """Least blend, at least 1 s, in which the members' desired motion keeps the limits of `[control]`; None
    where there is none of `BLEND_MAX_S`.

    A new trajectory that is so fast that no blend keeps the speed (it has to be caught up with) is given one
    in which the change of places itself costs a quarter of the greatest speed at most. So is what is ordered
    in the midst of another blend, where that takes a tenth more than the greatest speed at most: what is
    known of places that already move is a bound.

    Args:
        before: the latest plan; `after`: the next one for a blend of so many ns.
    """
    most, acceleration_max = _limits(fleet)
    unfinished = after(0).from_ns < before.from_ns + before.blend_ns
    to_go = peaks_of(before, after(0), NS_PER_S, fleet).to_go
    first, best, seconds = inf, (inf, 0), BLEND_MIN_S
    while seconds < min(BLEND_MAX_S, _WORTH * first):
        blend_ns = round(seconds * NS_PER_S)
        peaks = peaks_of(before, after(blend_ns), blend_ns, fleet)
        if peaks.acceleration <= acceleration_max:
            if peaks.speed <= most:
                return blend_ns
            if RATE_MAX * to_go <= _SPEED_SHARE * most * seconds and (unfinished or not best[1]):
                best = min(best, (peaks.speed, blend_ns))
                if unfinished:
                    first = min(first, seconds)
                    if peaks.speed <= _SPEED_OVER * most:
                        break
        seconds *= _LONGER
    return best[1] or None


def peaks_of(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> Peaks:
    """What a blend of this length asks for of those who have a place before and after."""
    moves = _moves(before, after)
    if not len(moves):
        return Peaks(0.0, 0.0, 0.0)
    old, seconds = _motions(before, after, blend_ns, fleet), blend_ns / NS_PER_S
    share, rate, bend = _SHAPE[:, 0], _SHAPE[:, 1] / seconds, _SHAPE[:, 2] / (seconds * seconds)
    faster = old.faster.sum(axis=1)

    def most(moves: Floats, places: Floats) -> Floats:
        """(3, samples): as `Peaks`, of `moves` and of what any place may be from there."""
        way = old.way.sum(axis=1) + moves[:, None]  # (moves, samples, 2)
        velocity = old.velocity + share[:, None] * faster + rate[:, None] * way
        acceleration = 2.0 * rate[:, None] * faster + bend[:, None] * way
        speed, harder, far = (
            np.linalg.norm(each, axis=2).max(axis=0) for each in (velocity, acceleration, way)
        )
        speed += rate * places + (1.0 - share) * old.rate
        harder += np.abs(bend) * places + 2.0 * rate * old.rate
        return np.array((speed, harder, far + places))

    # Of places that are on their way, two things are known: how far from their places, and from the mean.
    bound = most(moves, old.places)
    if old.places[0] > 0.0:
        bound = np.minimum(bound, most(np.zeros((1, 2)), old.reach + _reach(after)))
    speed, harder, far = bound
    return Peaks(float(speed.max()), float(harder.max()), float(far[0]))


def reference_at(before: Plan, time_ns: int, fleet: Fleet) -> Vector:
    """Where the motion before the next plan has the reference point, m: by the latest plan, or on the way to
    that."""
    x, y = before.reference(time_ns)[:2]
    left = _left(before, [time_ns], fleet)[0]
    return x + float(left[0]), y + float(left[1])


def left_of(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> tuple[Left, ...]:
    """What is left of the motion before `after` in a blend of this length (`Mission.left`)."""
    if not blend_ns:
        return (Left(*(0.0,) * 10, _reach(after)),)
    old = _motions(before, after, blend_ns, fleet)
    share, rate = _SHAPE[:, 0], _SHAPE[:, 1] * NS_PER_S / blend_ns
    rest = 1.0 - share
    away = -rest[:, None, None] * old.way
    speed = rate[:, None, None] * old.way - rest[:, None, None] * old.faster
    moved = float(np.linalg.norm(_moves(before, after), axis=1).max(initial=0.0))
    further = np.minimum(moved + old.places, old.reach + _reach(after))
    reach = rest * old.reach + share * _reach(after)
    means = np.concatenate((away, speed), axis=2).reshape(len(rest), 8)
    columns = np.column_stack((means, rest * further, rate * further + rest * old.rate, reach))
    return tuple(Left(*(float(value) for value in row)) for row in columns[::_STEP])


def _limits(fleet: Fleet) -> tuple[float, float]:
    """The greatest speed, m/s, and acceleration, m/s^2, that blends may take."""
    return speed_max(fleet), _ACCELERATION_SHARE * fleet.control.max_acceleration


def _mean(plan: Plan) -> Floats:
    """(2,): the mean of the members' places, m, from the reference point."""
    mean: Floats = np.array(list(plan.offsets.values()) or [(0.0, 0.0)]).mean(axis=0)
    return mean


def _moves(before: Plan, after: Plan) -> Floats:
    """(n, 2): how much further from the mean place, m, those are to be who have a place in both."""
    stay = [robot for robot in after.members if robot in before.offsets]
    moves = [np.subtract(after.offsets[robot], before.offsets[robot]) for robot in stay]
    return np.unique(np.array(moves).reshape(-1, 2), axis=0) - (_mean(after) - _mean(before))


def _reach(plan: Plan) -> float:
    """How far the members' places are from their mean at most, m."""
    mean_x, mean_y = _mean(plan)
    return max((hypot(x - mean_x, y - mean_y) for x, y in plan.offsets.values()), default=0.0)


def _motions(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> _Motions:
    """Of a blend of this length."""
    times_ns = [after.from_ns + round(float(share) * blend_ns) for share in _SHARES]
    left = _left(before, times_ns, fleet)
    old, new = np.zeros((2, len(times_ns), 2, 4))
    for motion, plan in ((old, before), (new, after)):
        motion[:, 0] = [plan.reference(time_ns)[:4] for time_ns in times_ns]
        motion[:, 1, :2] = _mean(plan)
    old += left[:, :8].reshape(-1, 2, 4)
    way = new - old
    return _Motions(way[..., :2], way[..., 2:], old[..., 2:].sum(axis=1), *left[:, 8:].T)


def _left(before: Plan, times_ns: list[int], fleet: Fleet) -> Floats:
    """(times, 11), as `Left`: what is left of the motion before that of `before`."""
    left = np.zeros((len(times_ns), 11))
    left[:, 10] = _reach(before)
    if before.from_ns <= before.mission.epoch_ns or not before.blend_ns:
        return left
    shares = np.clip(np.subtract(times_ns, before.from_ns) / before.blend_ns, 0.0, 1.0)
    if before.mission.left:
        said = np.array(before.mission.left)
        return np.where(shares[:, None] < 1.0, _between(said, shares, before.blend_ns / NS_PER_S), left)
    # A program that does not say it: as far as that blend allowed it to be.
    seconds = before.blend_ns / NS_PER_S
    speed_most, acceleration_max = _limits(fleet)
    way = min(speed_most * seconds / RATE_MAX, acceleration_max * seconds * seconds / BEND_MAX)
    shape = np.array([blend_shape(float(share)) for share in shares])
    left[:, 8], left[:, 9] = way * (1.0 - shape[:, 0]), way * shape[:, 1] / seconds
    left[:, 10] += left[:, 8]
    return left


def _between(said: Floats, shares: Floats, seconds: float) -> Floats:
    """`Left` at shares of a blend, by that at equal ones: cubics through positions and velocities."""
    if len(said) < 2:
        return np.repeat(said, len(shares), axis=0)
    step_s = seconds / (len(said) - 1)
    first = np.minimum((shares * (len(said) - 1)).astype(int), len(said) - 2)
    s = (shares * (len(said) - 1) - first)[:, None]
    left: Floats = (1.0 - s) * said[first] + s * said[first + 1]
    for at in (0, 4):
        (p, v), (q, w) = (
            (row[:, at : at + 2], step_s * row[:, at + 2 : at + 4]) for row in (said[first], said[first + 1])
        )
        b, c = 3.0 * (q - p) - 2.0 * v - w, 2.0 * (p - q) + v + w
        left[:, at : at + 2] = p + s * (v + s * (b + s * c))
        left[:, at + 2 : at + 4] = (v + s * (2.0 * b + 3.0 * s * c)) / step_s
    return left
