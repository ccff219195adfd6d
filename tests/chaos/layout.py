"""Random formations, starts, courses, obstacles and geofences. Lengths in m, frame W."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, pairwise
from math import atan2, ceil, cos, dist, exp, hypot, log, pi, sin
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.common.quantities import Vector
from handfast.agent.fleet.safety import FENCE_WARN_M
from handfast.agent.formation.points import assign_slots
from handfast.deploy.analysis.shapes import edges as patch_edges
from handfast.deploy.analysis.shapes import places as patch_places
from tests.chaos.dice import Dice, Range, Tables

APART_FACTOR: Final = 2.2
"""Minimum distance of two places, in safe distances: robots without a common edge have to keep apart."""
START_FACTOR: Final = 1.5
"""Minimum distance of two hands at the start, in safe distances."""
_APART_MIN_M: Final = 0.6
_ADJACENT: Final = 1.01
_OBSTACLES_MAX: Final = 6
_OBSTACLE_CLEARANCE_M: Final = 0.35
"""Clearance between an obstacle and a hand at the start, beyond what robots keep from obstacles."""
_FENCE_CLEARANCE_M: Final = 3.0
"""Minimum distance between a place and the geofence: evasive manoeuvres need room."""


class Shape(NamedTuple):
    """A formation: the place of every robot, and its edges."""

    offsets: Mapping[int, Vector]
    edges: Sequence[tuple[int, int]]

    @property
    def span(self) -> float:
        """Largest distance of two places."""
        return max((dist(a, b) for a, b in combinations(self.offsets.values(), 2)), default=0.0)


def apart_m(safe_m: float) -> float:
    """Return the minimum distance of two places."""
    return max(_APART_MIN_M, APART_FACTOR * safe_m)


def turned(place: Vector, angle: float) -> Vector:
    """Return a place turned counter-clockwise about the origin."""
    x, y = place
    return x * cos(angle) - y * sin(angle), x * sin(angle) + y * cos(angle)


def rounded(place: Vector) -> Vector:
    """Return a place rounded to millimetres."""
    return round(place[0], 3), round(place[1], 3)


def log_between(dice: Dice, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform between those of `low` and `high`."""
    return round(exp(log(low) + log(high / low) * dice.share()), 3)


# --- formations -------------------------------------------------------------------------------------


def draw_graph(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw scattered places, joined by a spanning tree of short edges and some more edges."""
    places: list[Vector] = []
    radius = 0.6 * spacing * len(robots) ** 0.5
    while len(places) < len(robots):
        place = turned((radius * dice.share() ** 0.5, 0.0), 2.0 * pi * dice.share())
        if all(dist(place, other) >= spacing for other in places):
            places.append(place)
        else:
            radius *= 1.01  # a disc that is too full grows
    inside, edges = [0], set[tuple[int, int]]()
    while len(inside) < len(robots):
        outside = [k for k in range(len(robots)) if k not in inside]
        nearest = sorted((dist(places[a], places[b]), a, b) for a in inside for b in outside)
        _, a, b = dice.pick(nearest[:3])
        edges.add((min(a, b), max(a, b)))
        inside.append(b)
    for a, b in combinations(range(len(robots)), 2):
        if (a, b) not in edges and dice.chance(0.35 / (1.0 + dist(places[a], places[b]))):
            edges.add((a, b))
    return _shape(robots, places, [(robots[a], robots[b]) for a, b in edges])


def draw_lattice(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw a piece of a triangular lattice that grows cell by cell: rigid or nearly so."""
    turn = dice.between(0.0, pi)
    cells = [(0, 0)]
    around = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))
    while len(cells) < len(robots):
        (a, b), (da, db) = dice.pick(cells), dice.pick(around)
        if (a + da, b + db) not in cells:
            cells.append((a + da, b + db))
    places = [turned((spacing * (a + 0.5 * b), spacing * 0.75**0.5 * b), turn) for a, b in cells]
    return _shape(robots, places, _adjacent(robots, places, spacing))


