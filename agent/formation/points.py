"""Geometry of points and edges in the plane, as arrays (PURE, numpy only).

Distances, the best-fitting rotation, connected parts of a graph, and the assignment of robots to places.
Places have shape (n, 2), in m; edges have shape (m, 2) and hold rows of the places that they join.
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


def components(n: int, edges: Any) -> tuple[tuple[int, ...], ...]:
    """Connected parts of a graph of n vertices with edges (m, 2), each sorted, by their least vertex."""
    parent = list(range(n))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = parent[vertex]
        return vertex

    for i, j in as_edges(edges).tolist():
        a, b = root(i), root(j)
        parent[max(a, b)] = min(a, b)
    parts: dict[int, list[int]] = {}
    for vertex in range(n):
        parts.setdefault(root(vertex), []).append(vertex)
    return tuple(tuple(part) for part in parts.values())


def connected(n: int, edges: Any) -> bool:
    """Whether edges (m, 2) join any two of n vertices by a path. One vertex alone is connected."""
    return len(components(n, edges)) <= 1


def assign_slots(cost: Any) -> tuple[int, ...]:
    """Slot of every robot, so that the total cost is least (linear assignment problem).

    Shortest augmenting paths with dual potentials (Jonker & Volgenant 1987; Crouse 2016), O(n^3), each
    step vectorised over the slots. Deterministic: of equal costs the lowest slot is tried first.

    Args:
        cost: (n, n), cost of robot (row) in slot (column).

    Raises:
        ValueError: not square, or not finite.
    """
    table = np.array(cost, np.float64)
    if table.ndim != 2 or table.shape[0] != table.shape[1]:
        raise ValueError(f"cost must be square, not of shape {table.shape}")
    if not np.isfinite(table).all():
        raise ValueError("cost must be finite")
    n = len(table)
    robot_price = np.zeros(n)
    slot_price = table.min(axis=0) if n else np.zeros(0)
    slot_of = np.full(n, -1)
    robot_in = np.full(n, -1)
    for start in range(n):
        shortest = np.full(n, np.inf)  # cheapest way to each slot from `start`
        closed = np.zeros(n, bool)  # slots whose way is final
        before = np.full(n, -1)  # robot that each way comes from
        tree = []  # robots on the ways, `start` aside
        robot, reached = start, 0.0
        while True:
            way = reached + table[robot] - robot_price[robot] - slot_price
            better = (way < shortest) & ~closed
            shortest[better] = way[better]
            before[better] = robot
            slot = int(np.argmin(np.where(closed, np.inf, shortest)))
            reached = float(shortest[slot])
            closed[slot] = True
            if robot_in[slot] < 0:
                break
            robot = int(robot_in[slot])
            tree.append(robot)
        robot_price[start] += reached
        if tree:
            robot_price[tree] += reached - shortest[slot_of[tree]]
        slot_price[closed] -= reached - shortest[closed]
        while True:  # hand the slots on, back along the way
            robot = int(before[slot])
            robot_in[slot] = robot
            slot, slot_of[robot] = int(slot_of[robot]), slot
            if robot == start:
                break
    return tuple(int(slot) for slot in slot_of)
