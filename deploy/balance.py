"""Whether a formation has come to rest in another shape than its own: where the law's forces are in balance.

The law finds the nearest shape in which navigation and constraint forces of all robots add up to nothing.
From far away, or for one that comes in from the other side, that may be a folded shape (docs/theory.md). A
robot that stands beside its place without such a balance is not driven as it should be.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from agent import law
from agent.fleet import Fleet
from agent.prediction import approach
from deploy.analysis import Analysis

STILL_S: Final = 2.0
STILL_M: Final = 0.1
"""Who has moved less than this, as seen from its place, in the last `STILL_S`, is at rest."""
UNBALANCED: Final = 0.05
"""Largest force that may be left, m/s^2: the law comes to rest slowly near a balance."""


def caught(a: Analysis, fleet: Fleet) -> bool:
    """Whether at the end edges are off, and all robots at these are at rest with their forces in balance."""
    ends = np.unique(a.edges[np.flatnonzero(a.off[-1])])
    if not len(ends):
        return False
    rows = a.grid >= a.grid[-1] - STILL_S
    moved = np.ptp(a.hands[rows] - a.desired[rows], axis=0).max(axis=1)
    left = np.hypot(*_forces(a, fleet))
    return bool((moved[ends] < STILL_M).all() and (left[ends] < UNBALANCED).all())


def _forces(a: Analysis, fleet: Fleet) -> law.Array:
    """What is left of all forces on every robot at the end, (2, n), m/s^2, if none moves in the formation."""
    control, n = fleet.control, len(a.ids)
    error = np.nan_to_num((a.hands[-1] - a.desired[-1]).T)
    before = a.desired[a.grid >= a.grid[-1] - STILL_S][0]
    vx, vy = np.nan_to_num((a.desired[-1] - before).T / STILL_S)
    shares = [
        law.saturation(x, y, control.c1, control.c2, approach(u, v, x, y, control.max_speed_mps))
        for x, y, u, v in zip(*error.tolist(), vx.tolist(), vy.tolist(), strict=True)
    ]
    navigation = -control.c1 * np.array(shares) * error
    columns = np.flatnonzero(a.counts[-1])
    i, j = a.edges[columns].T
    gains = law.Gains(control.kd, control.k2, control.kp, control.relaxation)
    edges = law.edges(
        (a.hands[-1, i] - a.hands[-1, j]).T,
        np.zeros((2, len(columns))),
        navigation[:, i] - navigation[:, j],
        a.wanted[-1, columns],
        fleet.formation.safe_distance_m,
        gains,
    )
    multipliers = law.multipliers_fleet(control.coupling, edges, i, j, n, gains)
    total: law.Array = navigation + law.total_forces(law.forces(edges, multipliers), i, j, n)
    return total
