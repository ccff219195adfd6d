"""Where a robot may be that is not heard: a few discs, and nothing but hearing it takes one away (PURE).

A robot that falls silent may have stopped at once, braked as its plant does, coasted, or followed the law and
its reference: until it gives up those that it does not hear, at the latest, and stands. So it is somewhere on
the way that it was on when it was heard last, of which `stood_on` makes discs: each covers a stretch, grows
with what another acceleration than the predicted one makes of its place meanwhile, and is there from the
time on at which the robot can be in it. Each disc is kept away from by itself: the nearest point of a way
says nothing of the rest of it, and has no direction for a robot that stands on that way.

Lengths in m, W; times in s since the robot's last message. See (S1) to (S6) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, hypot, inf
from typing import Final, NamedTuple

from agent.common.quantities import DISTANCE_MIN, Vector

DOUBT_RATE: Final = 0.15
"""How fast the position uncertainty of a robot grows that is not heard, m/s: about what another acceleration
than the predicted one makes of a robot's place in a second."""
DOUBT_AFTER_S: Final = 0.1
"""It grows from this age of a robot's last message on."""
DOUBT_MAX: Final = 0.3
"""Largest position uncertainty, m: of what a robot says itself, and of what its silence adds."""
STANDS_S: Final = 1.0
"""Who hears nobody, or is told by beacons that nobody hears it, stands so long after it is given up."""
DISCS_MAX: Final = 8
"""Discs of one robot at most."""
STRETCH: Final = 0.25
"""Of the way of a robot that one disc covers while there are enough of them, m."""
AHEAD_S: Final = 0.1
"""A disc is kept away from so much before the robot can be in it: those near are looked for as often."""


class Disc(NamedTuple):
    """Where a robot may be: centre (x, y), m; from `after` s after its last message on."""

    x: float
    y: float
    radius: float
    after: float

    def radius_at(self, age: float) -> float:
        """Its radius so many seconds after the robot's last message, m."""
        return self.radius + said_doubt(age)


class Belief(NamedTuple):
    """Where one robot may be that is not heard.

    Attributes:
        discs: in the order of its way.
        x, y, reach: a circle round all of them.
        way, doubt: points of the way that they cover, and how far off it the robot may be; the age of its
            last message adds to that.
    """

    discs: tuple[Disc, ...]
    x: float
    y: float
    reach: float
    way: tuple[Vector, ...]
    doubt: float

    def straight(self, x: float, y: float) -> tuple[float, float, float]:
        """End of a straight way from (x, y), and how far to either side of it the discs reach:
        (to_x, to_y, radius)."""
        last = self.discs[-1]
        return last.x, last.y, max(_off(disc, x, y, last) + disc.radius for disc in self.discs)


def said_doubt(age: float) -> float:
    """What the age (s) of a robot's last message adds to its position uncertainty, m."""
    return min(DOUBT_MAX, DOUBT_RATE * max(0.0, age - DOUBT_AFTER_S))


def growth(age: float) -> float:
    """How fast that grows, m/s."""
    return DOUBT_RATE if 0.0 < age - DOUBT_AFTER_S < DOUBT_MAX / DOUBT_RATE else 0.0


def stands_after(horizon_s: float, forgiven_s: float) -> float:
    """T_s (S1): so long after its last message, s, a robot stands whose edge neighbours all tell of it.

    They give it up after `horizon_s` and what is `forgiven_s` to a link; it stands for want of those it does
    not hear, which may have fallen silent for it as late as that.
    """
    return 2.0 * (horizon_s + forgiven_s) + STANDS_S


def stood_on(way: Sequence[tuple[float, float, float]], doubt: float) -> Belief:
    """The belief of a robot that goes on along `way` to its end at most, and stands.

    Args:
        way: rows (s since its last message, x, y), the first of that message.
        doubt: its position uncertainty at its last message, m.
    """
    travelled = [0.0]
    for (_, x0, y0), (_, x1, y1) in pairwise(way):
        travelled.append(travelled[-1] + hypot(x1 - x0, y1 - y0))
    count = max(1, min(DISCS_MAX, ceil(travelled[-1] / STRETCH - 1e-9)))
    stretch = travelled[-1] / count
    discs = []
    low = 0
    for number in range(count):
        high = low
        while high < len(way) - 1 and travelled[high] < (number + 1) * stretch - 1e-9:
            high += 1
        covered = way[low : high + 1]
        x, y = 0.5 * (covered[0][1] + covered[-1][1]), 0.5 * (covered[0][2] + covered[-1][2])
        half = max(hypot(px - x, py - y) for _, px, py in covered)
        discs.append(Disc(x, y, half + doubt, covered[0][0]))
        low = high
    return _belief(discs, tuple((x, y) for _, x, y in way), doubt)


def stood_between(x: float, y: float, to_x: float, to_y: float, radius: float) -> Belief:
    """The belief of a robot that stands somewhere on the straight way from (x, y) to (to_x, to_y), give or
    take `radius`: what another robot has said of it."""
    length = hypot(to_x - x, to_y - y)
    count = max(1, min(DISCS_MAX, ceil(length / STRETCH)))
    discs = []
    for number in range(count):
        share = (number + 0.5) / count
        centre = x + share * (to_x - x), y + share * (to_y - y)
        discs.append(Disc(*centre, radius + 0.5 * length / count, 0.0))
    return _belief(discs, ((x, y), *((disc.x, disc.y) for disc in discs), (to_x, to_y)), radius)


def _belief(discs: list[Disc], way: tuple[Vector, ...], doubt: float) -> Belief:
    x = 0.5 * (min(disc.x for disc in discs) + max(disc.x for disc in discs))
    y = 0.5 * (min(disc.y for disc in discs) + max(disc.y for disc in discs))
    reach = max(hypot(disc.x - x, disc.y - y) + disc.radius_at(inf) for disc in discs)
    return Belief(tuple(discs), x, y, reach, way, doubt)


def _off(disc: Disc, x: float, y: float, last: Disc) -> float:
    """How far a disc's centre is from the straight line between (x, y) and the last one's."""
    dx, dy = last.x - x, last.y - y
    square = dx * dx + dy * dy
    if square < DISTANCE_MIN * DISTANCE_MIN:
        return hypot(disc.x - x, disc.y - y)
    share = max(0.0, min(1.0, ((disc.x - x) * dx + (disc.y - y) * dy) / square))
    return hypot(x + share * dx - disc.x, y + share * dy - disc.y)
