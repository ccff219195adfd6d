"""The desired motion of every robot, and who keeps which distance, over time: from missions, in turn (PURE).

All robots take a mission over at one time and come to it within one blend. With s the share of the blend that
is over, r_old and r_new the desired motions before and after,

    r_d = r_old + S (r_new - r_old),    S(s) = 10 s^3 - 15 s^4 + 6 s^5    (M1)

S' and S'' are zero at both ends, so position, velocity and acceleration are continuous; r_old may be in a
blend as well. Where many blends are within one another, what is left of them at that time, e = r_old - r,
with r the motion of the latest of their missions, dies away: the velocity of it as soon as it is braked, in
T_v, so that it carries nobody far, and the rest until the last of them were over, or later, in T,

    r_old = r + e A(t/T) + T_v e' B(t/T_v) + T_v^2 e'' C(t/T_v)
    A = 1 - S,    B(s) = s - 6 s^3 + 8 s^4 - 3 s^5,    C(s) = (s^2 - 3 s^3 + 3 s^4 - s^5) / 2    (M2)

which is continuous likewise, and they need not be remembered. All this is a function of the missions and the
time: robots that have the same missions agree, and one that missed some agrees with the others as soon as the
blend of the last one is over.

Lengths in m, W; times in ns of the wall clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import hypot, sqrt
from typing import Final, NamedTuple

from handfast.agent.common.quantities import DISTANCE_MIN, Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.mission_plan import Plan, plan_of
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.codec import Mark, mark_of, newer
from handfast.agent.messages.types import TIME_NS_MAX, Mission

LEAVE_FADE_NS: Final = 500_000_000
"""Within which the edges of a robot that leaves lose their weight: it brakes, and is not waited for."""
WITHIN_MAX: Final = 16
"""So many blends may be within one another: of more, what is left of them dies away (M2)."""
KEPT_MAX: Final = 2 * WITHIN_MAX
"""So many segments are remembered: twice as many as one in force may come from, for those still to come."""
RATE_MAX: Final = 15.0 / 8.0
BEND_MAX: Final = 10.0 / sqrt(3.0)
BRAKING_MAX: Final = 4.0
"""No S' is greater, no |S''|, and no |B''| of (M2)."""
LEFT_SHARE: Final = 1.0 / 3.0
"""Of the greatest speed, and of the greatest acceleration: what is left of blends takes no more of either."""
_INSTANTS_MAX: Final = 64
_Three = tuple[float, float, float]
_Shape = tuple[_Three, _Three, _Three]


class Edge(NamedTuple):
    """One edge of a robot: the robot at its other end, the wanted distance (m), the weight in (0, 1].

    rate, bend: first and second derivative of the distance by time (m/s, m/s^2), 0 outside of a blend.
    """

    other: int
    distance: float
    weight: float
    rate: float = 0.0
    bend: float = 0.0


class Instant:
    """The desired motion of every robot at one time.

    Args:
        sample: motion of the formation's reference point, by the plan in force.
        offsets: the place of every robot that has one, from there, m, W.
        before: what it is blended from, None outside of a blend.
        share, rate, bend: S and its first and second derivative by time (1/s, 1/s^2).
    """

    __slots__ = "before", "bend", "offsets", "rate", "sample", "share"

    def __init__(
        self,
        sample: Sample,
        offsets: dict[int, Vector],
        before: Instant | None = None,
        share: float = 1.0,
        rate: float = 0.0,
        bend: float = 0.0,
    ) -> None:
        self.sample: Final[Sample] = sample
        self.offsets: Final = offsets
        self.before: Final = before
        self.share: Final = share
        self.rate: Final = rate
        self.bend: Final = bend

    def latest(self, robot: int) -> Sample | None:
        """Of a robot that has a place, or had one before and goes on by that; None for any other."""
        at: Instant | None = self
        while at is not None and robot not in at.offsets:
            at = at.before
        return None if at is None else at.motion(robot)

    def motion(self, robot: int) -> Sample:
        """Of a robot that has a place, which is to be asked first (``robot in offsets``)."""
        dx, dy = self.offsets[robot]
        x, y, vx, vy, ax, ay = self.sample
        x, y = x + dx, y + dy
        before = self.before
        if before is None or robot not in before.offsets:
            return x, y, vx, vy, ax, ay
        x0, y0, vx0, vy0, ax0, ay0 = before.motion(robot)
        share, rate, bend = self.share, self.rate, self.bend
        x, y, vx, vy = x - x0, y - y0, vx - vx0, vy - vy0
        return (
            x0 + share * x,
            y0 + share * y,
            vx0 + share * vx + rate * x,
            vy0 + share * vy + rate * y,
            ax0 + share * (ax - ax0) + 2.0 * rate * vx + bend * x,
            ay0 + share * (ay - ay0) + 2.0 * rate * vy + bend * y,
        )


