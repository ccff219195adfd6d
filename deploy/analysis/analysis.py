"""A run on one grid of times: actual and desired places, edges and distances.

The desired places, edges and distances are those of the missions in force.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.mission_plan import PlanError, plan_of
from handfast.agent.formation.points import Floats
from handfast.agent.formation.reference import Reference
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.messages.types import Mission
from handfast.deploy.analysis.presence import (
    Flags,
    PoseGap,
    Uncommanded,
    away,
    carried_off,
    downs,
    kept_through,
    pose_gaps,
    uncommanded,
    unknown,
)
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.recording.recording import Recording


class MissionChange(NamedTuple):
    """From `t_s` (fleet time) on another mission held: its version, and in words what it changed."""

    t_s: float
    version: int
    note: str


@dataclass(frozen=True)
class Desired:
    """For k times, n robots (all of the recording) and m edges (all that were ever in force).

    places: (k, n, 2) m, NaN for a robot that has no place. edges: (m, 2) rows of robots. wanted: (k, m) m,
    NaN where the edge is not in force. whole: (k, m), where it is neither coming nor going. mission_version:
    that of the last mission, 0 without one.
    """

    places: Floats
    edges: NDArray[np.int64]
    wanted: Floats
    whole: NDArray[np.bool_]
    changes: tuple[MissionChange, ...] = ()
    mission_version: int = 0


def desired(recording: Recording, geometry: Geometry, grid: Floats) -> Desired:
    """What the fleet was to do at `grid` (k,) s, if it heard what the recording holds.

    A mission that cannot be driven is left out, as agents leave it.
    """
    missions = recording.held_missions
    version = missions[-1].version if missions else 0
    if any(mission.robots or mission.edges or mission.trajectory for mission in missions):
        return _by_course(recording, geometry, grid, missions)
    rows = np.array([recording.ids.index(robot) for robot in geometry.ids], dtype=np.int64)
    trajectory = make_trajectory(recording.fleet.trajectory)
    centre = np.array([trajectory.at(float(t))[:2] for t in grid])
    places = np.full((len(grid), len(recording.ids), 2), np.nan)
    places[:, rows] = centre[:, None, :] + np.asarray(geometry.offsets, dtype=np.float64)[None, :, :]
    edges = rows[np.asarray(geometry.edges, dtype=np.int64).reshape(-1, 2)]
    distances = np.asarray(geometry.distances, dtype=np.float64)
    wanted = np.broadcast_to(distances, (len(grid), len(edges)))
    return Desired(places, edges, wanted, np.ones(wanted.shape, dtype=np.bool_), (), version)


def _by_course(
    recording: Recording, geometry: Geometry, grid: Floats, missions: Sequence[Mission]
) -> Desired:
    fleet, ids, epoch_ns = recording.fleet, recording.ids, recording.epoch_ns or 0
    row = {robot: index for index, robot in enumerate(ids)}
    reference = Reference(fleet, geometry)
    pending = [*reversed(missions)]
    changes: list[MissionChange] = []
    version = 0
    places = np.full((len(grid), len(ids), 2), np.nan)
    columns: dict[tuple[int, int], int] = {}
    cells: list[tuple[int, int, float, bool]] = []
    for k, t in enumerate(grid.tolist()):
        time_ns = epoch_ns + round(t * 1e9)
        while pending and pending[-1].time_ns <= time_ns:
            mission = pending.pop()
            try:
                plan = plan_of(mission, fleet, geometry)
            except PlanError:
                continue
            reference.take(plan)
            if version:
                changes.append(
                    MissionChange(recording.fleet_time_s(plan.from_ns), mission.version, mission.note)
                )
            version = mission.version
        for robot, index in row.items():
            motion = reference.motion(robot, time_ns)
            if motion is not None:
                places[k, index] = motion[:2]
            for edge in reference.edges(robot, time_ns):
                if robot < edge.other:
                    column = columns.setdefault((index, row[edge.other]), len(columns))
                    cells.append((k, column, edge.distance, edge.weight >= 1.0))
    wanted = np.full((len(grid), len(columns)), np.nan)
    whole = np.zeros(wanted.shape, dtype=np.bool_)
    for k, column, distance, is_whole in cells:
        wanted[k, column], whole[k, column] = distance, is_whole
    edges = np.array(list(columns), dtype=np.int64).reshape(-1, 2)
    return Desired(places, edges, wanted, whole, tuple(changes), version)


FINE_S: Final = 0.021
"""Robots that pass each other at 3 m/s come at most 2 mm nearer than at one of two times so near."""
_BRAKING_S: Final = 0.3
"""Of a simulated body at 1.5 m/s (`plant.unicycle.BRAKE_DECELERATION_MAX`)."""


class Approach(NamedTuple):
    """The closest that a pair of robots came."""

    distance_m: float
    t_s: float
    pair: tuple[int, int]


class Approaches(NamedTuple):
    """Of all pairs of one kind: the closest, and of each pair that came below the safe distance the closest.

    Pairs that begin below it and come apart later are left out of both until then.

    Attributes:
        unavoidable: those that came below it while one of them went on by itself, and nobody steered the
            other one.
        unsafe: all others that did.
    """

    closest: Approach | None
    unsafe: tuple[Approach, ...]
    unavoidable: tuple[Approach, ...] = ()


class Settled(NamedTuple):
    """A change of mission, and how long after it the last edge was off; None when one was when the next
    change came, or the end."""

    change: MissionChange
    after_s: float | None


@dataclass(frozen=True)
class Analysis:
    """A run on one grid of k times, for n robots (all of them) and m edges (all that were ever in force).

    `hands` and `desired` (k, n, 2) m; `distances`, `wanted` (k, m) m. NaN where a robot sent no pose at all,
    where none of its came for long (`gaps`), where it had been carried off, has no place, or an edge is not
    in force. So only what was measured counts as near, and as a distance.
    """

    ids: tuple[int, ...]
    safe_m: float
    grid: Floats
    hands: Floats
    desired: Floats
    edges: NDArray[np.int64]
    wanted: Floats
    distances: Floats
    counts: Flags
    """(k, m): the edge is in force, wholly, its length is known, and both its robots could follow."""
    off: Flags
    """(k, m): it counts, and is further than `SETTLED` from its distance."""
    away: Flags
    """(k, n): the robot could not follow (`deploy.analysis.presence.away`)."""
    settling_s: float | None
    """Last time (s) that any edge was off, 0 when none was, or there is none; None when one is at the end,
    when no robot (with an edge, if there is one) can follow then, or nothing is known. An edge whose length
    is not known for a while was off all the while if it was before, or is after."""
    changes: tuple[Settled, ...]
    """Of mission, within the drive."""
    mission_version: int
    gaps: tuple[PoseGap, ...]
    """Those that hide where a robot was."""
    uncommanded: Uncommanded

    @cached_property
    def unknown(self) -> Flags:
        """(k, n): whether a gap hides where a robot was."""
        return unknown(self.gaps, self.ids, self.grid)

    @cached_property
    def with_edge(self) -> Approaches:
        """Of pairs while they shared an edge."""
        return self._approaches(sharing=True)

    @cached_property
    def without_edge(self) -> Approaches:
        """Of pairs while they shared none."""
        return self._approaches(sharing=False)

    @cached_property
    def closest(self) -> Approach | None:
        """Of any two robots; None where no two are known."""
        return min(
            (each.closest for each in (self.with_edge, self.without_edge) if each.closest), default=None
        )

    def _approaches(self, *, sharing: bool) -> Approaches:
        n = len(self.ids)
        columns: dict[int, list[tuple[int, int]]] = {}
        for column, (i, j) in enumerate(self.edges.tolist()):
            columns.setdefault(min(i, j), []).append((max(i, j), column))
        in_force = np.isfinite(self.wanted)
        closest: Approach | None = None
        unsafe: list[Approach] = []
        unavoidable: list[Approach] = []
        for i in range(n - 1):  # a robot at a time: all pairs of a large fleet at once would not fit
            between = self._nearest(self.hands[:, i + 1 :] - self.hands[:, i : i + 1])
            shared = np.zeros(between.shape, dtype=np.bool_)
            for j, column in columns.get(i, ()):
                shared[:, j - i - 1] |= in_force[:, column]
            below = between < self.safe_m  # False for NaN
            between[np.isnan(between) | (shared != sharing)] = np.inf
            k, at = divmod(int(between.argmin()), n - 1 - i)
            distance = float(between[k, at])
            if isfinite(distance) and (closest is None or distance < closest.distance_m):
                closest = Approach(distance, float(self.grid[k]), (self.ids[i], self.ids[i + 1 + at]))
            for at in np.flatnonzero((between < self.safe_m).any(axis=0)).tolist():
                apart = np.flatnonzero(~below[:, at])
                if len(apart):
                    between[: apart[0], at] = np.inf
                left = self._left_alone(i, i + 1 + at)
                for found, rows in ((unsafe, ~left), (unavoidable, left)):
                    apart_m = np.where(rows, between[:, at], np.inf)
                    k = int(apart_m.argmin())
                    if apart_m[k] < self.safe_m:
                        pair = self.ids[i], self.ids[i + 1 + at]
                        found.append(Approach(float(apart_m[k]), float(self.grid[k]), pair))
        return Approaches(closest, tuple(sorted(unsafe)), tuple(sorted(unavoidable)))

    def _left_alone(self, i: int, j: int) -> Flags:
        """(k,): where neither of two could do anything for their distance, and one rolled."""
        rolling, helpless = self.uncommanded
        both: Flags = (rolling[:, i] | rolling[:, j]) & helpless[:, i] & helpless[:, j]
        return both

    def _nearest(self, apart: Floats) -> Floats:
        """How near two robots come from each time of the grid until the next, (k, m), from the vectors
        (k, m, 2) between them: at a low rate they may have passed each other by then, going straight on."""
        found = norm(apart)
        if len(self.grid) > 1 and self.grid[1] - self.grid[0] > FINE_S:
            step = apart[1:] - apart[:-1]
            squared = (step * step).sum(axis=-1)
            share = -(apart[:-1] * step).sum(axis=-1) / np.where(squared > 0.0, squared, 1.0)
            passing = (share > 0.0) & (share < 1.0)  # False for NaN
            found[:-1][passing] = norm(apart[:-1][passing] + share[passing][:, None] * step[passing])
        return found


def analyse(recording: Recording, geometry: Geometry) -> Analysis:
    """The run's hand points, desired hand points and edge distances over time."""
    grid = recording.grid
    wish = desired(recording, geometry, grid)
    gaps = tuple(
        gap for gap in pose_gaps(recording) if gap.is_hidden and not _is_left(gap, recording, wish.places)
    )
    hands = hands_at(recording, grid, gaps)
    edges, wanted = wish.edges, wish.wanted
    distances = norm(hands[:, edges[:, 0]] - hands[:, edges[:, 1]])
    hides = unknown(gaps, recording.ids, grid)
    hidden = hides[:, edges[:, 0]] | hides[:, edges[:, 1]]
    gone = away(recording, grid)
    follow = wish.whole & ~gone[:, edges[:, 0]] & ~gone[:, edges[:, 1]]
    counts = follow & np.isfinite(distances)
    off: Flags = counts & (np.abs(distances - wanted) > SETTLED * wanted)
    maybe_off = follow & kept_through(off, hidden)
    lost = bool(wish.whole[-1].any()) and not counts[-1].any()  # of nobody's edges one can say that they hold
    # As of one robot: nothing can be off, but somebody must be there to say so of.
    bare = not len(edges) and bool((np.isfinite(wish.places[-1]).all(axis=-1) & ~gone[-1]).any())
    settling_s = _last_off(grid, maybe_off) if bare or (counts.any() and not lost) else None
    end_s = float(grid[-1])
    changes = [change for change in wish.changes if change.t_s <= end_s]
    ends = [*(change.t_s for change in changes[1:]), end_s]
    settled = tuple(
        Settled(change, _settled_after(grid, maybe_off, change.t_s, until_s))
        for change, until_s in zip(changes, ends, strict=False)
    )
    return Analysis(
        recording.ids, recording.fleet.formation.safe_distance_m, grid, hands, wish.places, edges, wanted,
        distances, counts, off, gone, settling_s,
        settled, wish.mission_version, gaps, uncommanded(recording, grid),
    )  # fmt: skip


