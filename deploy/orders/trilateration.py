"""Where a point is whose distances from known points are given (PURE). Lengths in m."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, hypot, sqrt
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.formation.realisation import DISTANCE_TOLERANCE

_STEPS: Final = 20
_SAME: Final = 1e-6  # places nearer to each other than this share of a distance are one


def trilaterate(anchors: Sequence[Vector], distances: Sequence[float]) -> tuple[Vector, ...]:
    """The places, at most two, that meet all distances (above zero) within `DISTANCE_TOLERANCE`.

    Two circles meet in two points at most; those of the first anchor with each other one are brought to the
    least squares over all anchors (Gauss-Newton), for distances are rounded when they are typed.

    Args:
        anchors: at least two.
    """
    found: list[Vector] = []
    for anchor, distance in zip(anchors[1:], distances[1:], strict=True):
        for start in _meeting(anchors[0], distances[0], anchor, distance):
            place = _nearest(start, anchors, distances)
            fits = all(
                abs(hypot(place[0] - x, place[1] - y) - d) <= DISTANCE_TOLERANCE * d
                for (x, y), d in zip(anchors, distances, strict=True)
            )
            known = any(hypot(place[0] - x, place[1] - y) <= _SAME * max(distances) for x, y in found)
            if fits and not known:
                found.append(place)
    return tuple(found[:2])


def place_apart(
    anchors: Sequence[Vector], distances: Sequence[float], others: Sequence[Vector]
) -> Vector | None:
    """The place with these distances from the anchors that is furthest from the nearest of the others.

    From a single anchor it is the one straight away from the others' centroid (+x where the anchor is that).
    None when there is no such place.

    Args:
        anchors: at least one; others: at least one, those may be among them.
    """
    if len(anchors) > 1:
        found = trilaterate(anchors, distances)
        apart = [other for other in others if other not in anchors]  # from the anchors both are as far
        return max(
            found, key=lambda place: min((dist(place, other) for other in apart), default=0.0), default=None
        )
    (x, y), distance = anchors[0], distances[0]
    out_x = x - sum(place[0] for place in others) / len(others)
    out_y = y - sum(place[1] for place in others) / len(others)
    size = hypot(out_x, out_y)
    if size < _SAME * distance:
        return x + distance, y
    return x + distance * out_x / size, y + distance * out_y / size


def _meeting(a: Vector, radius: float, b: Vector, other: float) -> tuple[Vector, ...]:
    """Where two circles meet, the left one from `a` to `b` first; where they do not, the point between."""
    x, y = b[0] - a[0], b[1] - a[1]
    apart = hypot(x, y)
    if apart == 0.0:
        return ()
    x, y = x / apart, y / apart
    along = (apart * apart + radius * radius - other * other) / (2.0 * apart)
    across = sqrt(max(0.0, radius * radius - along * along))
    foot_x, foot_y = a[0] + along * x, a[1] + along * y
    return (foot_x - across * y, foot_y + across * x), (foot_x + across * y, foot_y - across * x)


def _nearest(place: Vector, anchors: Sequence[Vector], distances: Sequence[float]) -> Vector:
    x, y = place
    for _ in range(_STEPS):
        xx = xy = yy = bx = by = 0.0
        for (anchor_x, anchor_y), distance in zip(anchors, distances, strict=True):
            length = hypot(x - anchor_x, y - anchor_y)
            if length == 0.0:
                return x, y
            nx, ny = (x - anchor_x) / length, (y - anchor_y) / length
            error = length - distance
            xx, xy, yy = xx + nx * nx, xy + nx * ny, yy + ny * ny
            bx, by = bx + nx * error, by + ny * error
        determinant = xx * yy - xy * xy
        if determinant <= 1e-9 * (xx + yy) ** 2:  # all in one line: across it nothing is known
            return x, y
        dx, dy = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
        x, y = x - dx, y - dy
        if hypot(dx, dy) <= 1e-12 * distances[0]:
            break
    return x, y