class _Settling(Instant):
    """The motion by a plan, and what is left of blends before it (M2).

    Args:
        left: of each robot's motion when they were left: position, velocity and acceleration from the plan's.
        shape: A, T_v B and T_v^2 C, and their first and second derivatives by time.
    """

    __slots__ = "left", "shape"

    def __init__(
        self, sample: Sample, offsets: dict[int, Vector], left: dict[int, Sample], shape: _Shape
    ) -> None:
        super().__init__(sample, offsets)
        self.left: Final = left
        self.shape: Final[_Shape] = shape

    def motion(self, robot: int) -> Sample:
        x, y, vx, vy, ax, ay = super().motion(robot)
        ex, ey, evx, evy, eax, eay = self.left[robot]
        (a, b, c), (da, db, dc), (dda, ddb, ddc) = self.shape
        return (
            x + a * ex + b * evx + c * eax,
            y + a * ey + b * evy + c * eay,
            vx + da * ex + db * evx + dc * eax,
            vy + da * ey + db * evy + dc * eay,
            ax + dda * ex + ddb * evx + ddc * eax,
            ay + dda * ey + ddb * evy + ddc * eay,
        )


class _Left(NamedTuple):
    """What is left of blends when they are not followed any more: of the motion of each member
    (`_Settling`), with T_v in s, and of its edges (`Reference._weighted`)."""

    motion: dict[int, Sample]
    braked_s: float
    edges: dict[int, dict[int, _Three]]


class _Segment:
    """One plan, from when it is taken over until the next one is.

    Args:
        left: what it is blended from; None for the motion by the segment before.
    """

    __slots__ = ("_edges", "begin_ns", "blend_ns", "leave_ns", "left", "mark", "offsets", "plan")

    def __init__(self, plan: Plan, begin_ns: int, blend_ns: int, left: _Left | None = None) -> None:
        self.plan: Final = plan
        self.begin_ns: Final = begin_ns
        self.blend_ns: Final = blend_ns
        self.leave_ns: Final = min(blend_ns, LEAVE_FADE_NS)
        self.left: Final[_Left | None] = left
        self.mark: Final[Mark] = mark_of(plan.mission)
        self.offsets: Final = dict(plan.offsets)
        self._edges: dict[int, tuple[Edge, ...]] = {}

    def edges(self, robot: int) -> tuple[Edge, ...]:
        """The robot's edges as the plan has them."""
        known = self._edges.get(robot)
        if known is None:
            ends = ((j if i == robot else i, d) for (i, j), d in self.plan.edges.items() if robot in (i, j))
            known = self._edges[robot] = tuple(Edge(other, d, 1.0) for other, d in sorted(ends))
        return known