def hands_at(recording: Recording, times: Floats, gaps: Iterable[PoseGap]) -> Floats:
    """Hand points (k, n, 2), m, at `times` (k,) s: NaN where they are not known."""
    hands = recording.hand_positions(times)
    _fill_downs(recording, times, hands)
    hands[carried_off(recording, times) | unknown(gaps, recording.ids, times)] = np.nan
    return hands


def _is_left(gap: PoseGap, recording: Recording, places: Floats) -> bool:
    """Whether a robot that nothing more came of has no place at the end: it has been given up where it was
    seen last, and its body is taken to be there."""
    return gap.lasts and not np.isfinite(places[-1, recording.ids.index(gap.robot), 0])


def _fill_downs(recording: Recording, grid: Floats, hands: Floats) -> None:
    """Where simulated bodies were while their plants were killed or paused, into `hands` (k, n, 2).

    They come to a stand within the wrench timeout and their braking time, and stand where they are found.
    """
    for index, (robot, data) in enumerate(recording.robots.items()):
        if recording.mode != "simulate" and recording.fleet.robot(robot).kind.vehicle:
            continue
        t = data.body.t
        for down in downs(recording, robot, "plant"):
            after = int(np.searchsorted(t, down.end_s))
            if not 0 < after < len(t):
                continue
            begin_s, end_s = float(t[after - 1]), float(t[after])
            stands_s = begin_s + recording.fleet.control.wrench_timeout_s + _BRAKING_S
            if stands_s < end_s:
                was, found = recording.hand_positions(t[after - 1 : after + 1])[:, index]
                gap = (grid > begin_s) & (grid < end_s)
                share = np.minimum((grid[gap] - begin_s) / (stands_s - begin_s), 1.0)
                hands[gap, index] = was + share[:, None] * (found - was)


def _last_off(grid: Floats, off: Flags) -> float | None:
    if not len(off) or off[-1].any():
        return None
    when = np.flatnonzero(off.any(axis=1))
    return float(grid[when[-1]]) if len(when) else 0.0


def _settled_after(grid: Floats, off: Flags, from_s: float, until_s: float) -> float | None:
    rows = (grid >= from_s) & (grid <= until_s)
    last_s = _last_off(grid[rows], off[rows])
    return None if last_s is None else max(last_s - from_s, 0.0)


def norm(vectors: Floats) -> Floats:
    """Euclidean lengths (...) of vectors (..., 2)."""
    length: Floats = np.hypot(vectors[..., 0], vectors[..., 1])
    return length
