"""The desired motion of every robot, and who keeps which distance, over time: from missions, in turn (PURE).

All robots take a mission over at one time and come to it within one blend. With s the share of the blend that
is over, r_old and r_new the desired motions before and after,

    r_d = r_old + S (r_new - r_old),    S(s) = 10 s^3 - 15 s^4 + 6 s^5    (M1)

S' and S'' are zero at both ends, so position, velocity and acceleration are continuous; r_old may be in a
blend as well. All this is a function of the missions and the time: robots that have the same missions agree,
and one that missed some agrees with the others as soon as the blend of the last one is over.

Lengths in m, W; times in ns of the wall clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import hypot
from typing import Final, NamedTuple

from agent.common.quantities import DISTANCE_MIN, Vector
from agent.common.time import NS_PER_S
from agent.fleet.model import Fleet
from agent.formation.geometry import Geometry
from agent.formation.mission_plan import Plan, plan_of
from agent.formation.trajectory import Sample
from agent.messages.codec import Mark, mark_of, newer
from agent.messages.types import TIME_NS_MAX, Mission

LEAVE_FADE_NS: Final = 500_000_000
"""Within which the edges of a robot that leaves lose their weight: it brakes, and is not waited for."""
_SEGMENTS_MAX: Final = 8  # blends of missions before these are over
_INSTANTS_MAX: Final = 64


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


class _Segment:
    """One plan, from when it is taken over until the next one is."""

    __slots__ = ("_edges", "begin_ns", "blend_ns", "leave_ns", "mark", "offsets", "plan")

    def __init__(self, plan: Plan, begin_ns: int, blend_ns: int) -> None:
        self.plan: Final = plan
        self.begin_ns: Final = begin_ns
        self.blend_ns: Final = blend_ns
        self.leave_ns: Final = min(blend_ns, LEAVE_FADE_NS)
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
            if len(kept) == _SEGMENTS_MAX:
                kept[:2] = [_Segment(kept[1].plan, 0, 0)]
            self._segments = [*kept, _Segment(plan, plan.from_ns, plan.blend_ns)]
        self._instants.clear()

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
        new gains weight, one that is no more loses it, that to a robot which left within `LEAVE_FADE_NS`.
        Where a plan wants an edge longer or shorter than its places are apart, the difference is blended.
        """
        index = self._index(time_ns)
        segment = self._segments[index]
        if time_ns - segment.begin_ns >= segment.blend_ns:
            return segment.edges(robot)
        weighted = self._weighted(index, robot, time_ns)
        own = self.motion(robot, time_ns)
        edges = []
        for other in sorted(weighted):
            excess, apart, weight = weighted[other]
            there = self.motion(other, time_ns)
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
        share, rate, bend = blend_shape(since_ns / segment.blend_ns)
        per_s = NS_PER_S / segment.blend_ns
        before = self._instant(index - 1, time_ns)
        return Instant(sample, segment.offsets, before, share, rate * per_s, bend * per_s * per_s)

    def _weighted(self, index: int, robot: int, time_ns: int) -> dict[int, tuple[float, float, float]]:
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


def _apart(own: Sample, other: Sample) -> tuple[float, float, float]:
    """Distance between two motions, m, and its first and second derivative by time."""
    x, y, vx, vy, ax, ay = (a - b for a, b in zip(own, other, strict=True))
    rho = hypot(x, y)
    if rho < DISTANCE_MIN:
        return rho, 0.0, 0.0
    nx, ny = x / rho, y / rho
    across = nx * vy - ny * vx
    return rho, nx * vx + ny * vy, nx * ax + ny * ay + across * across / rho


def blend_shape(s: float) -> tuple[float, float, float]:
    """S, S' and S'' at the share s of a blend, within [0, 1]."""
    left = s * (1.0 - s)
    return _share(s), 30.0 * left * left, 60.0 * left * (1.0 - 2.0 * s)


def _share(s: float) -> float:
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))