class Reference:
    """The desired motion of every robot, and the edges between them, over time.

    Before any mission it is the fleet file's formation, its reference at rest where the trajectory begins.
    After it, until the first take-over that is known, it is the file's on its way since the epoch: what a
    robot assumes that has missed the missions before.

    Args:
        geometry: `agent.formation.geometry.resolve` of `fleet`.

    Args:
        file: the plan of the fleet file, where it is known already.

    Attributes:
        plan: the latest that was taken, None before any.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry, file: Plan | None = None) -> None:
        self.plan: Plan | None = None
        self._made_of = fleet, geometry
        self._file = plan_of(Mission(0, 0, TIME_NS_MAX, 1, ""), fleet, geometry) if file is None else file
        self._segments = [_Segment(self._file, 0, 0)]
        self._instants: dict[int, Instant] = {}

    def take(self, plan: Plan) -> None:
        """Takes a plan over at its time, instead of all that was to be taken over then or later.

        One that is not newer than the latest (`agent.messages.codec.newer`) changes nothing. A plan of
        another epoch is a new drive, of which the former ones are no part.
        """
        latest, epoch_ns = self.plan, plan.mission.epoch_ns
        if latest is not None and not newer(plan.mission, latest.mission):
            return
        if latest is None or latest.mission.epoch_ns != epoch_ns:
            self._segments = [_Segment(replace(self._file, trajectory_ns=epoch_ns), 0, 0)]
        self.plan = plan
        if plan.from_ns <= epoch_ns:  # known before the drive begins: there is nothing to come from
            self._segments = [_Segment(plan, 0, 0)]
        else:
            kept = [segment for segment in self._segments if segment.begin_ns < plan.from_ns]
            if self._within(len(kept), plan.from_ns) >= WITHIN_MAX:
                kept.append(self._settling(len(kept) - 1, plan.from_ns))
            kept.append(_Segment(plan, plan.from_ns, plan.blend_ns))
            if len(kept) > KEPT_MAX:  # its own blend is over long since: (M2)
                kept[: 1 - KEPT_MAX] = [_Segment(kept[-KEPT_MAX].plan, 0, 0)]
            self._segments = kept
        self._instants.clear()

    def _within(self, count: int, time_ns: int) -> int:
        """How many of the blends of the first `count` segments are within one another at a time."""
        within = 0
        for segment in reversed(self._segments[:count]):
            if time_ns - segment.begin_ns >= segment.blend_ns:
                break
            within += 1
            if segment.left is not None:
                break
        return within

    def _settling(self, index: int, time_ns: int) -> _Segment:
        """A segment by the plan of that of this index, from a time on, that blends from what is left then of
        all that are within one another (M2)."""
        plan, until_ns = self._segments[index].plan, time_ns
        for segment in self._segments[index - self._within(index + 1, time_ns) + 1 : index + 1]:
            until_ns = max(until_ns, segment.begin_ns + segment.blend_ns)
        there, alone = self._instant(index, time_ns), Instant(plan.reference(time_ns), dict(plan.offsets))
        left = {robot: _less(there.motion(robot), alone.motion(robot)) for robot in plan.offsets}
        control = self._made_of[0].control
        away = max((hypot(e[0], e[1]) for e in left.values()), default=0.0)
        speed = max((hypot(e[2], e[3]) for e in left.values()), default=0.0)
        slow_s = max(
            RATE_MAX * away / (LEFT_SHARE * control.max_speed_mps),
            sqrt(BEND_MAX * away / (LEFT_SHARE * control.max_acceleration)),
        )
        braked_s = max(1.0, BRAKING_MAX * speed / (LEFT_SHARE * control.max_acceleration))
        blend_ns = max(until_ns - time_ns, round(max(slow_s, braked_s) * NS_PER_S))
        edges = {robot: self._weighted(index, robot, time_ns) for robot in plan.offsets}
        for robot, known in edges.items():
            for other, (excess, _, weight) in known.items():
                gone = None if other in plan.offsets else there.latest(other)
                if gone is not None:  # it goes on no more
                    known[other] = excess, _apart(there.motion(robot), gone)[0], weight
        return _Segment(plan, time_ns, blend_ns, _Left(left, braked_s, edges))

    def frozen(self) -> Reference:
        """The reference as it is now, whatever missions come."""
        copy = Reference(*self._made_of, self._file)
        copy.plan, copy._segments = self.plan, self._segments
        return copy

    def way(self, robot: int, since_ns: int) -> list[Vector]:
        """Where a member's place goes from a time on, to the end of the mission: points that straight lines
        join, m; none for a robot without a place. What comes in blends is left out: ask `settled_ns`."""
        plan = self._segments[-1].plan
        offset = plan.offsets.get(robot)
        if offset is None:
            return []
        end_ns = max(since_ns, plan.mission.epoch_ns + plan.mission.duration_ns)
        span = [(time_ns - plan.trajectory_ns) / NS_PER_S for time_ns in (since_ns, end_ns)]
        return [(x + offset[0], y + offset[1]) for x, y in plan.trajectory.path(*span)]

    @property
    def settled_ns(self) -> int:
        """When the last blend that is known of is over."""
        last = self._segments[-1]
        return last.begin_ns + last.blend_ns

    def since(self, mark: Mark, time_ns: int) -> int:
        """Number of the earliest mission that a robot may follow from a time on which has acknowledged that
        of `mark`: of the earlier one of that and the one in force then. 0 for a mark that is not known."""
        segments, index = self._segments, self._index(time_ns)
        if index and time_ns - segments[index].begin_ns < segments[index].blend_ns:
            index -= 1
        known = (number for number, segment in enumerate(segments) if segment.mark == mark)
        return min(index, next(known, 0))

    def sharing(self, robot: int, first: int) -> Iterator[tuple[int, tuple[Edge, ...]]]:
        """The missions from number `first` on in which a robot has a place, and its edges in each."""
        for number in range(first, len(self._segments)):
            segment = self._segments[number]
            if robot in segment.plan.offsets:
                yield number, segment.edges(robot)

    def active(self, time_ns: int) -> Plan:
        """The plan that is in force; before any mission one of version 0, the fleet file's."""
        return self._segments[self._index(time_ns)].plan

    def members(self, time_ns: int) -> tuple[int, ...]:
        """Ids of the robots that have a place, in the file's order."""
        return self.active(time_ns).members

    def is_member(self, robot: int, time_ns: int) -> bool:
        """Whether a robot has a place."""
        return robot in self.active(time_ns).offsets

    def motion(self, robot: int, time_ns: int) -> Sample | None:
        """Desired position, velocity and acceleration of a member's hand; None for a robot without a place.

        A robot that has just got its place is to be there at once: how it comes there is not the reference's.
        """
        instant = self.instant(time_ns)
        return instant.motion(robot) if robot in instant.offsets else None

    def instant(self, time_ns: int) -> Instant:
        """The desired motion of all at one time: few times are asked for, for every robot each."""
        known = self._instants.get(time_ns)
        if known is None:
            if len(self._instants) >= _INSTANTS_MAX:
                self._instants.clear()
            known = self._instants[time_ns] = self._instant(self._index(time_ns), time_ns)
        return known

    def edges(self, robot: int, time_ns: int) -> tuple[Edge, ...]:
        """A member's edges, by the other's id; none for a robot without a place.

        In a blend an edge that stays is as long as the places of its ends are apart on their way, one that is
        new gains weight, one that is no more loses it, that to a robot which left within `LEAVE_FADE_NS`, as
        long as if that had gone on.
        Where a plan wants an edge longer or shorter than its places are apart, the difference is blended.
        """
        index = self._index(time_ns)
        segment = self._segments[index]
        if time_ns - segment.begin_ns >= segment.blend_ns:
            return segment.edges(robot)
        weighted = self._weighted(index, robot, time_ns)
        instant = self.instant(time_ns)
        own = instant.latest(robot)
        edges = []
        for other in sorted(weighted):
            excess, apart, weight = weighted[other]
            there = instant.latest(other)
            if weight > 0.0:
                rate = bend = 0.0
                if own is not None and there is not None:
                    apart, rate, bend = _apart(own, there)
                edges.append(Edge(other, apart + excess, weight, rate, bend))
        return tuple(edges)

    def _index(self, time_ns: int) -> int:
        segments = self._segments
        index = len(segments) - 1
        while index and time_ns < segments[index].begin_ns:
            index -= 1
        return index

    def _instant(self, index: int, time_ns: int) -> Instant:
        segment = self._segments[index]
        plan, since_ns = segment.plan, time_ns - segment.begin_ns
        sample = plan.reference(time_ns)
        if since_ns >= segment.blend_ns:
            return Instant(sample, segment.offsets)
        if segment.left is not None:
            shape = _dying_shape(since_ns / NS_PER_S, segment.blend_ns / NS_PER_S, segment.left.braked_s)
            return _Settling(sample, segment.offsets, segment.left.motion, shape)
        share, rate, bend = blend_shape(since_ns / segment.blend_ns)
        per_s = NS_PER_S / segment.blend_ns
        before = self._instant(index - 1, time_ns)
        return Instant(sample, segment.offsets, before, share, rate * per_s, bend * per_s * per_s)

    def _weighted(self, index: int, robot: int, time_ns: int) -> dict[int, _Three]:
        """A robot's edges, by the robots at their other ends: by how much the wanted distance is more than
        the places are apart (m), how far these are apart in the plan (m), and the weight.
        """
        segment = self._segments[index]
        since_ns, offsets = time_ns - segment.begin_ns, segment.plan.offsets
        wanted = []
        for other, distance, weight, _, _ in segment.edges(robot):
            (x, y), (ox, oy) = offsets[robot], offsets[other]
            apart = hypot(x - ox, y - oy)
            wanted.append((other, distance - apart, apart, weight))
        if since_ns >= segment.blend_ns:
            return {other: (excess, apart, weight) for other, excess, apart, weight in wanted}
        if robot not in offsets:
            return {}
        if segment.left is not None:
            before = dict(segment.left.edges[robot])
        else:
            before = self._weighted(index - 1, robot, time_ns)
        share = _share(since_ns / segment.blend_ns)
        weighted = {}
        for other, excess, apart, _ in wanted:
            was, _, weight = before.pop(other, (excess, apart, 0.0))
            weighted[other] = was + share * (excess - was), apart, weight + share * (1.0 - weight)
        for other, (excess, apart, weight) in before.items():
            fade_ns = segment.blend_ns if other in offsets else segment.leave_ns
            if since_ns < fade_ns:
                weighted[other] = excess, apart, weight * _share(1.0 - since_ns / fade_ns)
        return weighted


