"""What a run's data lack: poses, agents that fell silent, parts of a damaged file, an early end (PURE).

A robot moves no faster than its greatest speed. So between two poses it is within a disc around each, and
how near it can have come to anything is bounded (`_Reach`). A gap in which nothing can have happened is a
warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import hypot, inf
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.boundaries import fence_of, obstacles_of
from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.analysis import Analysis, hands_at
from handfast.deploy.analysis.presence import GAP_S, PoseGap, downs, is_lost, pose_gaps
from handfast.deploy.analysis.shapes import distances
from handfast.deploy.console.wording import NAMES_SHOWN, robots
from handfast.deploy.recording.recording import Damage, Recording
from handfast.deploy.verdict.lateness import late_robots
from handfast.deploy.verdict.oracles_distance import clearance_kept_m, furthest_outside_m
from handfast.deploy.verdict.oracles_drive import SPEED_MORE_MPS, SPEED_SHARE

SHARE_MAX: Final = 0.2
"""Maximum share of a drive without poses of a robot: what is judged of it is judged by its poses."""
SILENCE_S: Final = 2.0
"""Time after its last status at which an agent, which sends five a second, counts as lost, s."""
STEP_S: Final = 0.02
"""Time step at which robots are compared within a gap, s."""
FEW: Final = 3
"""Maximum number of gaps of one robot that are said one by one."""
_FENCE: Final = "the geofence"


class Harm(NamedTuple):
    """The nearest that a robot can have come to `what`, and how near it may: lower bounds, m."""

    what: str
    least_m: float
    safe_m: float

    @property
    def words(self) -> str:
        if self.least_m >= self.safe_m:
            return ""
        if self.least_m < 0.0:
            side = "outside" if self.what == _FENCE else "inside"
            return f"; it may have been {-self.least_m:.2f} m {side} {self.what}"
        return f"; it may have come within {self.least_m:.2f} m of {self.what} ({self.safe_m:.2f} m is safe)"


@dataclass(frozen=True)
class Gap:
    """A time without a pose of a robot.

    Attributes:
        why: known cause, "" without one.
        is_shared: the cause is one of many robots.
        is_lost: a damaged file is the cause.
        is_excused: the cause is none of the robot's doing.
        fails: the verdict fails.
        harm: what may have happened, "" if nothing can have.
    """

    robot: int
    start_s: float
    end_s: float
    lasts: bool
    why: str
    is_shared: bool
    is_lost: bool
    is_excused: bool
    fails: bool
    harm: str

    @property
    def lasts_s(self) -> float:
        return self.end_s - self.start_s


class Missing:
    """What the data of a run lack.

    Attributes:
        members: robots that had a place in the formation at the end; what is missing of others is a warning.
    """

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a
        self.members = frozenset(robot for robot in a.ids if self._is_placed(robot, recording.end_s))
        self.gaps: Sequence[Gap] = [self._gap(each) for each in pose_gaps(recording)]

    @property
    def reasons(self) -> list[str]:
        """Sentences that fail the verdict."""
        recording = self._recording
        if recording.epoch_ns is None:
            return ["No mission was recorded: the fleet was never told to start, so it did not drive."]
        out = []
        if not is_lost(recording, 0.0, recording.end_s):  # else that is why
            if silent := [robot for robot, data in recording.robots.items() if not len(data.body)]:
                out.append(f"The data are incomplete: no pose of {robots(silent)} was recorded.")
            if mute := [robot for robot, data in recording.robots.items() if not len(data.status)]:
                out.append(f"The data are incomplete: no status of {robots(mute)} was recorded.")
        worst: dict[int, Gap] = {}
        for gap in self.gaps:
            if gap.fails and (gap.lasts, gap.lasts_s) > _weight(worst.get(gap.robot)):
                worst[gap.robot] = gap
        out += _sentences(list(worst.values()))
        out += [text for robot, text in self._shares() if robot not in worst]
        return [*out, *self._fell_silent(self.members), *self._ended_early()]

    @property
    def warnings(self) -> list[str]:
        """Sentences that fail nothing."""
        end_s = self._recording.end_s
        out = _sentences([gap for gap in self.gaps if not gap.fails and not gap.is_lost])
        out += self._fell_silent(frozenset(self._recording.ids) - self.members)
        for robot in sorted(self.members):
            for down in downs(self._recording, robot, "agent"):
                if down.what == "kill" and down.end_s == inf and down.start_s < end_s:
                    out.append(f"The agent of robot {robot} was killed at {down.start_s:.1f} s for good.")
        return out

    def _gap(self, gap: PoseGap) -> Gap:
        recording, robot = self._recording, gap.robot
        placed = self._is_placed(robot, gap.end_s)
        why, is_shared = self._cause(gap, placed)
        stood = is_shared and not gap.is_lost and self._moved_m(gap) <= self._a.safe_m
        asks = gap.is_hidden and not gap.lasts and not stood
        harm = _Reach(recording, self._a).harm(gap) if asks else ""
        is_excused = bool(gap.rule) or stood
        is_dead = bool(gap.rule) and gap.lasts and self._is_killed(robot)
        fails = placed and not is_dead and (gap.lasts or (bool(harm) and not is_excused))
        known = why, is_shared, gap.is_lost, is_excused, fails, harm
        return Gap(robot, gap.start_s, gap.end_s, gap.lasts, *known)

    def _is_killed(self, robot: int) -> bool:
        """Whether agent and plant were killed for good."""
        last = [downs(self._recording, robot, role)[-1:] for role in ("agent", "plant")]
        return all(each and each[0].what == "kill" and each[0].end_s == inf for each in last)

    def _cause(self, gap: PoseGap, placed: bool) -> tuple[str, bool]:
        """Why there is a gap, and whether that is a cause of many robots."""
        recording = self._recording
        if gap.is_lost:
            return f"{recording.damage[0].file} is damaged", True
        if gap.rule:
            return f"rule '{gap.rule}' stopped its plant", False
        if not placed:
            return "it had no place in the formation", False
        if gap.robot in late_robots(recording):
            return "the machine was too slow", True
        host = recording.fleet.robot(gap.robot).host
        others = [r for r in recording.ids if r != gap.robot and recording.fleet.robot(r).host == host]
        if others and recording.mode != "simulate" and all(self._is_in_gap_with(gap, r) for r in others):
            return "nothing came from the machine", True
        return "", False

    def _is_in_gap_with(self, gap: PoseGap, other: int) -> bool:
        """Whether no pose of another robot came for most of a gap either, and its agent was not in fault."""
        status = self._recording.robots[other].status
        rows = np.flatnonzero((status.t > gap.start_s) & (status.t < gap.end_s)).tolist()
        return not any(status.states[row] == State.FAULT.value for row in rows) and any(
            each.robot == other and 2.0 * _overlap_s(gap, each.start_s, each.end_s) > gap.lasts_s
            for each in pose_gaps(self._recording)
        )

    def _moved_m(self, gap: PoseGap) -> float:
        body = self._recording.robots[gap.robot].body
        if gap.before < 0 or gap.after >= len(body):
            return inf
        return hypot(*(float(body[axis][gap.after] - body[axis][gap.before]) for axis in "xy"))

    def _shares(self) -> Iterator[tuple[int, str]]:
        """Robots whose gaps are too large a share of the drive, each with the sentence about that."""
        missed_s: dict[int, float] = {}
        for gap in self.gaps:
            if not gap.is_excused and not gap.is_lost and self._is_placed(gap.robot, gap.end_s):
                missed_s[gap.robot] = missed_s.get(gap.robot, 0.0) + gap.lasts_s
        for robot, lost_s in missed_s.items():
            share = lost_s / self._recording.end_s
            if share > SHARE_MAX:
                yield (
                    robot,
                    (
                        f"The data are incomplete: robot {robot} sent no pose in {100 * share:.0f} % of the "
                        f"drive, where {100 * SHARE_MAX:.0f} % is allowed."
                    ),
                )

    def _is_placed(self, robot: int, t: float) -> bool:
        a = self._a
        row = min(int(np.searchsorted(a.grid, t)), len(a.grid) - 1)
        return bool(np.isfinite(a.desired[row, a.ids.index(robot), 0]))

    def _fell_silent(self, among: frozenset[int]) -> list[str]:
        """A sentence if agents sent no status any more to the end, though nobody had stopped them."""
        recording, end_s, lost = self._recording, self._recording.end_s, {}
        for robot in sorted(among):
            times = recording.robots[robot].status.t
            last_s = float(times[-1]) if len(times) else inf
            stopped = any(
                down.start_s <= last_s + SILENCE_S < down.end_s for down in downs(recording, robot, "agent")
            )
            silent = end_s - max(last_s, 0.0) > SILENCE_S  # before the drive robots may speak seldom
            if silent and not stopped and not is_lost(recording, last_s, end_s):
                lost[robot] = last_s
        if not lost:
            return []
        law = recording.fleet.control.law
        why = " (the machine was too slow)" if late_robots(recording).keys() & lost.keys() else ""
        why += f"; the law {law} may hang" if law is not None else ""
        agents = "agent" if len(lost) == 1 else "agents"
        return [f"The {agents} of {robots(lost)} sent no status after {min(lost.values()):.1f} s{why}."]

    def _ended_early(self) -> list[str]:
        """Sentences if the run ended early, and nobody had planned that."""
        recording = self._recording
        end_s, planned_s, stopped_s = recording.end_s, recording.planned_s, recording.stopped_s
        cut = cut_short(recording)
        if cut is not None and cut.start_s == -inf:
            return [f"The recording is damaged: {cut.file} has lost parts throughout."]
        if cut is not None:
            start_s = max(cut.start_s, 0.0)
            return [f"The recording is damaged: {cut.file} ends after {start_s:.2f} s of {planned_s:.1f} s."]
        orders = [order.at for order in recording.fleet.orders if order.kind == "stop"]
        if end_s >= planned_s - GAP_S or any(abs(at - (stopped_s or -inf)) < GAP_S for at in orders):
            return []
        why, heard_s = "", max([end_s, *(float(t[-1]) for t in _status_times(recording) if len(t))])
        if stopped_s is not None and stopped_s <= end_s + GAP_S:
            why = ": it was stopped"
        elif all(last and last[0] == State.FAULT.value for last in last_states(recording).values()):
            why = ": no robot could drive any more"
        elif recording.interrupted:
            why = ": it was interrupted"
        out = []
        if stopped_s is not None and stopped_s - heard_s > GAP_S:
            out.append(f"The data are incomplete: nothing came of any robot after {end_s:.1f} s.")
            end_s = stopped_s
        return [*out, f"The run ended after {end_s:.1f} s of the {planned_s:.1f} s that were planned{why}."]


class _Reach:
    """How near robots can have come to anything while nobody knew where they were."""

    def __init__(self, recording: Recording, a: Analysis) -> None:
        self._recording, self._a = recording, a

    def harm(self, gap: PoseGap) -> str:
        """Return what may have happened in a gap, to be put behind a sentence; "" if nothing can have."""
        seen, speed = self._seen(gap), self._speed(gap.robot)
        if len(seen) == 2:
            (from_s, *start), (until_s, *end) = seen
            moved_m = hypot(end[0] - start[0], end[1] - start[1])
            if moved_m > speed * (until_s - from_s):
                return f"; it moved {moved_m:.2f} m, further than it can"
        found = [*self._boundaries(gap, seen, speed), *self._robots(gap, speed)]
        return min(found, key=lambda each: each.least_m - each.safe_m).words if found else ""

    def _seen(self, gap: PoseGap) -> list[tuple[float, float, float]]:
        """Time (s) and hand point (m) of the poses before and after a gap, where there are any."""
        body, index = self._recording.robots[gap.robot].body, self._a.ids.index(gap.robot)
        rows = [row for row in (gap.before, gap.after) if 0 <= row < len(body)]
        hands = self._recording.hand_positions(body.t[rows])[:, index]
        return [(float(t), float(x), float(y)) for t, (x, y) in zip(body.t[rows], hands, strict=True)]

    def _speed(self, robot: int) -> float:
        """Greatest speed of a hand, m/s: as the verdict allows it, or as it was measured in the drive."""
        recording = self._recording
        body, offset_m = recording.robots[robot].body, recording.fleet.robot(robot).hand_offset_m
        driven = (body.t >= 0.0) & (body.t <= recording.end_s)
        measured = np.hypot(body["speed"], offset_m * body["yaw_rate"])[driven].max(initial=0.0)
        return max(SPEED_SHARE * recording.fleet.control.max_speed_mps + SPEED_MORE_MPS, float(measured))

    def _boundaries(
        self, gap: PoseGap, seen: Sequence[tuple[float, float, float]], speed: float
    ) -> Iterator[Harm]:
        """Obstacles and the geofence, unless the robot was seen too near to them: that is judged."""
        fleet = self._recording.fleet
        state = self._recording.robots[gap.robot].status.at(gap.start_s)
        if len(seen) < 2 or (state and state[0] == State.RELEASED.value):
            return
        keep_m = clearance_kept_m(fleet, self._a.safe_m)
        bounds = [(each.name, each, keep_m) for each in obstacles_of(fleet)]
        fence = fence_of(fleet)
        if fence is not None and fleet.avoidance.enabled:
            bounds.append((_FENCE, fence, -furthest_outside_m(fleet)))
        for name, boundary, safe_m in bounds:
            before_m, after_m = distances(boundary, np.array([point[1:] for point in seen])).tolist()
            least_m = 0.5 * (before_m + after_m - speed * (seen[1][0] - seen[0][0]))
            if min(before_m, after_m) >= safe_m:
                yield Harm(name, min(before_m, after_m, least_m), safe_m)

    def _robots(self, gap: PoseGap, speed: float) -> Iterator[Harm]:
        a, count = self._a, 2 + int(gap.lasts_s / STEP_S)
        times = np.linspace(gap.start_s, gap.end_s, count)
        own, hands = self._discs(gap, times), hands_at(self._recording, times, a.gaps)
        for index, robot in enumerate(a.ids):
            if robot == gap.robot:
                continue
            apart = _apart(own, [(*hands[:, index].T, np.zeros(count))])
            for other in a.gaps:
                if other.robot == robot:
                    within = np.isnan(apart) & (times > other.since_s) & (times < other.until_s)
                    apart = np.where(within, _apart(own, self._discs(other, times)), apart)
            if np.isfinite(apart).any():
                step_m = 0.5 * (speed + self._speed(robot)) * gap.lasts_s / (count - 1)
                yield Harm(f"robot {robot}", max(0.0, float(np.nanmin(apart)) - step_m), a.safe_m)

    def _discs(self, gap: PoseGap, times: Floats) -> list[tuple[Floats, Floats, Floats]]:
        """Discs (x, y, radius) that each contain the hand at these times."""
        speed = self._speed(gap.robot)
        return [
            (np.full(len(times), x), np.full(len(times), y), speed * np.abs(times - t))
            for t, x, y in self._seen(gap)
        ]


def _apart(one: Sequence[tuple[Floats, ...]], other: Sequence[tuple[Floats, ...]]) -> Floats:
    """Lower bound of the distance of two bodies, each of which is in all of its discs, (k,) m."""
    bounds = [np.hypot(ax - bx, ay - by) - ar - br for ax, ay, ar in one for bx, by, br in other]
    found: Floats = np.maximum(np.max(bounds, axis=0), 0.0)
    return found


def _overlap_s(gap: PoseGap, start_s: float, end_s: float) -> float:
    return min(gap.end_s, end_s) - max(gap.start_s, start_s)


def _weight(gap: Gap | None) -> tuple[bool, float]:
    return (False, -1.0) if gap is None else (gap.lasts, gap.lasts_s)


def _sentences(gaps: Sequence[Gap]) -> list[str]:
    """A sentence for each gap; one for those of many robots, of a shared cause, or of a robot with many."""
    is_many = len({gap.robot for gap in gaps if not gap.is_shared}) > NAMES_SHOWN
    groups: dict[tuple[str, int], list[Gap]] = {}
    for gap in gaps:
        groups.setdefault((gap.why, 0 if gap.is_shared or is_many else gap.robot), []).append(gap)
    out = []
    for (why, _), group in groups.items():
        single = len({gap.robot for gap in group}) == 1 and len(group) <= FEW
        for part in [[gap] for gap in group] if single else [group]:
            worst = max(part, key=lambda gap: (bool(gap.harm), gap.lasts_s))
            until = "the end" if worst.lasts else f"{max(gap.end_s for gap in part):.2f} s"
            times = f"from {min(gap.start_s for gap in part):.2f} s to {until}"
            most = f", for up to {max(gap.lasts_s for gap in part):.1f} s at a time" if len(part) > 1 else ""
            cause = f" ({why})" if why else ""
            who = robots(dict.fromkeys(gap.robot for gap in part)).capitalize()
            harmless = not (worst.fails or worst.is_excused or worst.lasts)
            harm = worst.harm or ", in which nothing can have happened" * harmless
            out.append(f"{who} sent no pose {times}{most}{cause}{harm}.")
    return out


def cut_short(recording: Recording) -> Damage | None:
    """Return the damage after which nothing of the drive is there any more."""
    until_s = recording.planned_s if recording.stopped_s is None else recording.stopped_s
    return next(
        (each for each in recording.damage if each.end_s == inf and each.start_s < until_s - GAP_S), None
    )


def last_states(recording: Recording) -> dict[int, tuple[str, str] | None]:
    """Return the state and reason of each robot when it was to drive no more."""
    until_s = recording.planned_s if recording.stopped_s is None else recording.stopped_s
    return {robot: data.status.at(until_s) for robot, data in recording.robots.items()}


def _status_times(recording: Recording) -> list[Floats]:
    return [data.status.t for data in recording.robots.values()]
