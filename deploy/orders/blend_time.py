"""How long a fleet needs to come from one plan's motion to the next one's (PURE, numpy).

The blended motion of `agent.formation.reference` is, with p = r_new - r_old and S of the share of the blend
that is over,

    r_d' = (1 - S) r_old' + S r_new' + S' p
    r_d'' = (1 - S) r_old'' + S r_new'' + 2 S' p' + S'' p

What the blend adds to the accelerations of the two is kept below a third of what a robot can do, so that two
thirds are left to the law; the speed below the greatest one. S' is 15/8 at most, |S''| 10/sqrt(3).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from agent.common.time import NS_PER_S
from agent.control.safety_distances import speed_max
from agent.fleet.model import Fleet
from agent.formation.mission_plan import Plan
from agent.formation.reference import BEND_MAX, RATE_MAX, blend_shape

BLEND_MIN_S: Final = 1.0
BLEND_MAX_S: Final = 600.0
_ACCELERATION_SHARE: Final = 1.0 / 3.0
_SPEED_SHARE: Final = 0.25
_LONGER: Final = 1.1
_SAMPLES: Final = 65


def blend_ns_for(before: Plan, after: Plan, fleet: Fleet) -> int | None:
    """Least blend, at least 1 s, in which the members' desired motion keeps the limits of `[control]`; None
    where there is none of `BLEND_MAX_S`.

    A new trajectory that is so fast that no blend keeps the speed (it has to be caught up with) is given one
    in which the change of places itself costs a quarter of the greatest speed at most.

    Args:
        before: the latest plan; `after`: the next one, whose `blend_ns` is not looked at.
    """
    control = fleet.control
    most, acceleration_max = speed_max(fleet), _ACCELERATION_SHARE * control.max_acceleration
    stay = [robot for robot in after.members if robot in before.offsets]
    if not stay:
        return round(BLEND_MIN_S * NS_PER_S)
    moves = np.array([after.offsets[robot] for robot in stay]) - np.array([before.offsets[r] for r in stay])
    moves = np.unique(moves, axis=0)
    unfinished = _unfinished(before, after.from_ns, most, acceleration_max)
    shares = np.linspace(0.0, 1.0, _SAMPLES)
    shape = np.array([blend_shape(float(s)) for s in shares])
    start = np.array(after.reference(after.from_ns)[:2]) - before.reference(after.from_ns)[:2] + moves
    to_go = float(np.hypot(*start.T).max()) + unfinished
    enough, seconds = 0.0, BLEND_MIN_S
    while seconds < BLEND_MAX_S:
        times_ns = [after.from_ns + round(float(s) * seconds * NS_PER_S) for s in shares]
        old = np.array([before.reference(time_ns) for time_ns in times_ns])
        new = np.array([after.reference(time_ns) for time_ns in times_ns])
        share, rate, bend = shape[:, 0], shape[:, 1] / seconds, shape[:, 2] / (seconds * seconds)
        way = (new - old)[None, :, 0:2] + moves[:, None]  # (moves, samples, 2)
        faster = (new - old)[:, 2:4]
        velocity = old[:, 2:4] + share[:, None] * faster + rate[:, None] * way
        acceleration = 2.0 * rate[:, None] * faster + bend[:, None] * way
        speeds = np.linalg.norm(velocity, axis=2) + rate * unfinished
        accelerations = np.linalg.norm(acceleration, axis=2) + np.abs(bend) * unfinished
        if accelerations.max() <= acceleration_max:
            if speeds.max() <= most:
                return round(seconds * NS_PER_S)
            if not enough and RATE_MAX * to_go <= _SPEED_SHARE * most * seconds:
                enough = seconds
        seconds *= _LONGER
    return round(enough * NS_PER_S) if enough else None


def _unfinished(before: Plan, from_ns: int, speed_max: float, acceleration_max: float) -> float:
    """How far the motion may still be from that of `before`, m: as far as its own blend allowed it to be."""
    since_ns = from_ns - before.from_ns
    if before.from_ns <= before.mission.epoch_ns or since_ns >= before.blend_ns:
        return 0.0
    seconds = before.blend_ns / NS_PER_S
    way = min(speed_max * seconds / RATE_MAX, acceleration_max * seconds * seconds / BEND_MAX)
    return way * (1.0 - blend_shape(max(0, since_ns) / before.blend_ns)[0])