def _apart(own: Sample, other: Sample) -> _Three:
    """Distance between two motions, m, and its first and second derivative by time."""
    x, y, vx, vy, ax, ay = (a - b for a, b in zip(own, other, strict=True))
    rho = hypot(x, y)
    if rho < DISTANCE_MIN:
        return rho, 0.0, 0.0
    nx, ny = x / rho, y / rho
    across = nx * vy - ny * vx
    return rho, nx * vx + ny * vy, nx * ax + ny * ay + across * across / rho


def _less(one: Sample, other: Sample) -> Sample:
    """How far one motion is from another."""
    x, y, vx, vy, ax, ay = one
    x0, y0, vx0, vy0, ax0, ay0 = other
    return x - x0, y - y0, vx - vx0, vy - vy0, ax - ax0, ay - ay0


def _dying_shape(t: float, seconds: float, braked_s: float) -> _Shape:
    """A, T_v B and T_v^2 C of (M2) a time t after, within [0, T], and their derivatives by time."""
    share, rate, bend = blend_shape(t / seconds)
    s = min(1.0, t / braked_s)
    b, c = s * (1.0 + s * s * (s * (8.0 - 3.0 * s) - 6.0)), 0.5 * s * s * (1.0 - s) ** 3
    db = 1.0 + s * s * (s * (32.0 - 15.0 * s) - 18.0)
    dc = 0.5 * s * (1.0 - s) ** 2 * (2.0 - 5.0 * s)
    ddb = s * (s * (96.0 - 60.0 * s) - 36.0)
    ddc = 1.0 + s * (s * (18.0 - 10.0 * s) - 9.0)
    return (
        (1.0 - share, braked_s * b, braked_s * braked_s * c),
        (-rate / seconds, db, braked_s * dc),
        (-bend / (seconds * seconds), ddb / braked_s, ddc),
    )


def blend_shape(s: float) -> _Three:
    """S, S' and S'' at the share s of a blend, within [0, 1]."""
    left = s * (1.0 - s)
    return _share(s), 30.0 * left * left, 60.0 * left * (1.0 - 2.0 * s)


def _share(s: float) -> float:
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))
