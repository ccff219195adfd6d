"""Where a robot may be that is not heard: a few stretches, and nothing but hearing it takes one away (PURE).

A robot that falls silent may have stopped at once, braked as its plant does, coasted, or followed the law and
its reference: until it gives up those that it does not hear, at the latest, and stands. So it is somewhere on
the way that it was on when it was heard last, which `stood_on` cuts into stretches: straight ones, each as
wide as the way bends in it. Their width grows with what another acceleration than the predicted one makes of
its place meanwhile, and each is there from the time on at which the robot can be on it. Each is kept away
from by itself: the nearest point of a whole way says nothing of the rest of it.

A *lane* is the path of a robot as others know it without hearing it: a line of straight pieces, to keep out
of or to keep on. It is used in every tick near it, so its pieces stand in runs with a circle round each:
`near` picks the runs that matter a few times a second, and each gives a half-plane of its own, for a lane may
come back on another side.

Lengths in m, frame W; times in s since the robot's last message. See (S1) to (S6) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, hypot, inf
from typing import Final, NamedTuple

from handfast.agent.common.quantities import DISTANCE_MIN, Vector

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
WAY_MAX: Final = 256
"""Maximum number of points of a path that another robot has reported."""
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
    count = max(1, min(WAY_MAX, ceil(hypot(dx, dy) / STRETCH)))  # a hostile one may be endless
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


RUN: Final = 6
"""Pieces in one run."""
LENGTH_MAX: Final = 4.0
"""Pieces longer than this are cut, m: a run of long ones would be near to everybody."""
PIECES_MAX: Final = 4096
"""Of a lane; a longer way is taken in longer pieces."""


class Run(NamedTuple):
    """Pieces one after the other, each ``(x, y, dx, dy, 1 / length^2)``, and a circle round them."""

    x: float
    y: float
    reach: float
    pieces: tuple[tuple[float, float, float, float, float], ...]


class Lane:
    """The way of one robot from `points` to points; one point: it stands there."""

    __slots__ = ("_reach", "_runs", "_x", "_y")

    def __init__(self, points: Sequence[Vector]) -> None:
        pieces = [piece for a, b in pairwise(points) for piece in _cut(a, b, points)]
        if not pieces:
            pieces = [(*points[0], 0.0, 0.0, 0.0)]
        self._runs = tuple(_run(pieces[k : k + RUN]) for k in range(0, len(pieces), RUN))
        # A circle round all of it: of many robots, most are far away.
        self._x, self._y, self._reach, _ = _run(pieces)

    def near(self, x: float, y: float, within: float) -> tuple[Run, ...]:
        """The runs that may be nearer to (x, y) than `within`."""
        if hypot(self._x - x, self._y - y) >= self._reach + within:
            return ()
        return tuple(run for run in self._runs if hypot(run.x - x, run.y - y) < run.reach + within)

    def offset(self, x: float, y: float) -> Vector:
        """From its nearest point to (x, y)."""
        return min((offset(run, x, y) for run in self._runs), key=_length)

    def distance(self, x: float, y: float) -> float:
        """How far (x, y) is from it."""
        return _length(self.offset(x, y))

    def reaches(self, x: float, y: float, within: float) -> bool:
        """Whether (x, y) is nearer to it than `within`."""
        return any(_length(offset(run, x, y)) < within for run in self.near(x, y, within))


def offset(run: Run, x: float, y: float) -> Vector:
    """From the nearest point of a run to (x, y)."""
    least, best = float("inf"), (0.0, 0.0)
    for px, py, dx, dy, scale in run.pieces:
        ax, ay = x - px, y - py
        share = (ax * dx + ay * dy) * scale
        if share > 0.0:
            if share > 1.0:
                share = 1.0
            ax, ay = ax - share * dx, ay - share * dy
        square = ax * ax + ay * ay
        if square < least:
            least, best = square, (ax, ay)
    return best


def _cut(a: Vector, b: Vector, points: Sequence[Vector]) -> list[tuple[float, float, float, float, float]]:
    length = hypot(b[0] - a[0], b[1] - a[1])
    if length < DISTANCE_MIN:
        return []
    count = min(int(length / LENGTH_MAX) + 1, max(1, PIECES_MAX // len(points)))
    dx, dy = (b[0] - a[0]) / count, (b[1] - a[1]) / count
    scale = 1.0 / (dx * dx + dy * dy)
    return [(a[0] + k * dx, a[1] + k * dy, dx, dy, scale) for k in range(count)]


def _run(pieces: list[tuple[float, float, float, float, float]]) -> Run:
    xs = [piece[0] for piece in pieces] + [pieces[-1][0] + pieces[-1][2]]
    ys = [piece[1] for piece in pieces] + [pieces[-1][1] + pieces[-1][3]]
    x, y = 0.5 * (min(xs) + max(xs)), 0.5 * (min(ys) + max(ys))
    return Run(x, y, max(hypot(a - x, b - y) for a, b in zip(xs, ys, strict=True)), tuple(pieces))


def _length(vector: Vector) -> float:
    return hypot(*vector)
