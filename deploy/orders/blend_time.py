"""How long a fleet needs to come from one plan's motion to the next one's (PURE, numpy).

The blended motion of `agent.formation.reference` is, with p = r_new - r_old and S of the share of the blend
that is over,

    r_d' = (1 - S) r_old' + S r_new' + S' p
    r_d'' = (1 - S) r_old'' + S r_new'' + 2 S' p' + S'' p

What the blend adds to the accelerations of the two is kept below a third of what a robot can do, so that two
thirds are left to the law; the speed below the greatest one. S' is 15/8 at most, |S''| 10/sqrt(3).

r_old may be in a blend itself. The motion of the reference point and the places from there are blended alike,
each by itself; so a mission says what is left of both at some times of its blend (`left_of`): of the first as
it is, of places how far any is off at most. (Where more than `WITHIN_MAX` blends are within one another the
motion is another one, and this is only near.)
"""

from __future__ import annotations

from math import hypot
from typing import Final, NamedTuple

import numpy as np

from agent.common.time import NS_PER_S
from agent.control.safety_distances import speed_max
from agent.fleet.model import Fleet
from agent.formation.mission_plan import Plan
from agent.formation.points import Floats
from agent.formation.reference import BEND_MAX, RATE_MAX, blend_shape
from agent.messages.types import Left

BLEND_MIN_S: Final = 1.0
BLEND_MAX_S: Final = 600.0
_ACCELERATION_SHARE: Final = 1.0 / 3.0
_SPEED_SHARE: Final = 0.25
_SPEED_OVER: Final = 1.1
"""Where blends meet: so many times the greatest speed, as a bound says, may be less in truth."""
_WORTH: Final = 2.0
"""No more than so many times as long for the speed: the fleet would go on with what is over."""
_LONGER: Final = 1.1
_STEP: Final = 4
"""A mission says what is left at each of so many shares."""
_SHARES: Final = np.linspace(0.0, 1.0, 16 * _STEP + 1)
_SHAPE: Final = np.array([blend_shape(float(share)) for share in _SHARES])


