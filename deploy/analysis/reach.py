"""Where a body can have been between two places where it was seen, by its greatest speed (PURE).

From (t0, a) to (t1, b) a body that is never faster than v is, at t, within `v (t - t0)` of a and within
`v (t1 - t)` of b; over the whole time that is the ellipse d(p, a) + d(p, b) <= v (t1 - t0). All that is said
here are lower bounds: no path that keeps the speed comes nearer.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf
from typing import NamedTuple

import numpy as np

from handfast.agent.formation.points import Floats


class Seen(NamedTuple):
    """A place (m) where a body was at `t_s`."""

    t_s: float
    x: float
    y: float


class Disc(NamedTuple):
    """A body is within `radius` of (x, y), at each of k times: (k,) m."""

    x: Floats
    y: Floats
    radius: Floats


def known(x: Floats, y: Floats) -> list[Disc]:
    """The disc of a body whose places (k,) are known."""
    return [Disc(x, y, np.zeros(len(x)))]


class Reach(NamedTuple):
    """A body that was last seen at `before` and then at `after`; None where it was not seen then.

    Attributes:
        speed: its greatest one, m/s.
    """

    before: Seen | None
    after: Seen | None
    speed: float

    def discs(self, times: Floats) -> list[Disc]:
        """In all of which the body is at these times (k,) s; none where nothing is known."""
        return [
            Disc(
                np.full(len(times), seen.x),
                np.full(len(times), seen.y),
                self.speed * np.abs(times - seen.t_s),
            )
            for seen in (self.before, self.after)
            if seen is not None
        ]

    @property
    def too_far_m(self) -> float:
        """By how much it is further from one place to the other than its speed allows, m; at most 0 where
        it is not."""
        if self.before is None or self.after is None:
            return -inf
        way_m = hypot(self.after.x - self.before.x, self.after.y - self.before.y)
        return way_m - self.speed * (self.after.t_s - self.before.t_s)

    def clearance(self, before_m: float, after_m: float) -> float:
        """How near it can have come to what stands still, m: from its signed distances at both places.

        A distance changes by no more than the way: d(t) >= d(a) - v (t - t0) and d(t) >= d(b) - v (t1 - t),
        and the greater of the two is least where they are the same.
        """
        if self.before is None or self.after is None:
            return -inf
        least_m = 0.5 * (before_m + after_m - self.speed * (self.after.t_s - self.before.t_s))
        return min(before_m, after_m, least_m)


def apart(one: Sequence[Disc], other: Sequence[Disc]) -> Floats | None:
    """(k,): two bodies are at least that far apart at each time, m; None where nothing is known of one.

    Whoever is in all of some discs is in each of them: the greatest of the bounds holds.
    """
    bounds = [np.hypot(a.x - b.x, a.y - b.y) - a.radius - b.radius for a in one for b in other]
    if not bounds:
        return None
    found: Floats = np.maximum(np.max(bounds, axis=0), 0.0)
    return found


def least_apart(one: Sequence[Disc], other: Sequence[Disc], step_s: float, closing: float) -> float:
    """How near two bodies can have come at the times of their discs, and for half a step before and after.

    Args:
        step_s: these times are no further apart, s.
        closing: how fast the bodies can come nearer to each other, m/s.
    """
    found = apart(one, other)
    if found is None:
        return 0.0
    return max(0.0, float(found.min()) - 0.5 * closing * step_s)
