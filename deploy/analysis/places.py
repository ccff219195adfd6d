"""Distances of robots from their places, and formations that have come to rest in another shape.

The law finds the nearest shape in which the navigation and constraint forces of all robots balance. From far
away, or for a robot that arrives from the other side, that may be a folded shape (docs/theory.md). A robot
that stands beside its place without such a balance has another problem.
"""

from __future__ import annotations

from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handfast.agent.control import law
from handfast.agent.control.limits import speed_max, speeding_rate
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis import fleet_law
from handfast.deploy.analysis.analysis import Analysis, norm
from handfast.deploy.analysis.couplings import FleetCoupling, coupling_of
from handfast.deploy.analysis.presence import Flags, kept_through

LAST_S: Final = 2.0
"""Who was at its place once in the last so many seconds is not off it."""
AT_PLACE: Final = 0.25
"""Share of the least distance between two places: who is nearer than that to its own is there."""

TOGETHER: Final = 2.0
"""How many times as far from their places robots may be that are off alike."""


def allowed_m(a: Analysis, row: int = -1) -> float:
    """How far a robot may be from its place to count as there: by the formation's own scale, a quarter of the
    least that it puts between two robots; of one that is alone, the safe distance."""
    places = a.desired[row]
    places = places[np.isfinite(places[:, 0])]
    least_m = 4.0 * a.safe_m
    if len(places) > 1:
        least_m = min(float(norm(places[k + 1 :] - places[k]).min()) for k in range(len(places) - 1))
    return AT_PLACE * max(least_m, a.safe_m)


def together(a: Analysis) -> Flags:
    """(n,): who is off its place at the end as all others are, by half the way to another place at most.

    A formation whose edges are right may be that far behind: soft ground that the law does not know holds
    rovers so.
    """
    off = np.where(a.away[-1][:, None], np.nan, a.hands[-1] - a.desired[-1])
    known = np.isfinite(off[:, 0])
    if known.sum() < 2 or a.off[-1].any():
        return np.zeros(len(off), dtype=bool)
    alike: Flags = norm(off - off[known].mean(axis=0)) <= allowed_m(a)
    return alike & (norm(off) <= TOGETHER * allowed_m(a))


def distances_m(a: Analysis) -> Floats:
    """(k, n): of each robot from its place; NaN where it has none, is not known, or could not follow."""
    found: Floats = np.where(a.away, np.nan, norm(a.hands - a.desired))
    return found


def last_there_s(a: Analysis) -> float | None:
    """Last time that any robot was further from its place than is allowed at the end, 0 when none was; None
    when one is at the end, and where nothing is known. Who sent no pose for a while was off it all the while
    if it was before, or is after."""
    distances = distances_m(a)
    far = kept_through(distances > allowed_m(a), a.unknown)  # False for NaN
    if not np.isfinite(distances).any() or far[-1].any():
        return None
    when = np.flatnonzero(far.any(axis=1))
    return float(a.grid[when[-1]]) if len(when) else 0.0


STILL_S: Final = 2.0
STILL_M: Final = 0.1
"""Who has moved less than this, as seen from its place, in the last `STILL_S`, is at rest."""
LOOK_S: Final = 0.5
"""How often it is looked whether a formation is at rest."""
UNBALANCED: Final = 0.3
"""Largest share of the largest navigation force that may be left: a balance is reached slowly."""


def caught(a: Analysis, fleet: Fleet, row: int = -1) -> bool:
    """Whether at a row of the grid, the end, edges are off and all robots at these are at rest with their
    forces in balance; never by a law of others."""
    coupling = coupling_of(fleet)
    if coupling is None:
        return False
    ends = np.unique(a.edges[np.flatnonzero(a.off[row])])
    if not len(ends):
        return False
    return _at_rest(a, fleet, coupling, row, ends)


def rest_shapes(a: Analysis, fleet: Fleet, far: NDArray[np.bool_], row: int = -1) -> list[list[int]]:
    """Of the robots that are `far` (n,) from their places, or at an edge that is off, at a row of the grid:
    the groups that hang together by edges, have one that is off, and are `caught`."""
    coupling = coupling_of(fleet)
    off = a.edges[a.off[row]]
    if coupling is None or not len(off):
        return []
    in_it = far.copy()
    in_it[off] = True
    group = np.where(in_it, np.arange(len(a.ids)), -1)
    edges = a.edges[a.counts[row] & in_it[a.edges].all(axis=1)]
    for i, j in edges.tolist():
        group[group == group[i]] = group[j]
    found = [np.flatnonzero(group == each) for each in np.unique(group[off])]
    return [ends.tolist() for ends in found if _at_rest(a, fleet, coupling, row, ends)]


def _at_rest(a: Analysis, fleet: Fleet, coupling: FleetCoupling, row: int, ends: NDArray[np.int64]) -> bool:
    """Whether these robots stand, as seen from their places, with their forces in balance."""
    rows = _lately(a, row)
    moved = np.ptp(a.hands[rows] - a.desired[rows], axis=0).max(axis=1)
    navigation, total = (np.hypot(*forces)[ends] for forces in _forces(a, fleet, coupling, row))
    return bool((moved[ends] < STILL_M).all() and (total < UNBALANCED * navigation.max()).all())


def last_caught_s(a: Analysis, fleet: Fleet, since_s: float) -> float:
    """When the formation was last `caught` after `since_s`; -inf: never.

    Such a shape need not be stable: a formation may leave it after a while, the later the closer it came.
    """
    for t in np.arange(a.grid[-1], since_s + STILL_S, -LOOK_S):
        if caught(a, fleet, int(np.searchsorted(a.grid, t))):
            return float(t)
    return -inf


def _lately(a: Analysis, row: int) -> NDArray[np.bool_]:
    lately: NDArray[np.bool_] = (a.grid >= a.grid[row] - STILL_S) & (a.grid <= a.grid[row])
    return lately


def _forces(
    a: Analysis, fleet: Fleet, coupling: FleetCoupling, row: int
) -> tuple[fleet_law.Array, fleet_law.Array]:
    """Navigation force on every robot, and what is left of all forces, (2, n), m/s^2, if none moves in the
    formation."""
    control, n, most = fleet.control, len(a.ids), speed_max(fleet)
    error = np.nan_to_num((a.hands[row] - a.desired[row]).T)
    before = a.desired[_lately(a, row)][0]
    vx, vy = np.nan_to_num((a.desired[row] - before).T / STILL_S)
    c1, c2, rate = control.c1, control.c2, speeding_rate(fleet)
    pulls = []
    for x, y, u, v in zip(*error.tolist(), vx.tolist(), vy.tolist(), strict=True):
        acting = law.acting_error((x, y), (u, v), c1, c2, most)
        pull = c1 * law.firmness((x, y), acting, (u, v), c1, c2, most, rate)
        pulls.append((pull * acting[0], pull * acting[1]))
    navigation = -np.array(pulls).T
    columns = np.flatnonzero(a.counts[row])
    i, j = a.edges[columns].T
    edges = fleet_law.edges(
        (a.hands[row, i] - a.hands[row, j]).T,
        np.zeros((2, len(columns))),
        navigation[:, i] - navigation[:, j],
        a.wanted[row, columns],
        fleet.formation.safe_distance_m,
        coupling.gains,
    )
    multipliers = coupling.multipliers(edges, i, j, n)
    total: fleet_law.Array = navigation + fleet_law.total_forces(
        fleet_law.forces(edges, multipliers), i, j, n
    )
    return navigation, total
