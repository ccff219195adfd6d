"""Random obstacles and a geofence round all that a scenario drives through (PURE). Lengths in m, W."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, cos, dist, hypot, pi, sin
from typing import Final, NamedTuple

from agent.common.quantities import Vector
from deploy.chaos.dice import Dice, Tables

OBSTACLES_MAX: Final = 6
_FREE_M: Final = 0.35
"""Obstacles are so much further from the hands at the start than robots keep from them."""
_FENCE_M: Final = 3.0
"""So far outside all places the geofence is: who goes round an obstacle, or another robot, needs room."""


class Reach(NamedTuple):
    """The box that all places and starts of a scenario lie in."""

    low: Vector
    high: Vector

    @property
    def size(self) -> float:
        """Its diagonal."""
        return dist(self.low, self.high)


def hands(tables: Tables) -> list[Vector]:
    """Hand points of all robots at the start."""
    length = tables["robot_defaults"]["hand_offset_m"]
    return [
        (row["x_m"] + length * cos(row["heading_rad"]), row["y_m"] + length * sin(row["heading_rad"]))
        for row in tables["robot"]
    ]


def draw_obstacles(dice: Dice, tables: Tables, way: Sequence[Vector]) -> list[Tables]:
    """Circles and polygons about `way`, the places that the reference passes, none on a start."""
    starts = hands(tables)
    found: list[Tables] = []
    for _ in range(dice.whole(0, OBSTACLES_MAX) if dice.chance(0.6) else 0):
        x, y = dice.pick(way)
        x, y = x + dice.between(-2.5, 2.5), y + dice.between(-2.5, 2.5)
        radius = dice.between(0.1, 0.7, 2)
        if dice.chance(0.5):
            obstacle: Tables = {"centre_m": [round(x, 3), round(y, 3)], "radius_m": radius}
        else:
            corners, turn = dice.whole(3, 7), 2.0 * pi * dice.share()
            points = []
            for k in range(corners):
                angle = turn + 2.0 * pi * (k + dice.between(-0.25, 0.25)) / corners
                away = radius * dice.between(0.5, 1.0)
                points.append([round(x + away * cos(angle), 3), round(y + away * sin(angle), 3)])
            obstacle = {"points_m": points}
        keep = radius + 0.5 * tables["formation"]["safe_distance_m"] + _FREE_M
        if all(hypot(x - a, y - b) >= keep for a, b in starts):
            found.append(obstacle)
    return found


def fence_round(dice: Dice, reach: Reach) -> Tables:
    """A geofence that all places are well within: a rectangle, or a polygon of many corners."""
    (x0, y0), (x1, y1) = reach
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    warn = dice.between(0.3, 0.8, 1)
    room = _FENCE_M + warn
    if dice.chance(0.5):
        half = ceil(0.5 * (x1 - x0) + room), ceil(0.5 * (y1 - y0) + room)
        points = [
            [round(x + a * half[0], 3), round(y + b * half[1], 3)]
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
    else:
        corners = dice.whole(5, 12)
        radius = ceil((0.5 * reach.size + room) / cos(pi / corners))
        turn = 2.0 * pi * dice.share()
        points = [
            [
                round(x + radius * cos(turn + 2.0 * pi * k / corners), 3),
                round(y + radius * sin(turn + 2.0 * pi * k / corners), 3),
            ]
            for k in range(corners)
        ]
    return {"points_m": points, "warn_m": warn}
