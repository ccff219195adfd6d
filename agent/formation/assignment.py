"""Who takes which slot: the linear assignment problem (PURE, numpy only)."""

from __future__ import annotations

from typing import Any

import numpy as np


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
