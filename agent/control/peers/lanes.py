"""The way of a robot as others know it without hearing it, as a line to keep out of or to keep on (PURE).

A lane is a line of straight pieces. It is asked for in every tick near it, so its pieces stand in runs with a
circle round each: `near` picks the runs that matter a few times a second, and each gives a half plane of its
own, for a lane may come back on another side.

Lengths in m, W.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import hypot
from typing import Final, NamedTuple

from handfast.agent.common.quantities import DISTANCE_MIN, Vector

RUN: Final = 6
"""Pieces in one run."""
LENGTH_MAX: Final = 4.0
"""Pieces longer than this are cut, m: a run of long ones would be near to everybody."""
PIECES_MAX: Final = 4096
"""Of a lane; a longer way is taken in longer pieces."""


class Run(NamedTuple):
    """Pieces one after the other, each ``(x, y, dx, dy, 1 / length^2)``, and a circle round them."""

    x: float
    y: float
    reach: float
    pieces: tuple[tuple[float, float, float, float, float], ...]


class Lane:
    """The way of one robot from `points` to points; one point: it stands there."""

    __slots__ = ("_reach", "_runs", "_x", "_y")

    def __init__(self, points: Sequence[Vector]) -> None:
        pieces = [piece for a, b in pairwise(points) for piece in _cut(a, b, points)]
        if not pieces:
            pieces = [(*points[0], 0.0, 0.0, 0.0)]
        self._runs = tuple(_run(pieces[k : k + RUN]) for k in range(0, len(pieces), RUN))
        # A circle round all of it: of many robots, most are far away.
        self._x, self._y, self._reach, _ = _run(pieces)

    def near(self, x: float, y: float, within: float) -> tuple[Run, ...]:
        """The runs that may be nearer to (x, y) than `within`."""
        if hypot(self._x - x, self._y - y) >= self._reach + within:
            return ()
        return tuple(run for run in self._runs if hypot(run.x - x, run.y - y) < run.reach + within)

    def offset(self, x: float, y: float) -> Vector:
        """From its nearest point to (x, y)."""
        return min((offset(run, x, y) for run in self._runs), key=_length)

    def distance(self, x: float, y: float) -> float:
        """How far (x, y) is from it."""
        return _length(self.offset(x, y))

    def reaches(self, x: float, y: float, within: float) -> bool:
        """Whether (x, y) is nearer to it than `within`."""
        return any(_length(offset(run, x, y)) < within for run in self.near(x, y, within))


def offset(run: Run, x: float, y: float) -> Vector:
    """From the nearest point of a run to (x, y)."""
    least, best = float("inf"), (0.0, 0.0)
    for px, py, dx, dy, scale in run.pieces:
        ax, ay = x - px, y - py
        share = (ax * dx + ay * dy) * scale
        if share > 0.0:
            if share > 1.0:
                share = 1.0
            ax, ay = ax - share * dx, ay - share * dy
        square = ax * ax + ay * ay
        if square < least:
            least, best = square, (ax, ay)
    return best


def _cut(a: Vector, b: Vector, points: Sequence[Vector]) -> list[tuple[float, float, float, float, float]]:
    length = hypot(b[0] - a[0], b[1] - a[1])
    if length < DISTANCE_MIN:
        return []
    count = min(int(length / LENGTH_MAX) + 1, max(1, PIECES_MAX // len(points)))
    dx, dy = (b[0] - a[0]) / count, (b[1] - a[1]) / count
    scale = 1.0 / (dx * dx + dy * dy)
    return [(a[0] + k * dx, a[1] + k * dy, dx, dy, scale) for k in range(count)]


def _run(pieces: list[tuple[float, float, float, float, float]]) -> Run:
    xs = [piece[0] for piece in pieces] + [pieces[-1][0] + pieces[-1][2]]
    ys = [piece[1] for piece in pieces] + [pieces[-1][1] + pieces[-1][3]]
    x, y = 0.5 * (min(xs) + max(xs)), 0.5 * (min(ys) + max(ys))
    return Run(x, y, max(hypot(a - x, b - y) for a, b in zip(xs, ys, strict=True)), tuple(pieces))


def _length(vector: Vector) -> float:
    return hypot(*vector)
