"""Scenarios in which robots cross each other's ways and do not hear each other (PURE). Lengths in m, W.

Two groups start out of sight of each other, and their places lie beyond each other's: they meet half way.
From before that, often from before the start, one does not hear the other, or neither does; in some to the
end. Who has never been heard is where the fleet file says until it is heard.
"""

from __future__ import annotations

from math import pi
from typing import Final

from agent.common.quantities import Vector
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape, draw_shape
from deploy.chaos.draw_orders import draw_orders
from deploy.chaos.profiles import pieces

GROUP_MAX: Final = 3
WAY_M: Final = (7.0, 13.0)
"""Least and most between the groups at the start: out of sensing range, most of them."""
BEGIN_S: Final = 1.0
"""They are cut off before they have moved."""
CALM_S: Final = 8.0
"""At the end all have had the time to stand."""
RECOVERED_S: Final = 21.0
_RATES_HZ: Final = ((10, 2.0), (15, 3.0), (20, 2.0), (30, 0.5))


def draw_cut_off(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("cut-off", seed)
    safe_m = dice.between(0.2, 0.35, 2)
    control, speed = pieces.draw_fast_control(dice, seed)
    rate_hz = dice.weighted(_RATES_HZ)
    control |= pieces.timeouts(rate_hz)
    sizes = dice.whole(1, GROUP_MAX), dice.whole(1, GROUP_MAX)
    ids = list(range(1, sum(sizes) + 1))
    first = dice.some(ids, sizes[0])
    groups = first, [robot for robot in ids if robot not in first]
    reach_m = pieces.draw_reach(dice, speed, rate_hz)
    starts, shape, bridge, way_m = _crossing(dice, groups, safe_m)
    heal = dice.chance(0.4)
    met_s = way_m / speed + 3.0
    ends_s = round(met_s + dice.between(0.0, 8.0, 1), 1)
    course, duration_s = _trajectory(dice, speed), ends_s + (RECOVERED_S if heal else CALM_S)
    tables = pieces.meeting(seed, rate_hz, duration_s, shape, safe_m, control, course, reach_m)
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    tables["robot"] = pieces.robots_at(dice, starts, (), reach_m)
    if dice.chance(0.25):
        orders, _ = draw_orders(
            Dice("orders", seed), tables, ends_s, lambda d, here: _turn_back(d, here, speed)
        )
        if orders:
            tables["order"] = orders
    tables["faults"] = {"rule": _cut(dice, groups, bridge, ends_s if heal else None)}
    return tables


def _crossing(
    dice: Dice, groups: tuple[list[int], list[int]], safe_m: float
) -> tuple[dict[int, Vector], Shape, tuple[int, int], float]:
    """Starts, the formation of all, its edge between the groups, and how far they go.

    Each group is a small shape that goes straight on: towards the other, across its way, or aslant.
    """
    way_m = dice.between(*WAY_M)
    across = dice.weighted(((pi, 4.0), (0.5 * pi, 1.0), (dice.between(0.3 * pi, 0.9 * pi), 2.0)))
    beside_m = dice.between(-0.4, 0.4)
    starts: dict[int, Vector] = {}
    offsets: dict[int, Vector] = {}
    edges: list[tuple[int, int]] = []
    for number, group in enumerate(groups):
        shape = draw_shape(dice, group, safe_m)
        angle = number * across
        along, sideways = 0.5 * way_m + (0.0 if number == 0 else dice.between(-0.3, 0.3)), number * beside_m
        for robot, (x, y) in shape.offsets.items():
            starts[robot] = _rounded(pieces.turned((x - along, y + sideways), angle))
            offsets[robot] = _rounded(pieces.turned((x + along, y + sideways), angle))
        edges += shape.edges
    # Places of two groups never lie on one another: they are a way apart, but where the angle is small.
    bridge = dice.pick(groups[0]), dice.pick(groups[1])
    edges.append((min(bridge), max(bridge)))
    return dict(sorted(starts.items())), Shape(offsets, sorted(edges)), bridge, way_m


def _rounded(place: Vector) -> Vector:
    return round(place[0], 3), round(place[1], 3)


def _trajectory(dice: Dice, speed: float) -> Tables:
    if dice.chance(0.7):
        return {"kind": "hold"}
    return pieces.line(dice.between(0.02, 0.15) * speed, 2.0 * pi * dice.share())


def _turn_back(dice: Dice, here: Vector, speed: float) -> Tables:
    """A course that an order gives: slow, as places are far apart."""
    return pieces.draw_trajectory(dice, here, 0.5 * speed)


def _cut(
    dice: Dice, groups: tuple[list[int], list[int]], bridge: tuple[int, int], until_s: float | None
) -> list[Tables]:
    """One group does not hear the other, or neither hears, from the first second on.

    Those that share no edge may never have heard each other; with an edge they must, for the fleet to start.
    """
    a, b = (",".join(map(str, group)) for group in groups)
    kind = dice.weighted((("both", 3.0), ("one way", 2.0), ("alone", 1.0)))
    if kind == "both":
        rule: Tables = {"name": "partition 1", "partition": f"{a} | {b}"}
    elif kind == "alone":
        rule = {"name": "partition 1", "partition": f"alone {dice.pick(dice.pick(groups))}"}
    else:
        rule = {"name": "deaf 1", "link": dice.pick((f"{a}->{b}", f"{b}->{a}")), "loss": "100%"}
    at = dice.between(0.0, BEGIN_S, 2)
    rules = [{**rule, "at": at} if until_s is None else {**rule, "at": at, "for": round(until_s - at, 2)}]
    ways = groups if dice.chance(0.5) else groups[::-1]
    strangers = [f"{i}->{j}" for i in ways[0] for j in ways[1] if {i, j} != set(bridge)]
    if strangers and until_s is None and dice.chance(0.4):
        rules.append({"name": "strangers 2", "link": strangers, "loss": "100%"})
    return rules
