"""Scenarios in which a formation is ordered to change while some do not hear others (PURE). Lengths in m, W.

Everybody hears the operator. Who is cut off, one way or both, or deaf to a few, does not know that the others
follow the order too, nor they that it does. New places lie on the other side, or are those of others: ways
lead through each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Final

from agent.common.quantities import Vector
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape, apart_m, draw_shape
from deploy.chaos.profiles import pieces

ROBOTS: Final = (3, 6)
SIZE: Final = (2.0, 5.0)
"""So many times as large are some: long edges pull hard."""
CUT_S: Final = (0.5, 8.0)
ORDER_S: Final = (-0.5, 12.0)
"""After the cut."""
AFTER_S: Final = 35.0
"""From the last order to the end."""
ROW: Final = (1.1, 2.2)
"""Least and most between two places in a row, in least distances of places."""
_RATES_HZ: Final = ((15, 1.0), (20, 3.0), (30, 1.0))


def draw_reordered(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("reordered", seed)
    size = dice.between(*SIZE) if dice.chance(0.6) else 1.0
    safe_m = round(size * dice.between(0.2, 0.35), 2)
    control, speed = pieces.draw_fast_control(dice, seed)
    control["max_speed_mps"] = speed = round(size**0.5 * speed, 2)
    control["max_acceleration"] = round(size**0.5 * control["max_acceleration"], 1)
    rate_hz = dice.weighted(_RATES_HZ)
    control |= pieces.timeouts(rate_hz)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    shape = _row(dice, ids, safe_m) if dice.chance(0.75) else draw_shape(Dice("shape", seed), ids, safe_m)
    reach_m = pieces.draw_reach(dice, speed, rate_hz)
    cut_s = dice.between(*CUT_S, 2)
    times = sorted(round(max(0.0, cut_s + dice.between(*ORDER_S)), 2) for _ in range(dice.whole(1, 2)))
    course, duration_s = _trajectory(dice, speed), times[-1] + AFTER_S
    tables = pieces.meeting(seed, rate_hz, duration_s, shape, safe_m, control, course, reach_m)
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    places = shape.offsets
    tables["robot"] = pieces.robots_at(dice, places, (), reach_m)
    orders: list[Tables] = []
    for at in times:
        places = _others(dice, places)
        order: Tables = {"at": at, "kind": "reshape"}
        order["formation"] = {"offsets": [[round(x, 3), round(y, 3)] for x, y in places.values()]}
        orders.append(order)
    tables["order"] = orders
    tables["faults"] = {"rule": [_deaf(dice, ids, cut_s)]}
    return tables


def _row(dice: Dice, ids: list[int], safe_m: float) -> Shape:
    """All in one line, each tied to the next one."""
    apart, angle, middle = dice.between(*ROW) * apart_m(safe_m), dice.between(0.0, pi), 0.5 * (len(ids) - 1)
    places = {robot: pieces.turned((apart * (k - middle), 0.0), angle) for k, robot in enumerate(ids)}
    return Shape(places, [(i, i + 1) for i in ids[:-1]])


def _others(dice: Dice, places: Mapping[int, Vector]) -> dict[int, Vector]:
    """Where the robots are to be instead: mirrored, turned about, or each in another one's place."""
    kind = dice.weighted((("mirror", 3.0), ("turn", 1.0), ("shuffle", 1.0)))
    if kind == "shuffle":
        step = dice.whole(1, max(1, len(places) - 1))
        given = list(places.values())
        return dict(zip(places, given[step:] + given[:step], strict=True))
    angle = pi if kind == "mirror" else dice.between(0.5 * pi, 1.5 * pi)
    return {robot: pieces.turned(place, angle) for robot, place in places.items()}


def _trajectory(dice: Dice, speed: float) -> Tables:
    if dice.chance(0.6):
        return {"kind": "hold"}
    return pieces.line(dice.between(0.1, 0.3) * speed, dice.between(-pi, pi))


def _deaf(dice: Dice, ids: list[int], at: float) -> Tables:
    """Who does not hear whom, from then to the end, or for a while that is longer than a link is forgiven."""
    number = dice.whole(1, len(ids) - 1)
    group = ids[:number] if dice.chance(0.6) else dice.some(ids, number)
    rest = [robot for robot in ids if robot not in group]
    ways = (group, rest) if dice.chance(0.5) else (rest, group)
    a, b = (",".join(map(str, each)) for each in ways)
    kind = dice.weighted((("one way", 4.0), ("both", 1.0), ("some", 1.0)))
    rule: Tables = {"name": "cut 1", "at": at}
    if kind == "both":
        rule["partition"] = f"{a} | {b}"
    elif kind == "one way":
        rule |= {"link": f"{a}->{b}", "loss": "100%"}
    else:
        pairs = [f"{i}->{j}" for i in ids for j in ids if i != j]
        rule |= {"link": dice.some(pairs, dice.whole(1, len(pairs) // 2)), "loss": "100%"}
    if dice.chance(0.3):
        rule["for"] = dice.between(5.0, 20.0, 1)
    return rule
