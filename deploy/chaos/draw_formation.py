"""Random formations: connected graphs over places that are well apart (PURE). Lengths in m."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import cos, dist, pi, sin
from typing import Final, NamedTuple

import numpy as np

from agent.common.quantities import Vector
from agent.formation.assignment import assign_slots
from deploy.chaos.dice import Dice

APART_FACTOR: Final = 2.2
"""Least distance of two places, in safe distances: room for robots that share no edge to keep apart."""
_APART_MIN_M: Final = 0.6
_SAME: Final = 1.01


class Shape(NamedTuple):
    """A formation: place of every robot, and who shares an edge."""

    offsets: Mapping[int, Vector]
    edges: Sequence[tuple[int, int]]

    @property
    def span(self) -> float:
        """Largest distance of two places."""
        return max((dist(a, b) for a, b in combinations(self.offsets.values(), 2)), default=0.0)


def apart_m(safe_m: float) -> float:
    """Least distance of two places."""
    return max(_APART_MIN_M, APART_FACTOR * safe_m)


def draw_shape(dice: Dice, robots: Sequence[int], safe_m: float, spacing: float | None = None) -> Shape:
    """Places and edges for these robots; `spacing`, the least distance of two, is drawn if not given."""
    if spacing is None:
        spacing = dice.between(1.0, 1.8) * apart_m(safe_m)
    if dice.chance(0.4):
        return draw_lattice(dice, robots, spacing)
    places = _scattered(dice, len(robots), spacing)
    return Shape(dict(zip(robots, places, strict=True)), _connected(dice, robots, places))


def near_shape(shape: Shape, before: Mapping[int, Vector]) -> Shape:
    """The same shape with its places given to the robots so that they have the least to drive."""
    robots, places = list(shape.offsets), list(shape.offsets.values())
    costs = np.array([[dist(before[robot], place) ** 2 for place in places] for robot in robots])
    slots = assign_slots(costs)
    taker = {robots[slot]: robot for robot, slot in zip(robots, slots, strict=True)}
    offsets = {robot: places[slot] for robot, slot in zip(robots, slots, strict=True)}
    edges = [(min(taker[i], taker[j]), max(taker[i], taker[j])) for i, j in shape.edges]
    return Shape(offsets, sorted(edges))


def draw_lattice(dice: Dice, robots: Sequence[int], spacing: float) -> Shape:
    """A piece of a triangular lattice, grown cell by cell: rigid or nearly so."""
    turn = dice.between(0.0, pi)
    cells = [(0, 0)]
    around = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))
    while len(cells) < len(robots):
        (a, b), (da, db) = dice.pick(cells), dice.pick(around)
        if (a + da, b + db) not in cells:
            cells.append((a + da, b + db))
    points = []
    for a, b in cells:
        x, y = spacing * (a + 0.5 * b), spacing * (0.75**0.5) * b
        points.append((x * cos(turn) - y * sin(turn), x * sin(turn) + y * cos(turn)))
    places = _centred(points)
    edges = [
        (i, j)
        for (i, a), (j, b) in combinations(zip(robots, places, strict=True), 2)
        if dist(a, b) < _SAME * spacing
    ]
    return Shape(dict(zip(robots, places, strict=True)), edges)


def _scattered(dice: Dice, count: int, spacing: float) -> list[Vector]:
    """Places in a disc, none nearer than `spacing` to another."""
    points: list[Vector] = []
    radius = 0.6 * spacing * count**0.5
    while len(points) < count:
        angle, away = 2.0 * pi * dice.share(), radius * dice.share() ** 0.5
        place = away * cos(angle), away * sin(angle)
        if all(dist(place, other) >= spacing for other in points):
            points.append(place)
        else:
            radius *= 1.01  # a disc that is too full grows
    return _centred(points)


def _centred(points: Sequence[Vector]) -> list[Vector]:
    x, y = (sum(point[axis] for point in points) / len(points) for axis in (0, 1))
    return [(round(a - x, 3), round(b - y, 3)) for a, b in points]


def _connected(dice: Dice, robots: Sequence[int], places: Sequence[Vector]) -> list[tuple[int, int]]:
    """A spanning tree that prefers short edges, and some more edges."""
    inside, edges = [0], set[tuple[int, int]]()
    while len(inside) < len(robots):
        outside = [k for k in range(len(robots)) if k not in inside]
        ways = sorted((dist(places[a], places[b]), a, b) for a in inside for b in outside)
        _, a, b = dice.pick(ways[:3])
        edges.add((min(a, b), max(a, b)))
        inside.append(b)
    for pair in combinations(range(len(robots)), 2):
        away = dist(places[pair[0]], places[pair[1]])
        if pair not in edges and dice.chance(0.35 / (1.0 + away)):
            edges.add(pair)
    return sorted((robots[a], robots[b]) for a, b in edges)
