"""Scenarios in which many robots cross each other's ways while messages are late (PURE). Lengths in m, W.

All start on a circle or in two rows, and the places of all are on the other side: who makes way for others
there is not where those expect it that know it by old messages.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Final

from agent.common.quantities import Vector
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape, apart_m
from deploy.chaos.draw_obstacles import draw_obstacles
from deploy.chaos.profiles import pieces

ROBOTS: Final = (4, 12)
ROOM: Final = (1.1, 1.8)
"""Least and most between two starts next to each other, in least distances of places."""
DELAY_MS: Final = (300, 1000)
LOSS_MAX: Final = 50.0
CROSS_S: Final = (15.0, 35.0)
LATE_S: Final = 120.0
"""Drives last so long in which messages stay late to the end: then all are in formation at last."""
RECOVERED_S: Final = 21.0
_RATES_HZ: Final = ((10, 1.0), (15, 2.0), (20, 3.0), (25, 1.0))


def draw_late(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("late", seed)
    safe_m = dice.between(0.2, 0.35, 2)
    control, speed = pieces.draw_fast_control(dice, seed)
    control.pop("prediction_horizon_s", None)
    rate_hz = dice.weighted(_RATES_HZ)
    control |= pieces.timeouts(rate_hz)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    starts = _starts(dice, ids, dice.between(*ROOM) * apart_m(safe_m))
    offsets = {robot: (-x, -y) for robot, (x, y) in starts.items()}
    edges = dice.weighted(
        ((_ring(ids), 2.0), ([(i, i + 1) for i in ids[:-1]], 1.0), ([(1, i) for i in ids[1:]], 1.0))
    )
    heals = dice.chance(0.75)
    cross_s = dice.between(*CROSS_S, 1)
    reach_m = pieces.draw_reach(dice, speed, rate_hz)
    course, duration_s = _trajectory(dice, speed), cross_s + RECOVERED_S if heals else LATE_S
    shape = Shape(offsets, edges)
    tables = pieces.meeting(seed, rate_hz, duration_s, shape, safe_m, control, course, reach_m)
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    tables["robot"] = pieces.robots_at(dice, starts, (), reach_m)
    if dice.chance(0.3):
        obstacles = draw_obstacles(Dice("obstacles", seed), tables, pieces.places_of(tables))
        if obstacles:
            tables["obstacle"] = obstacles[:2]
    tables["faults"] = {"rule": [_links(dice, ids, cross_s if heals else None)]}
    return tables


def _starts(dice: Dice, ids: list[int], apart: float) -> dict[int, Vector]:
    """On a circle, or in two rows that face each other, so far apart; turned as it comes."""
    turn, number = dice.between(0.0, 2.0 * pi), len(ids)
    if dice.chance(0.6):
        radius = max(1.5, 0.5 * apart / sin(pi / number))
        points = [(radius * cos(2.0 * pi * k / number), radius * sin(2.0 * pi * k / number)) for k in ids]
    else:
        gap, columns = dice.between(2.0, 5.0), (number + 1) // 2
        points = [
            ((0.5 - k // columns) * gap, apart * (k % columns - 0.5 * (columns - 1))) for k in range(number)
        ]
    found = {robot: pieces.turned(point, turn) for robot, point in zip(ids, points, strict=True)}
    return {robot: (round(x, 3), round(y, 3)) for robot, (x, y) in found.items()}


def _ring(ids: list[int]) -> list[tuple[int, int]]:
    """Each and the next one on the circle."""
    pairs = zip(ids, [*ids[1:], ids[0]], strict=True)
    return sorted({(min(pair), max(pair)) for pair in pairs})


def _trajectory(dice: Dice, speed: float) -> Tables:
    if dice.chance(0.6):
        return {"kind": "hold"}
    return pieces.line(dice.between(0.05, 0.3) * speed, 2.0 * pi * dice.share())


def _links(dice: Dice, ids: list[int], until_s: float | None) -> Tables:
    """All messages between some robots and others are late, both ways or one, and some lost."""
    rule: Tables = {"name": "late 1"}
    if dice.chance(0.3):
        some = dice.some(ids, max(1, len(ids) // 2))
        others = [robot for robot in ids if robot not in some]
        arrow = dice.pick(("->", "<->"))
        rule["link"] = f"{','.join(map(str, some))}{arrow}{','.join(map(str, others))}"
    late_ms = dice.whole(*DELAY_MS)
    how = dice.weighted((("delay", 3.0), ("jitter", 1.0), ("slot", 1.0)))
    if how == "slot":
        rule["slot"] = f"{late_ms}ms"
    else:
        rule["delay"] = f"{late_ms}ms" if how == "delay" else f"{late_ms}ms {dice.whole(10, late_ms // 4)}ms"
    if dice.chance(0.8):
        rule["loss"] = f"{dice.between(10.0, LOSS_MAX, 1):g}%"
    if until_s is not None:
        rule |= {"at": 0.0, "for": until_s}
    return rule