class _Motions(NamedTuple):
    """At `_SHARES` of a blend from one plan to the next, (samples, ...) each.

    way, faster: from the reference point before to the one after, m, and how fast that changes, m/s.
    velocity: of the reference point before, m/s.
    places, rate: how far any place may still be from where the plan before has it, and how fast it comes
        there, m, m/s.
    reach: how far any place is from the reference point at most, m.
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


def blend_ns_for(before: Plan, after: Plan, fleet: Fleet) -> int | None:
    """Least blend, at least 1 s, in which the members' desired motion keeps the limits of `[control]`; None
    where there is none of `BLEND_MAX_S`.

    A new trajectory that is so fast that no blend keeps the speed (it has to be caught up with) is given one
    in which the change of places itself costs a quarter of the greatest speed at most. So is what is ordered
    in the midst of another blend, where that takes a tenth more than the greatest speed at most: what is
    known of places that already move is a bound.

    Args:
        before: the latest plan; `after`: the next one, whose `blend_ns` is not looked at.
    """
    most, acceleration_max = _limits(fleet)
    unfinished = after.from_ns < before.from_ns + before.blend_ns
    enough, seconds = 0.0, BLEND_MIN_S
    while seconds < BLEND_MAX_S:
        peaks = peaks_of(before, after, round(seconds * NS_PER_S), fleet)
        if peaks.acceleration <= acceleration_max:
            if peaks.speed <= most:
                return round(seconds * NS_PER_S)
            if not enough and RATE_MAX * peaks.to_go <= _SPEED_SHARE * most * seconds:
                enough = seconds
            if enough and unfinished and (peaks.speed <= _SPEED_OVER * most or seconds > _WORTH * enough):
                break
        seconds *= _LONGER
    return round(enough * NS_PER_S) if enough else None


def peaks_of(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> Peaks:
    """What a blend of this length asks for of those who have a place before and after."""
    moves = _moves(before, after)
    if not len(moves):
        return Peaks(0.0, 0.0, 0.0)
    old, seconds = _motions(before, after, blend_ns, fleet), blend_ns / NS_PER_S
    share, rate, bend = _SHAPE[:, 0], _SHAPE[:, 1] / seconds, _SHAPE[:, 2] / (seconds * seconds)

    def most(moves: Floats, places: Floats) -> Floats:
        """(3, samples): as `Peaks`, of `moves` and of what any place may be from there."""
        way = old.way + moves[:, None]  # (moves, samples, 2)
        velocity = old.velocity + share[:, None] * old.faster + rate[:, None] * way
        acceleration = 2.0 * rate[:, None] * old.faster + bend[:, None] * way
        speed, harder, far = (
            np.linalg.norm(each, axis=2).max(axis=0) for each in (velocity, acceleration, way)
        )
        speed += rate * places + (1.0 - share) * old.rate
        harder += np.abs(bend) * places + 2.0 * rate * old.rate
        return np.array((speed, harder, far + places))

    # Of places that are on their way, two things are known: how far from their places, and from the middle.
    bound = most(moves, old.places)
    if old.places[0] > 0.0:
        bound = np.minimum(bound, most(np.zeros((1, 2)), old.reach + _reach(after)))
    speed, harder, far = bound
    return Peaks(float(speed.max()), float(harder.max()), float(far[0]))


def left_of(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> tuple[Left, ...]:
    """What is left of the motion before `after` in a blend of this length (`Mission.left`)."""
    if not blend_ns:
        return (Left(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, _reach(after)),)
    old = _motions(before, after, blend_ns, fleet)
    share, rate = _SHAPE[:, 0], _SHAPE[:, 1] * NS_PER_S / blend_ns
    rest = 1.0 - share
    away = -rest[:, None] * old.way
    speed = rate[:, None] * old.way - rest[:, None] * old.faster
    moved = float(np.linalg.norm(_moves(before, after), axis=1).max(initial=0.0))
    further = np.minimum(moved + old.places, old.reach + _reach(after))
    reach = rest * old.reach + share * _reach(after)
    columns = np.column_stack((away, speed, rest * further, rate * further + rest * old.rate, reach))
    return tuple(Left(*(float(value) for value in row)) for row in columns[::_STEP])


def _limits(fleet: Fleet) -> tuple[float, float]:
    """The greatest speed, m/s, and acceleration, m/s^2, that blends may take."""
    return speed_max(fleet), _ACCELERATION_SHARE * fleet.control.max_acceleration


def _moves(before: Plan, after: Plan) -> Floats:
    """(n, 2): how much further from the reference point, m, those are to be who have a place in both."""
    stay = [robot for robot in after.members if robot in before.offsets]
    moves = [np.subtract(after.offsets[robot], before.offsets[robot]) for robot in stay]
    return np.unique(np.array(moves).reshape(-1, 2), axis=0)


def _reach(plan: Plan) -> float:
    """How far the members' places are from the reference point at most, m."""
    return max((hypot(x, y) for x, y in plan.offsets.values()), default=0.0)


def _motions(before: Plan, after: Plan, blend_ns: int, fleet: Fleet) -> _Motions:
    """Of a blend of this length."""
    times_ns = [after.from_ns + round(float(share) * blend_ns) for share in _SHARES]
    old, new = (np.array([plan.reference(time_ns)[:4] for time_ns in times_ns]) for plan in (before, after))
    left = _left(before, times_ns, fleet)
    old += left[:, :4]
    return _Motions(new[:, :2] - old[:, :2], new[:, 2:] - old[:, 2:], old[:, 2:], *left[:, 4:].T)


def _left(before: Plan, times_ns: list[int], fleet: Fleet) -> Floats:
    """(times, 7), as `Left`: what is left of the motion before that of `before`."""
    left = np.zeros((len(times_ns), 7))
    left[:, 6] = _reach(before)
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
    left[:, 4], left[:, 5] = way * (1.0 - shape[:, 0]), way * shape[:, 1] / seconds
    left[:, 6] += left[:, 4]
    return left


def _between(said: Floats, shares: Floats, seconds: float) -> Floats:
    """`Left` at shares of a blend, by that at equal ones: cubics through positions and velocities."""
    if len(said) < 2:
        return np.repeat(said, len(shares), axis=0)
    step_s = seconds / (len(said) - 1)
    first = np.minimum((shares * (len(said) - 1)).astype(int), len(said) - 2)
    s = (shares * (len(said) - 1) - first)[:, None]
    (p, v), (q, w) = ((row[:, :2], step_s * row[:, 2:4]) for row in (said[first], said[first + 1]))
    left: Floats = (1.0 - s) * said[first] + s * said[first + 1]
    left[:, :2] = p + s * (v + s * (3.0 * (q - p) - 2.0 * v - w + s * (2.0 * (p - q) + v + w)))
    left[:, 2:4] = (
        v + s * (2.0 * (3.0 * (q - p) - 2.0 * v - w) + 3.0 * s * (2.0 * (p - q) + v + w))
    ) / step_s
    return left
