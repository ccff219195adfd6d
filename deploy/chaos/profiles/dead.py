"""Scenarios of minutes in which agents die for good and their bodies stay (PURE). Lengths in m, W.

The dead are replaced, sent away by an order, or left in the formation; the others pass where they stand, at
once or a minute later, and some of them start again and know nothing of all that.
"""

from __future__ import annotations

from itertools import combinations
from math import atan2, cos, dist, pi, sin
from typing import Final

from agent.common.quantities import Vector
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape, apart_m, draw_shape
from deploy.chaos.draw_obstacles import draw_obstacles
from deploy.chaos.profiles import pieces

MEMBERS: Final = (3, 5)
FORGOTTEN_S: Final = 60.0
"""Who is silent for so long was once taken to be gone: drives go on for longer."""
AFTER_S: Final = 25.0
"""Drives end so long after the last thing happened."""
REMOVED: Final = 0.3
"""Share of the scenarios in which bodies are carried off."""
REMOVED_S: Final = (3.0, 10.0)
"""So long after the last that happened to the robot: nobody hears it then."""
_RATES_HZ: Final = ((10, 3.0), (12, 2.0), (15, 1.0), (20, 0.5))


def draw_dead(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    return _draw(seed, restarts=False)


def draw_restarted(seed: int) -> Tables:
    """The same, with living ones that start again when others have been dead for a minute."""
    return _draw(seed, restarts=True)


def _draw(seed: int, *, restarts: bool) -> Tables:
    dice = Dice("dead", seed)
    safe_m = dice.between(0.2, 0.35, 2)
    control = pieces.draw_control(Dice("control", seed))
    rate_hz = dice.weighted(_RATES_HZ)
    control |= pieces.timeouts(rate_hz)
    members, spares = dice.whole(*MEMBERS), dice.whole(0, 1) + dice.whole(0, 1)
    ids = list(range(1, members + spares + 1))
    reserve = set(dice.some(ids, spares))
    places = [robot for robot in ids if robot not in reserve]
    shape = draw_shape(Dice("shape", seed), places, safe_m)
    rules, orders, last_s = _deaths(dice, places, sorted(reserve))
    if restarts or dice.chance(0.5):
        last_s += FORGOTTEN_S
    if restarts:
        dead = {rule["robot"] for rule in rules}
        rules += _restarts(dice, [robot for robot in ids if robot not in dead], last_s)
    duration_s = last_s + AFTER_S
    trajectory = _trajectory(dice, shape, control["max_speed_mps"], duration_s)
    rows = Dice("rows", seed)
    straight = rows.chance(0.4)
    if straight:
        shape = _in_rows(rows, places, safe_m)
        trajectory = _along_rows(rows, control["max_speed_mps"], duration_s)
        if rows.chance(0.5):  # the dead stay members
            orders = []
    reach_m = dice.between(0.1, 0.2, 2)
    tables: Tables = {
        "fleet": pieces.fleet(seed, rate_hz, duration_s),
        "formation": pieces.formation(shape, places, safe_m, assign=dice.chance(0.5)),
        "control": control,
        "trajectory": trajectory,
        "robot_defaults": pieces.plain_body(reach_m),
    }
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    apart = pieces.START_FACTOR * safe_m
    side = max(2.5, 1.2 * shape.span, 2.5 * apart * len(ids) ** 0.5)
    tables["robot"] = pieces.robots_about(Dice("robots", seed), ids, reserve, side, apart, reach_m)
    if straight and not reserve and rows.chance(0.7):
        tables["robot"] = pieces.robots_at(Dice("robots", seed), shape.offsets, (), reach_m)
    obstacles = draw_obstacles(Dice("obstacles", seed), tables, pieces.places_of(tables))
    if obstacles and dice.chance(0.3):
        tables["obstacle"] = obstacles[:2]
    orders += _removals(Dice("removed", seed), rules, orders)
    if orders:
        tables["order"] = sorted(orders, key=lambda order: float(order["at"]))
    tables["faults"] = {"rule": rules}
    return tables


def _deaths(dice: Dice, members: list[int], reserve: list[int]) -> tuple[list[Tables], list[Tables], float]:
    """Rules and orders of one or two deaths that leave two at least, and when the last of it happens."""
    rules: list[Tables] = []
    orders: list[Tables] = []
    spares, last_s = list(reserve), 0.0
    for number, robot in enumerate(dice.some(members, min(dice.whole(1, 2), len(members) - 2)), 1):
        dies_s = dice.between(2.0, 15.0, 2)
        role = dice.weighted((("agent", 5.0), ("both", 1.0)))
        rules.append({"name": f"process {number}", "robot": robot, "kill": role, "at": dies_s})
        what = dice.weighted(
            (("replace", 4.0 if spares else 0.0), ("leave", 2.0), ("leaves first", 2.0), ("stays", 2.0))
        )
        orders_s = round(dies_s + dice.between(0.3, 8.0), 2)
        if what == "replace":
            orders.append({"at": orders_s, "kind": "replace", "robot": robot, "by": spares.pop()})
        elif what == "leave":
            orders.append({"at": orders_s, "kind": "leave", "robot": robot})
        elif what == "leaves first":  # and dies as one in reserve
            rules[-1]["at"] = orders_s
            orders.append({"at": dies_s, "kind": "leave", "robot": robot})
        last_s = max(last_s, orders_s)
    return rules, orders, last_s


def _removals(dice: Dice, rules: list[Tables], orders: list[Tables]) -> list[Tables]:
    """In some, orders that say that bodies have been carried off the field."""
    found: list[Tables] = []
    if dice.chance(REMOVED):
        for rule in rules:
            if "kill" in rule and "for" not in rule and dice.chance(0.7):
                robot = rule["robot"]
                last_s = max([rule["at"], *(order["at"] for order in orders if order["robot"] == robot)])
                found.append({
                    "at": round(last_s + dice.between(*REMOVED_S), 2), "kind": "remove", "robots": [robot],
                })  # fmt: skip
    return found


def _restarts(dice: Dice, living: list[int], from_s: float) -> list[Tables]:
    """Some of the living start again: at once, after some seconds, or after most of the drive."""
    rules: list[Tables] = []
    for number, robot in enumerate(dice.some(living, dice.whole(1, 2)), 8):
        at = round(from_s + dice.between(0.0, 8.0), 2)
        kind = dice.weighted((("at once", 2.0), ("soon", 2.0), ("late", 1.0)))
        rule: Tables = {"name": f"process {number}", "robot": robot}
        if kind == "at once":
            rule |= {"restart": "agent", "at": at}
        else:
            down_s = dice.between(0.5, 5.0, 2) if kind == "soon" else dice.between(30.0, 50.0, 2)
            rule |= {"kill": "agent", "at": round(at - down_s, 2), "for": down_s}
        rules.append(rule)
    return rules


def _trajectory(dice: Dice, shape: Shape, speed_max: float, duration_s: float) -> Tables:
    """A course that comes back to where it was: it stays, goes to and fro, or round.

    To and fro mostly along the line of two places, so that one robot comes where the other was.
    """
    kind = dice.weighted((("hold", 2.0), ("to and fro", 4.0), ("circle", 2.0)))
    if kind == "hold":
        return {"kind": "hold"}
    speed, angle = dice.between(0.1, 0.4) * speed_max, 2.0 * pi * dice.share()
    if kind == "circle":
        return pieces.circle(dice, (0.0, 0.0), dice.between(0.8, 2.5, 2), speed, angle)
    if dice.chance(0.7):
        one, other = dice.some(list(shape.offsets.values()), 2)
        angle = atan2(other[1] - one[1], other[0] - one[0])
    bend = 0.3 if dice.chance(0.5) else 0.02
    points: list[Vector] = [(0.0, 0.0)]
    left_m = speed * duration_s
    while len(points) < 2 or (left_m > _LEG_MIN_M and len(points) < _POINTS_MAX):
        there = _ahead(points[-1], angle, min(max(left_m, _LEG_MIN_M), dice.between(2.0, 7.0)))
        left_m -= ((there[0] - points[-1][0]) ** 2 + (there[1] - points[-1][1]) ** 2) ** 0.5
        points.append(there)
        angle += pi + dice.between(-bend, bend)
    return {
        "kind": "waypoints",
        "waypoints_m": [[round(x, 3), round(y, 3)] for x, y in points],
        "speed_mps": round(speed, 3),
    }


_POINTS_MAX: Final = 8
_LEG_MIN_M: Final = 0.5


def _in_rows(dice: Dice, robots: list[int], safe_m: float) -> Shape:
    """As people lay formations out: in two rows along the axis, one of them as long as can be made."""
    spacing = round(dice.between(1.0, 1.8) * apart_m(safe_m), 1)
    front = min(len(robots), dice.whole(3, 4))
    points = [(k * spacing, 0.0) for k in range(front)]
    points += [((k + 0.5) * spacing, 0.866 * spacing) for k in range(len(robots) - front)]
    offsets = {robot: (round(x, 3), round(y, 3)) for robot, (x, y) in zip(robots, points, strict=True)}
    edges = [(i, j) for i, j in combinations(robots, 2) if dist(offsets[i], offsets[j]) < 1.01 * spacing]
    return Shape(offsets, edges)


def _along_rows(dice: Dice, speed_max: float, duration_s: float) -> Tables:
    """To and fro along the axis: the rows come back to the same lines, to the bit."""
    speed, side = dice.between(0.1, 0.3) * speed_max, 1.0 if dice.chance(0.5) else -1.0
    points, left_m = [[0.0, 0.0]], speed * duration_s
    while len(points) < 2 or (left_m > _LEG_MIN_M and len(points) < _POINTS_MAX):
        x = side * round(dice.between(1.0, 6.0))
        left_m -= abs(x - points[-1][0])
        points.append([x, 0.0])
        side = -side
    return {"kind": "waypoints", "waypoints_m": points, "speed_mps": round(speed, 3)}


def _ahead(place: Vector, angle: float, way: float) -> Vector:
    return place[0] + way * cos(angle), place[1] + way * sin(angle)
