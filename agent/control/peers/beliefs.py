"""Where a robot may be that is not heard: a few stretches, and nothing but hearing it takes one away (PURE).

A robot that falls silent may have stopped at once, braked as its plant does, coasted, or followed the law and
its reference: until it gives up those that it does not hear, at the latest, and stands. So it is somewhere on
the way that it was on when it was heard last, which `stood_on` cuts into stretches: straight ones, each as
wide as the way bends in it. Their width grows with what another acceleration than the predicted one makes of
its place meanwhile, and each is there from the time on at which the robot can be on it. Each is kept away
from by itself: the nearest point of a whole way says nothing of the rest of it.

Lengths in m, W; times in s since the robot's last message. See (S1) to (S6) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, hypot, inf
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector

DOUBT_RATE: Final = 0.15
"""How fast the position uncertainty of a robot grows that is not heard, m/s: about what another acceleration
than the predicted one makes of a robot's place in a second."""
DOUBT_AFTER_S: Final = 0.1
"""It grows from this age of a robot's last message on."""
DOUBT_MAX: Final = 0.3
"""Largest position uncertainty, m: of what a robot says itself, and of what its silence adds."""
DOUBT_ROLLS_MAX: Final = 10.0
"""The same of what one says whose body may roll on: it tells of all of that way."""
STANDS_S: Final = 1.0
"""Who hears nobody, or is told by beacons that nobody hears it, stands so long after it is given up."""
STRETCHES_MAX: Final = 8
"""Of one robot."""
STRETCH: Final = 0.25
"""Length of one while there are enough of them, m."""
AHEAD_S: Final = 0.1
"""One is kept away from so much before the robot can be on it: those near are looked for as often."""


class Stretch(NamedTuple):
    """Where a robot may be: up to `radius` off the straight line from (x, y) to (x + dx, y + dy), m; from
    `after` s after its last message on."""

    x: float
    y: float
    dx: float
    dy: float
    radius: float
    after: float

    def radius_at(self, age: float) -> float:
        """Its radius so many seconds after the robot's last message, m."""
        return self.radius + said_doubt(age)

    def offset(self, x: float, y: float) -> tuple[float, float, bool]:
        """From the nearest point of the line to (x, y), and whether that is one of its ends."""
        dx, dy = self.dx, self.dy
        ox, oy = x - self.x, y - self.y
        along = ox * dx + oy * dy
        if along <= 0.0:
            return ox, oy, True
        square = dx * dx + dy * dy
        if along >= square:
            return ox - dx, oy - dy, True
        share = along / square
        return ox - share * dx, oy - share * dy, False

    def distance(self, x: float, y: float) -> float:
        """How far (x, y) is from the line."""
        ox, oy, _ = self.offset(x, y)
        return hypot(ox, oy)

    @property
    def end(self) -> Vector:
        """Where it leads to."""
        return self.x + self.dx, self.y + self.dy


class Belief(NamedTuple):
    """Where one robot may be that is not heard.

    Attributes:
        stretches: in the order of its way.
        x, y, reach: a circle round all of them.
        way, doubt: points of the way that they cover, and how far off it the robot may be; the age of its
            last message adds to that.
        own: those of the stretches on which it went by itself, not as a body that nothing commands.
    """

    stretches: tuple[Stretch, ...]
    x: float
    y: float
    reach: float
    way: tuple[Vector, ...]
    doubt: float
    own: tuple[Stretch, ...]

    def straight(self, x: float, y: float) -> tuple[float, float, float]:
        """End of a straight way from (x, y), and how far to either side of it its `own` stretches reach:
        (to_x, to_y, radius). The way of a body that nothing commands is told by itself: a straight one that
        has that beside it as well would be so wide that it says nothing."""
        to_x, to_y = self.own[-1].end
        line = Stretch(x, y, to_x - x, to_y - y, 0.0, 0.0)
        ends = ((end, each.radius) for each in self.own for end in ((each.x, each.y), each.end))
        return to_x, to_y, max(line.distance(*end) + radius for end, radius in ends)


def said_doubt(age: float) -> float:
    """What the age (s) of a robot's last message adds to its position uncertainty, m."""
    return min(DOUBT_MAX, DOUBT_RATE * max(0.0, age - DOUBT_AFTER_S))


def own_doubt(doubt: float, *, rolls: bool) -> float:
    """What a robot said of its own position uncertainty (m), as far as it is believed.

    Args:
        rolls: whether nothing commands its body, which may go on as it went.
    """
    return min(DOUBT_ROLLS_MAX if rolls else DOUBT_MAX, doubt)


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
    so_far, travelled = 0.0, [0.0]
    _, x, y = way[0]
    for _, to_x, to_y in way[1:]:
        so_far += hypot(to_x - x, to_y - y)
        travelled.append(so_far)
        x, y = to_x, to_y
    count = max(1, min(STRETCHES_MAX, ceil(so_far / STRETCH - 1e-9)))
    length = so_far / count
    stretches = []
    low, last = 0, len(way) - 1
    for number in range(count):
        high, until = low, (number + 1) * length - 1e-9
        while high < last and travelled[high] < until:
            high += 1
        after, x, y = way[low]
        _, to_x, to_y = way[high]
        line = Stretch(x, y, to_x - x, to_y - y, doubt, after)
        bends = 0.0  # of those between its ends
        for _, to_x, to_y in way[low + 1 : high]:
            bends = max(bends, line.distance(to_x, to_y))
        stretches.append(Stretch(x, y, line.dx, line.dy, bends + doubt, after))
        low = high
    return _belief(stretches, tuple((x, y) for _, x, y in way), doubt)


def rolled_on(belief: Belief, way: Sequence[tuple[float, float, float]], off: float) -> Belief:
    """The same of a robot whose body may also have gone on along `way`, as in `stood_on`, until it stopped by
    itself: nothing commands it. It may be `off` so far beside that, m."""
    rolled = stood_on(way, belief.doubt + off)
    stretches = sorted((*belief.stretches, *rolled.stretches), key=lambda each: each.after)
    return _belief(stretches, (*belief.way, *rolled.way[1:]), belief.doubt)._replace(own=belief.own)


def stood_between(x: float, y: float, to_x: float, to_y: float, radius: float) -> Belief:
    """The belief of a robot that stands somewhere on the straight way from (x, y) to (to_x, to_y), give or
    take `radius`: what another robot has said of it."""
    dx, dy = to_x - x, to_y - y
    count = max(1, ceil(hypot(dx, dy) / STRETCH))
    way = tuple((x + k / count * dx, y + k / count * dy) for k in range(count + 1))
    return _belief([Stretch(x, y, dx, dy, radius, 0.0)], way, radius)


def _belief(stretches: list[Stretch], way: tuple[Vector, ...], doubt: float) -> Belief:
    left = low = inf
    right = high = -inf
    for each in stretches:
        for x, y in ((each.x, each.y), (each.x + each.dx, each.y + each.dy)):
            left, right, low, high = min(left, x), max(right, x), min(low, y), max(high, y)
    x, y, reach = 0.5 * (left + right), 0.5 * (low + high), 0.0
    for each in stretches:
        away = max(hypot(each.x - x, each.y - y), hypot(each.x + each.dx - x, each.y + each.dy - y))
        reach = max(reach, away + each.radius + DOUBT_MAX)
    return Belief(tuple(stretches), x, y, reach, way, doubt, tuple(stretches))
