"""What was at stake while nobody knew where a robot was: how near it can have come to what it must not touch.

Its hand was nowhere but where its greatest speed lets it be (`deploy.analysis.reach`), between the pose
before the gap and the one after it. The others were where they were measured, or within bounds of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.boundaries import fence_of, obstacles_of
from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.analysis import Analysis, hands_at
from handfast.deploy.analysis.clearances import distances
from handfast.deploy.analysis.gaps import PoseGap
from handfast.deploy.analysis.reach import Disc, Reach, Seen, known, least_apart
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.oracles_distance import clearance_kept_m, furthest_outside_m
from handfast.deploy.verdict.oracles_drive import SPEED_MORE_MPS, SPEED_SHARE

STEP_S: Final = 0.02
"""Robots are compared so often within a gap."""
FENCE: Final = "the geofence"


class Stake(NamedTuple):
    """The nearest that a robot can have come to something in a gap.

    Attributes:
        what: it is.
        least_m: no nearer than this, m: a lower bound.
        safe_m: nearer than this it must not come, m.
    """

    what: str
    least_m: float
    safe_m: float

    @property
    def may_be_broken(self) -> bool:
        """Whether it can have come too near."""
        return self.least_m < self.safe_m

    @property
    def words(self) -> str:
        """What may have happened, after "it"."""
        if self.what == FENCE:
            return f"may have been up to {-self.least_m:.2f} m outside {FENCE}"
        if self.least_m < 0.0:
            return f"may have been up to {-self.least_m:.2f} m inside {self.what}"
        kind = "safe distance" if self.what.startswith("robot ") else "at least"
        return f"may have come within {self.least_m:.2f} m of {self.what} ({kind} {self.safe_m:.2f} m)"


class Stakes:
    """How near robots can have come to anything in the gaps of a run."""

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self._reaches: dict[PoseGap, Reach] = {}
        self._speeds: dict[int, float] = {}

    def nearest(self, gap: PoseGap) -> Stake | None:
        """What it can have come nearest to, by what is to be kept from that; None where there is nothing."""
        found = [*self._boundaries(gap), *self._others(gap)]
        return min(found, key=lambda stake: stake.least_m - stake.safe_m, default=None)

    def too_far_m(self, gap: PoseGap) -> float:
        """By how much it moved further than its speed allows, m: then nothing bounds where it was."""
        return self._reach(gap).too_far_m

    def _reach(self, gap: PoseGap) -> Reach:
        if gap not in self._reaches:
            before, after = self._seen(gap, gap.before), self._seen(gap, gap.after)
            self._reaches[gap] = Reach(before, after, self._speed(gap.robot))
        return self._reaches[gap]

    def _seen(self, gap: PoseGap, row: int) -> Seen | None:
        """Where the hand was at a pose."""
        body = self._recording.robots[gap.robot].body
        if not 0 <= row < len(body):
            return None
        t = body.t[row : row + 1]
        x, y = self._recording.hand_positions(t)[0, self._a.ids.index(gap.robot)].tolist()
        return Seen(float(t[0]), x, y)

    def _speed(self, robot: int) -> float:
        """The greatest speed of a robot's hand, m/s: as the verdict allows it, or as it was measured in the
        drive, which its operator may have driven."""
        if robot not in self._speeds:
            recording = self._recording
            body, offset_m = recording.robots[robot].body, recording.fleet.robot(robot).hand_offset_m
            driven = (body.t >= 0.0) & (body.t <= recording.end_s)
            measured = np.hypot(body["speed"], offset_m * body["yaw_rate"])[driven]
            allowed_mps = SPEED_SHARE * recording.fleet.control.max_speed_mps + SPEED_MORE_MPS
            self._speeds[robot] = max(allowed_mps, float(measured.max(initial=0.0)))
        return self._speeds[robot]

    def _boundaries(self, gap: PoseGap) -> Iterator[Stake]:
        """Obstacles and the geofence, as far as it kept from them when it was seen: else that is judged."""
        fleet, reach = self._recording.fleet, self._reach(gap)
        state = self._recording.robots[gap.robot].status.at(gap.start_s)
        if state and state[0] == State.RELEASED.value:
            return  # it is driven by others, who may want it there
        bounds = [(each.name, each, clearance_kept_m(fleet, self._a.safe_m)) for each in obstacles_of(fleet)]
        fence = fence_of(fleet)
        if fence is not None and fleet.avoidance.enabled:
            bounds.append((FENCE, fence, -furthest_outside_m(fleet)))
        ends = [seen for seen in (reach.before, reach.after) if seen is not None]
        places = np.array([(seen.x, seen.y) for seen in ends])
        for name, boundary, safe_m in bounds:
            away_m = distances(boundary, places)
            if len(ends) == 2 and (away_m >= safe_m).all():
                yield Stake(name, reach.clearance(*away_m.tolist()), safe_m)

    def _others(self, gap: PoseGap) -> Iterator[Stake]:
        recording, a = self._recording, self._a
        count = 2 + int(gap.lasts_s / STEP_S)
        times = np.linspace(gap.start_s, gap.end_s, count)
        own = self._reach(gap).discs(times)
        hands = hands_at(recording, times, a.gaps)
        for index, robot in enumerate(a.ids):
            if robot == gap.robot:
                continue
            for discs, rows in self._where(robot, hands[:, index], times):
                mine = [Disc(*(each[rows] for each in disc)) for disc in own]
                closing = self._speed(gap.robot) + self._speed(robot)
                least_m = least_apart(mine, discs, gap.lasts_s / (count - 1), closing)
                yield Stake(f"robot {robot}", least_m, a.safe_m)

    def _where(self, robot: int, hands: Floats, times: Floats) -> Iterator[tuple[list[Disc], slice]]:
        """Where another one was, and at which of these times: measured, or within the bounds of its gaps."""
        is_known = np.isfinite(hands[:, 0])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_known, [False]]).astype(np.int8)))
        for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            yield known(*hands[first:after].T), slice(first, after)
        for other in self._a.gaps:
            if other.robot == robot:
                within = np.flatnonzero((times > other.since_s) & (times < other.until_s))
                if len(within):
                    rows = slice(int(within[0]), int(within[-1]) + 1)
                    yield self._reach(other).discs(times[rows]), rows
