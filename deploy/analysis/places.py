"""How far robots are from their places in the formation, and when that is too far."""

from __future__ import annotations

from typing import Final

import numpy as np

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, norm
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