def draw_patch(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw a triangular lattice that is about as wide as it is high."""
    spots = patch_places(len(robots))
    edges = [(robots[i - 1], robots[j - 1]) for i, j in patch_edges(spots)]
    return _shape(robots, [(spacing * x, spacing * y) for x, y in spots], edges)


def draw_row(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw a row, each robot tied to the next one."""
    apart, angle = dice.between(1.0, 1.6) * spacing, dice.between(0.0, pi)
    places = [turned((apart * k, 0.0), angle) for k in range(len(robots))]
    return _shape(robots, places, list(pairwise(robots)))


def draw_rows(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw two rows along the axis, as people lay formations out."""
    spacing = round(spacing, 1)
    front = min(len(robots), dice.whole(3, 4))
    places = [(k * spacing, 0.0) for k in range(front)]
    places += [((k + 0.5) * spacing, 0.75**0.5 * spacing) for k in range(len(robots) - front)]
    offsets = dict(zip(robots, map(rounded, places), strict=True))
    return Shape(offsets, _adjacent(robots, places, spacing))


def draw_ring(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """Draw a circle, or two rows that face each other, with edges round it, along it or from one to all."""
    number, turn = len(robots), 2.0 * pi * dice.share()
    if dice.chance(0.6):
        radius = max(1.5, 0.5 * spacing / sin(pi / number))
        places = [turned((radius, 0.0), turn + 2.0 * pi * k / number) for k in range(number)]
    else:
        gap, columns = dice.between(2.0, 5.0), (number + 1) // 2
        places = [turned(((0.5 - k // columns) * gap, spacing * (k % columns)), turn) for k in range(number)]
    chain = list(pairwise(robots))
    ring = sorted({*chain, (robots[0], robots[-1])})
    star = [(robots[0], robot) for robot in robots[1:]]
    return _shape(robots, places, dice.weighted(((ring, 2.0), (chain, 1.0), (star, 1.0))))


SHAPES: Final[Mapping[str, Callable[[Dice, Sequence[int], float], Shape]]] = {
    "graph": draw_graph,
    "lattice": draw_lattice,
    "patch": draw_patch,
    "row": draw_row,
    "rows": draw_rows,
    "ring": draw_ring,
}


def _shape(robots: Sequence[int], places: Sequence[Vector], edges: Sequence[tuple[int, int]]) -> Shape:
    """Return a shape whose places have their centre at the origin."""
    x, y = (sum(place[axis] for place in places) / len(places) for axis in (0, 1))
    centred = [rounded((a - x, b - y)) for a, b in places]
    return Shape(dict(zip(robots, centred, strict=True)), sorted((min(e), max(e)) for e in edges))


def _adjacent(robots: Sequence[int], places: Sequence[Vector], spacing: float) -> list[tuple[int, int]]:
    pairs = combinations(zip(robots, places, strict=True), 2)
    return [(i, j) for (i, a), (j, b) in pairs if dist(a, b) < _ADJACENT * spacing]


def nearest_slots(shape: Shape, before: Mapping[int, Vector]) -> Shape:
    """Give the places of a shape to the robots so that they have the least to drive."""
    robots, places = list(shape.offsets), list(shape.offsets.values())
    costs = np.array([[dist(before[robot], place) ** 2 for place in places] for robot in robots])
    taken = list(zip(robots, assign_slots(costs), strict=True))
    taker = {robots[slot]: robot for robot, slot in taken}
    edges = sorted((min(taker[i], taker[j]), max(taker[i], taker[j])) for i, j in shape.edges)
    return Shape({robot: places[slot] for robot, slot in taken}, edges)


def draw_crossing(
    dice: Dice, groups: Sequence[Sequence[int]], safe_m: float
) -> tuple[dict[int, Vector], Shape, float]:
    """Draw two groups that start out of sight of each other and whose places lie beyond each other.

    Returns:
        starts, the formation of all, and how far they drive. The last edge joins the groups.
    """
    path_m = dice.between(7.0, 13.0)
    across = dice.weighted(((pi, 4.0), (0.5 * pi, 1.0), (dice.between(0.3 * pi, 0.9 * pi), 2.0)))
    starts: dict[int, Vector] = {}
    offsets: dict[int, Vector] = {}
    edges: list[tuple[int, int]] = []
    for number, group in enumerate(groups):
        shape = dice.pick((draw_graph, draw_lattice))(dice, group, dice.between(1.0, 1.8) * apart_m(safe_m))
        along, sideways = 0.5 * path_m + number * dice.between(-0.3, 0.3), number * dice.between(-0.4, 0.4)
        for robot, (x, y) in shape.offsets.items():
            starts[robot] = rounded(turned((x - along, y + sideways), number * across))
            offsets[robot] = rounded(turned((x + along, y + sideways), number * across))
        edges += shape.edges
    a, b = (dice.pick(group) for group in groups)
    ordered = {robot: offsets[robot] for robot in sorted(offsets)}
    return dict(sorted(starts.items())), Shape(ordered, [*edges, (min(a, b), max(a, b))]), path_m


# --- starts -----------------------------------------------------------------------------------------


def draw_anywhere(dice: Dice, robots: Sequence[int], side: float, apart: float) -> dict[int, Vector]:
    """Draw hands in a square of this side about the origin, no two nearer than `apart`."""
    return draw_near(dice, dict.fromkeys(robots, (0.0, 0.0)), 0.5 * side, apart)


def draw_near(dice: Dice, places: Mapping[int, Vector], off: float, apart: float) -> dict[int, Vector]:
    """Draw hands up to `off` from these places in x and in y, no two nearer than `apart`."""
    hands: dict[int, Vector] = {}
    for robot, (x, y) in places.items():
        while True:
            hand = x + dice.between(-off, off), y + dice.between(-off, off)
            if all(dist(hand, other) >= apart for other in hands.values()):
                break
        hands[robot] = hand
    return hands


def robot_rows(dice: Dice, hands: Mapping[int, Vector], reserve: Sequence[int], reach: float) -> list[Tables]:
    """Return ``[[robot]]`` with hands at these places and random headings."""
    rows: list[Tables] = []
    for robot, (x, y) in sorted(hands.items()):
        heading = dice.between(-pi, pi)
        row: Tables = {"id": robot, "x_m": round(x - reach * cos(heading), 4)}
        row |= {"y_m": round(y - reach * sin(heading), 4), "heading_rad": heading}
        rows.append(row | ({"reserve": True} if robot in reserve else {}))
    return rows


# --- courses ----------------------------------------------------------------------------------------


def draw_course(dice: Dice, kind: str, here: Vector, speed: float, length_m: float, shape: Shape) -> Tables:
    """Draw a trajectory that begins at or near `here`.

    Args:
        kind: that of a fleet file, or ``to and fro``.
        length_m: how far a course to and fro goes in all. It mostly follows the line of two places, so that
            one robot comes where another was.
    """
    (x, y), angle = here, 2.0 * pi * dice.share()
    if kind == "line":
        return {"kind": kind, "velocity_mps": [round(speed * cos(angle), 3), round(speed * sin(angle), 3)]}
    if kind == "circle":
        radius = max(dice.between(1.5, 5.0, 2), round(2.0 * speed * speed, 2))
        centre = rounded((x - radius * cos(angle), y - radius * sin(angle)))
        return {
            "kind": kind, "centre_m": list(centre), "radius_m": radius, "speed_mps": round(speed, 3),
            "phase_rad": round(angle, 3), "clockwise": dice.chance(0.5),
        }  # fmt: skip
    if kind == "waypoints":
        legs = [(dice.between(-2.0, 2.0), dice.between(1.0, 5.0)) for _ in range(dice.whole(1, 4))]
    elif kind == "to and fro":
        legs = list(_to_and_fro(dice, length_m))
        if len(shape.offsets) > 1 and dice.chance(0.7):
            one, other = dice.some(list(shape.offsets.values()), 2)
            angle = atan2(other[1] - one[1], other[0] - one[0])
    else:
        return {"kind": "hold"}
    points = [[round(x, 3), round(y, 3)]]
    for turn, leg_m in legs:
        angle += turn
        x, y = x + leg_m * cos(angle), y + leg_m * sin(angle)
        points.append([round(x, 3), round(y, 3)])
    return {"kind": "waypoints", "waypoints_m": points, "speed_mps": round(speed, 3)}


def _to_and_fro(dice: Dice, left_m: float) -> list[tuple[float, float]]:
    """Return turns and lengths of legs; courses that go straight to and fro retrace the same line."""
    bend, legs = dice.pick((0.0, 0.02, 0.3)), list[tuple[float, float]]()
    while not legs or (left_m > 0.5 and len(legs) < 7):
        leg_m = min(max(left_m, 0.5), dice.between(2.0, 7.0))
        legs.append((pi + dice.between(-bend, bend) if legs else 0.0, leg_m))
        left_m -= leg_m
    return legs


# --- obstacles and geofence -------------------------------------------------------------------------


def draw_obstacles(
    dice: Dice, hands: Sequence[Vector], safe_m: float, course: Sequence[Vector]
) -> list[Tables]:
    """Draw circles and polygons about `course`, the places that the reference passes, none on a start."""
    found: list[Tables] = []
    for _ in range(dice.whole(1, _OBSTACLES_MAX)):
        x, y = dice.pick(course)
        x, y = x + dice.between(-2.5, 2.5), y + dice.between(-2.5, 2.5)
        radius = dice.between(0.1, 0.7, 2)
        if dice.chance(0.5):
            obstacle: Tables = {"centre_m": list(rounded((x, y))), "radius_m": radius}
        else:
            corners, turn = dice.whole(3, 7), 2.0 * pi * dice.share()
            angles = [turn + 2.0 * pi * (k + dice.between(-0.25, 0.25)) / corners for k in range(corners)]
            points = [turned((radius * dice.between(0.5, 1.0), 0.0), angle) for angle in angles]
            obstacle = {"points_m": [list(rounded((x + a, y + b))) for a, b in points]}
        keep = radius + 0.5 * safe_m + _OBSTACLE_CLEARANCE_M
        if all(hypot(x - a, y - b) >= keep for a, b in hands):
            found.append(obstacle)
    return found


def draw_fence(dice: Dice, points: Sequence[Vector]) -> Tables:
    """Draw a geofence that all these places are well within: a rectangle, or a polygon of many corners."""
    spans: list[Range] = [(min(p[axis] for p in points), max(p[axis] for p in points)) for axis in (0, 1)]
    (x0, x1), (y0, y1) = spans
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    clearance = _FENCE_CLEARANCE_M + FENCE_WARN_M
    if dice.chance(0.5):
        w, h = ceil(0.5 * (x1 - x0) + clearance), ceil(0.5 * (y1 - y0) + clearance)
        corners: list[Vector] = [(-w, -h), (w, -h), (w, h), (-w, h)]
    else:
        number, turn = dice.whole(5, 12), 2.0 * pi * dice.share()
        radius = ceil((0.5 * dist((x0, y0), (x1, y1)) + clearance) / cos(pi / number))
        corners = [turned((radius, 0.0), turn + 2.0 * pi * k / number) for k in range(number)]
    return {"points_m": [list(rounded((x + a, y + b))) for a, b in corners]}
