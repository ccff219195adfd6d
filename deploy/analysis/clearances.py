"""How far many points are from a boundary, at once: for recordings, checks and pictures."""

from __future__ import annotations

import numpy as np

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.formation.points import Floats


def distances(boundary: Circle | Polygon, points: Floats) -> Floats:
    """Signed distance (m) of points (k, 2) from a boundary, (k,): above 0 on its allowed side.

    That is the `distance` of the first one that `agent.control.boundaries.Boundary.near` returns. Points
    that are not finite give nan.
    """
    x, y = points[:, 0], points[:, 1]
    if isinstance(boundary, Circle):
        round_one: Floats = np.hypot(x - boundary.x, y - boundary.y) - boundary.radius
        return round_one
    corners = boundary.points
    least = np.full(len(points), np.inf)
    is_inside = np.zeros(len(points), np.bool_)
    for (ax, ay), (bx, by) in zip(corners, (*corners[1:], corners[0]), strict=True):
        dx, dy = bx - ax, by - ay
        rx, ry = x - ax, y - ay
        along = np.clip((rx * dx + ry * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        least = np.minimum(least, np.hypot(rx - along * dx, ry - along * dy))
        # A ray to the east crosses the side: an odd number of times from inside.
        is_across = (ay > y) != (by > y)
        is_left = (rx * dy < ry * dx) == (dy > 0.0)
        is_inside ^= is_across & is_left
    return np.where(is_inside == boundary.inside, least, -least)
