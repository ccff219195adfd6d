"""Are edges so stiff against navigation that the formation may come to rest in another shape?

Where nothing moves, the law's forces are in balance: the pull to a place against lambda phi' of its edges,
with k2 lambda = -kp phi. phi has no unit, so what counts is the share

    S = kp / (k2 p s),    s = d - r_s,    p the pull from FOLD s away, c1 s at most (N1)

of docs/theory.md (J4), the same for a formation of any size.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from handfast.agent.control.law import APPROACH_SHARE
from handfast.agent.control.limits import FOLD, SOFTNESS, speed_max
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.deploy.analysis.couplings import coupling_of
from handfast.deploy.analysis.fleet_law import Array
from handfast.deploy.check.finding import Finding

_SHARES: Final = (0.5, 0.63, 0.82, 1.37, 2.05, 4.1, 8.2)
_FOLDED: Final = (0.0, 0.001, 0.011, 0.10, 0.17, 0.49, 0.74)
_FOLDED_ASSIGNED: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.002, 0.008)
"""Of random starts, by S: how many of the delta came to rest in another shape, with places as they come, and
assigned (600 to 2000 each)."""
_FOLDED_MAX: Final = 0.05
_FOLDED_ASSIGNED_MAX: Final = 0.002
_GOOD: Final = 0.63
"""S of kp = 1 and a k2 that is left out."""


def stiffness(fleet: Fleet, geometry: Geometry) -> Array:
    """S of each edge, (m,); without edges or for a law of others none."""
    control, coupling = fleet.control, coupling_of(fleet)
    if coupling is None or not coupling.shares_navigation:
        return np.zeros(0)
    span = geometry.distances - fleet.formation.safe_distance_m
    pull = control.c1 * span
    if fleet.avoidance.enabled:
        most = speed_max(fleet)
        left = max(APPROACH_SHARE * most, most - trajectory.maximum_speed(fleet.trajectory))
        pull = np.minimum(pull, control.c2 * left / FOLD)
    share: Array = control.kp / (coupling.softness(geometry) * pull * span)
    return share


def check_stiffness(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Folded shapes; every distance is above the safe one."""
    try:
        shares = stiffness(fleet, geometry)
    except ValueError:
        return  # a trajectory that cannot be made: `deploy.check.shape` says so
    if not len(shares):
        return
    control, worst = fleet.control, int(np.argmax(shares))
    share, assigned = float(shares[worst]), fleet.formation.assign
    folded = float(np.interp(share, _SHARES, _FOLDED_ASSIGNED if assigned else _FOLDED))
    if folded < (_FOLDED_ASSIGNED_MAX if assigned else _FOLDED_MAX):
        return
    i, j = (geometry.ids[end] for end in geometry.edges[worst].tolist())
    less = control.kp * _GOOD / share
    others = ""
    if control.k2 is not None:
        others = f", or leave control.k2 = {control.k2:.4g} out (it then follows the distances)"
        less_alone = control.kp * _GOOD / _without(fleet, geometry)
        if less_alone < control.kp:
            others += f" with kp = {less_alone:.2g}"
    yield Finding(
        "warning",
        "control.kp",
        f"{control.kp:.4g} is stiff for edge [{i}, {j}] of {geometry.distances[worst]:.4g} m: it is "
        f"{share / _GOOD:.2g} times as stiff against navigation as was measured to be good, and the "
        f"formation may come to rest folded, in another shape (measured: about {folded:.1%} of random starts"
        f"{' with assigned places' if assigned else ''}); take {less:.2g} or less{others}",
    )


def _without(fleet: Fleet, geometry: Geometry) -> float:
    """Largest S with a k2 that is left out."""
    span = geometry.distances - fleet.formation.safe_distance_m
    shares = stiffness(fleet, geometry) * (fleet.control.k2 or 0.0)
    far = FOLD * fleet.control.c1 / (fleet.control.c2 * speed_max(fleet))
    softness = SOFTNESS * np.maximum(1.0, far * span if fleet.avoidance.enabled else 0.0) / span**2
    return float((shares / softness).max())
