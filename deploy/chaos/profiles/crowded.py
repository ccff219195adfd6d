"""Scenarios in which many robots start in each other's places, in a lattice, and some die amid them (PURE).

All have to cross, there is no free way to most places, and who is pressed by others has a body beside it that
nobody hears any more. Messages are late and lost; at times groups do not hear each other. Lengths in m, W.
"""

from __future__ import annotations

from math import pi
from typing import Final

from agent.common.quantities import Vector
from deploy.analysis.lattice import edges, places
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape
from deploy.chaos.profiles import pieces

ROBOTS: Final = (20, 30)
SPACING_M: Final = (0.9, 1.1)
SAFE_M: Final = (0.2, 0.25)
SCATTER_M: Final = 0.12
"""Robots start so far beside a place in x and in y at most."""
SPEED_MPS: Final = (0.6, 0.9)
DELAY_MS: Final = (200, 400)
LOSS: Final = (10.0, 35.0)
DEAD_MAX: Final = 3
DIES_S: Final = (2.0, 9.0)
CUT_S: Final = (3.0, 8.0)
TIMEOUT_PERIODS: Final = 4.5
DURATION_S: Final = 45.0
_COURSE_SHARES: Final = (0.05, 0.4)
_RATES_HZ: Final = ((10, 4.0), (15, 1.0))


def draw_crowded(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("crowded", seed)
    rate_hz = dice.weighted(_RATES_HZ)
    speed = dice.between(*SPEED_MPS, 2)
    reach_m = pieces.draw_reach(dice, speed, rate_hz)
    control: Tables = {"max_speed_mps": speed, "max_acceleration": dice.between(1.5, 4.0, 1)}
    control |= pieces.timeouts(rate_hz)
    if dice.chance(0.7):  # as the lattices have it that `handfast new` makes
        timeout_s = round(TIMEOUT_PERIODS / rate_hz, 2)
        control |= {"rate_min_hz": 0.5 * rate_hz, "plant_timeout_s": timeout_s, "wrench_timeout_s": timeout_s}
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    shape = _patch(ids, dice.between(*SPACING_M))
    course: Tables = {"kind": "hold"}
    if dice.chance(0.5):
        angle = 2.0 * pi * dice.share()
        course_mps = dice.between(*_COURSE_SHARES) * speed
        course = (
            pieces.circle(dice, (0.0, 0.0), dice.between(3.0, 5.0, 1), course_mps, angle)
            if dice.chance(0.5)
            else pieces.line(course_mps, angle)
        )
    safe_m = dice.between(*SAFE_M, 2)
    tables = pieces.meeting(seed, rate_hz, DURATION_S, shape, safe_m, control, course, reach_m)
    left, order = list(shape.offsets.values()), Dice("starts", seed)
    starts = {robot: _beside(order, left.pop(order.whole(0, len(left) - 1))) for robot in ids}
    tables["robot"] = pieces.robots_at(dice, starts, (), reach_m)
    rules = _deaths(dice, ids)
    if dice.chance(0.9):
        rules.append(_late_links(dice))
    if dice.chance(0.4):
        cut_s = dice.between(*CUT_S, 1)
        rules.append(
            {"name": "cut 1", "partition": _groups(dice, ids), "at": dice.between(2.0, 20.0, 1), "for": cut_s}
        )
    if rules:
        tables["faults"] = {"rule": rules}
    return tables


def _patch(ids: list[int], spacing: float) -> Shape:
    """A piece of a triangular lattice, about as wide as high: who is amid others is so on all sides."""
    spots = places(len(ids))
    offsets = {
        robot: (round(x * spacing, 3), round(y * spacing, 3))
        for robot, (x, y) in zip(ids, spots, strict=True)
    }
    return Shape(offsets, edges(spots))


def _beside(dice: Dice, place: Vector) -> Vector:
    x, y = place
    return x + dice.between(-SCATTER_M, SCATTER_M), y + dice.between(-SCATTER_M, SCATTER_M)


def _deaths(dice: Dice, ids: list[int]) -> list[Tables]:
    """Some agents die for good, most with their bodies."""
    dead = dice.some(ids, dice.whole(1, DEAD_MAX))
    return [
        {
            "name": f"dead {robot}",
            "robot": robot,
            "kill": "both" if dice.chance(0.7) else "agent",
            "at": dice.between(*DIES_S, 1),
        }
        for robot in dead
    ]


def _late_links(dice: Dice) -> Tables:
    """Of all links, all the time."""
    late_ms = dice.whole(*DELAY_MS)
    rule: Tables = {"name": "links 1", "delay": f"{late_ms}ms {dice.whole(0, late_ms // 3)}ms"}
    if dice.chance(0.8):
        rule["loss"] = f"{dice.between(*LOSS, 1):g}%"
    return rule


def _groups(dice: Dice, ids: list[int]) -> str:
    """One half and the other, or two that share a robot: both have more than half."""
    if dice.chance(0.4):
        return "majorities"
    first = dice.some(ids, len(ids) // 2)
    second = [robot for robot in ids if robot not in first]
    return f"{','.join(map(str, first))} | {','.join(map(str, second))}"
