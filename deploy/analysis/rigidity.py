"""Rigidity: which motions the distances of a formation graph leave free (PURE, numpy only).

Offsets are (n, 2), m; edges (m, 2) are rows of the robots that they join.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from handfast.agent.formation.points import Floats, as_edges, as_places

_RANK_TOLERANCE: Final = 1e-7  # of the largest singular value of the rigidity matrix with unit rows

_MOTION_TOLERANCE: Final = 1e-6  # of a unit motion: what a robot must move by to count as moving


def rigidity_matrix(offsets: Any, edges: Any) -> Floats:
    """Rows of unit edges, (m, 2n): row e times the robots' velocities is the rate of e's distance.

    Columns are x and y of robot 0, x and y of robot 1, ... An edge of no length has a row of zeros.
    """
    places = as_places(offsets)
    rows = as_edges(edges)
    difference = places[rows[:, 0]] - places[rows[:, 1]]
    length = np.hypot(difference[:, 0], difference[:, 1])
    normal = difference / np.where(length > 0.0, length, 1.0)[:, None]
    matrix = np.zeros((len(rows), 2 * len(places)))
    edge = np.arange(len(rows))
    for axis in (0, 1):
        matrix[edge, 2 * rows[:, 0] + axis] = normal[:, axis]
        matrix[edge, 2 * rows[:, 1] + axis] = -normal[:, axis]
    return matrix


def rigidity_rank(offsets: Any, edges: Any) -> int:
    """Rank of the rigidity matrix: how many independent motions the distances hold."""
    matrix = rigidity_matrix(offsets, edges)
    if not matrix.size:
        return 0
    values = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(values > _RANK_TOLERANCE * max(values[0], 1e-300)))


def is_rigid(offsets: Any, edges: Any) -> bool:
    """Infinitesimally rigid in the plane: rank 2n - 3, so only moving and turning as one is free.

    One robot is rigid; so are two with an edge. Robots all in one line are not, unless they are two:
    a small move across the line changes no distance to first order.
    """
    n = len(as_places(offsets))
    return n <= 1 or rigidity_rank(offsets, edges) == 2 * n - 3


def is_collinear(offsets: Any) -> bool:
    """Do all places lie on one line (or point), within 1e-6 of their spread."""
    places = as_places(offsets)
    if len(places) <= 2:
        return True
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(values[1] <= 1e-6 * values[0])


def loose(offsets: Any, edges: Any) -> tuple[int, ...]:
    """Robots (rows) that can move, to first order, while no edge changes its length.

    Seen from the largest rigid part: the robots that stand still in every motion of the null space
    of the rigidity matrix, once the motion of an edge's two ends as one body is taken off. Empty when
    the formation is rigid; of equally large parts, the one with the first edge is taken as fixed.
    """
    places = as_places(offsets)
    rows = as_edges(edges)
    n = len(places)
    if is_rigid(places, rows):
        return ()
    if not len(rows):
        return tuple(range(1, n))
    _, values, turned = np.linalg.svd(rigidity_matrix(places, rows))
    rank = int(np.count_nonzero(values > _RANK_TOLERANCE * values[0]))
    motions = turned[rank:].reshape(-1, n, 2)  # (f, n, 2)
    best = np.zeros(n, bool)
    for i, j in rows.tolist():
        arm = places[j] - places[i]
        square = float(arm @ arm)
        if square == 0.0:
            continue
        slide = motions[:, j] - motions[:, i]  # across the arm only: the edge keeps its length
        turn = (arm[0] * slide[:, 1] - arm[1] * slide[:, 0]) / square  # rad/s of the edge, (f,)
        reach = places - places[i]
        body = np.stack([-np.outer(turn, reach[:, 1]), np.outer(turn, reach[:, 0])], axis=2)
        left = motions - motions[:, i : i + 1] - body
        still = np.abs(left).max(axis=(0, 2)) < _MOTION_TOLERANCE
        if np.count_nonzero(still) > np.count_nonzero(best):
            best = still
    if not best.any():  # every edge has no length
        return tuple(range(1, n))
    return tuple(int(robot) for robot in np.flatnonzero(~best))
