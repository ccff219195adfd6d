"""Points in the plane and edges between them, as arrays: distances, and the best turn (PURE, numpy only).

Places are (n, 2), m; edges (m, 2) are rows of the places that they join.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Indices = NDArray[np.intp]


def edge_lengths(offsets: Floats, edges: Indices) -> Floats:
    """Distance between the two ends of every edge, (m,), m."""
    difference = offsets[edges[:, 0]] - offsets[edges[:, 1]]
    return np.hypot(difference[:, 0], difference[:, 1])


def best_turn(shape: Floats, starts: Floats) -> Floats:
    """`shape` turned and mirrored to come nearest to `starts`, row by row (Procrustes), (n, 2)."""
    left, _, right = np.linalg.svd(shape.T @ starts)
    turned: Floats = shape @ (left @ right)
    return turned


def square_distances(a: Floats, b: Floats) -> Floats:
    """|a_i - b_k|^2, (n, n), m^2."""
    difference = a[:, None, :] - b[None, :, :]
    squares: Floats = np.sum(difference * difference, axis=2)
    return squares


def distance_table(places: Floats) -> Floats:
    """Distances between all places, (n, n), m."""
    table: Floats = np.sqrt(square_distances(places, places))
    return table


def pair_distances(places: Floats) -> Floats:
    """Distances of all pairs, (n (n - 1) / 2,), m."""
    i, j = np.triu_indices(len(places), 1)
    apart: Floats = np.hypot(places[i, 0] - places[j, 0], places[i, 1] - places[j, 1])
    return apart


def as_places(offsets: Any) -> Floats:
    """Places as an array (n, 2); ValueError where they are not pairs."""
    return np.asarray(offsets, np.float64).reshape(-1, 2)


def as_edges(edges: Any) -> Indices:
    """Edges as an array (m, 2); ValueError where they are not pairs."""
    return np.asarray(edges, np.intp).reshape(-1, 2)
