"""When processes ran, robots could follow, poses were recorded, and bodies were on the field (PURE).

The sources are the events of a run (kills, pauses, orders), what agents said, and the times of the poses.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from math import inf
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.recording import Recording, once
from handfast.deploy.recording.tables import StatusTable

Flags = NDArray[np.bool_]

_AWAY: Final = frozenset({State.RELEASED.value, State.FAULT.value})


class Down(NamedTuple):
    """A process did not run from `start_s` to `end_s` (fleet time; inf: to the end). `what` was done to it
    first: ``kill`` or ``stop``."""

    start_s: float
    end_s: float
    what: str


def downs(recording: Recording, robot: int, role: str) -> list[Down]:
    """The times in which a process was killed or paused on purpose."""
    found: list[Down] = []
    is_up, is_paused = True, False
    for event in sorted(recording.events, key=lambda event: (event.time_ns, event.sequence)):
        if event.robot != robot or event.role != role:
            continue
        was_running = is_up and not is_paused
        if event.what in ("kill", "start"):
            is_up, is_paused = event.what == "start", False
        else:
            is_paused = event.what == "stop"
        runs = is_up and not is_paused
        t = recording.fleet_time_s(event.time_ns)
        if was_running and not runs:
            found.append(Down(t, inf, event.what))
        elif runs and not was_running and found:
            found[-1] = found[-1]._replace(end_s=t)
    return found


class Uncommanded(NamedTuple):
    """(k, n) each: where a vehicle went on by itself, as nothing commanded it; and where nobody steered a
    robot at all: that, or its agent was dead, so that it could do nothing for its distances."""

    rolling: Flags
    helpless: Flags


def uncommanded(recording: Recording, grid: Floats) -> Uncommanded:
    """Of whom nobody can say that they should have kept away, by what was done to them on purpose."""
    rolling = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    helpless = rolling.copy()
    for index, robot in enumerate(recording.ids):
        if recording.fleet.robot(robot).kind.rolls_on_s:
            for start_s, end_s in untold(recording, robot):
                rolling[:, index] |= (grid > start_s) & (grid < end_s)
        for down in downs(recording, robot, "agent"):
            helpless[:, index] |= (grid > down.start_s) & (grid <= down.end_s)
    return Uncommanded(rolling, helpless | rolling)


def untold(recording: Recording, robot: int) -> list[tuple[float, float]]:
    """The times (start s, end s) in which a robot's plant, killed or paused on purpose, told of no pose.

    A new one needs a while until it knows one.
    """
    plant = recording.robots[robot].plant
    told_s = plant.t[plant["healthy"] > 0.0]
    lost = downs(recording, robot, "plant")
    after = np.searchsorted(told_s, [down.end_s for down in lost])
    ends = np.append(told_s, inf)[after]
    return [(down.start_s, float(end_s)) for down, end_s in zip(lost, ends, strict=True)]


def said(status: StatusTable, grid: Floats, states: Collection[str]) -> Flags:
    """(k,): where the last status until then tells of one of `states`; False before the first."""
    if not len(status):
        return np.zeros(len(grid), dtype=np.bool_)
    is_one = np.array([False, *(state in states for state in status.states)])
    is_now: Flags = is_one[np.searchsorted(status.t, grid, side="right")]
    return is_now


def away(recording: Recording, grid: Floats) -> Flags:
    """(k, n): where a robot could not follow: released to its operator, in fault, ordered to stand, or its
    agent or plant killed or paused. What is not known of it is not held against it."""
    out = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    for index, (robot, data) in enumerate(recording.robots.items()):
        out[:, index] = said(data.status, grid, _AWAY)
        times = [
            (down.start_s, down.end_s)
            for role in ("agent", "plant")
            for down in downs(recording, robot, role)
        ]
        for start_s, end_s in [*times, *recording.halts(robot)]:
            out[:, index] |= (grid > start_s) & (grid <= end_s)
    return out


GAP_S: Final = 0.5
"""Poses that are missing for longer than this are a gap: until then a robot is taken to go straight on."""
PERIODS: Final = 2.5
"""Or for longer than so many periods of a slow body: a late tick is no missing pose."""


class PoseGap(NamedTuple):
    """A time within the drive without a pose of one robot, which sent some.

    Attributes:
        start_s: with `end_s` its bounds, fleet time within the drive.
        before: row of the last pose before it in `RobotData.body`; -1 without one.
        after: row of the first pose after it; as many as there are without one.
        since_s: with `until_s` the times of these poses, which may be before or after the drive; infinite
            without them.
        lasts: it goes on to the end of the drive.
        rule: names the rule that stopped the robot's plant, if one did.
        is_lost: it comes of a damaged file.
        is_hidden: where the robot was meanwhile is not known. It is known in virtual time, which records
            vehicles without their bridges as well, and of a simulated body that a rule stopped, for a time
            that is known: that one brakes and stands.
    """

    robot: int
    start_s: float
    end_s: float
    before: int
    after: int
    since_s: float
    until_s: float
    lasts: bool
    rule: str
    is_lost: bool
    is_hidden: bool

    @property
    def lasts_s(self) -> float:
        """How long it is, s."""
        return self.end_s - self.start_s


def gap_s(recording: Recording) -> float:
    """Poses that are missing for longer than this are a gap, s."""
    return max(GAP_S, PERIODS * recording.fleet.period_ns / 1e9)


@once
def pose_gaps(recording: Recording) -> Sequence[PoseGap]:
    """All gaps of the drive, robot by robot, in order; none of a robot that sent no pose at all."""
    out = []
    end_s = recording.end_s
    for robot, data in recording.robots.items():
        body_s = data.body.t
        if not len(body_s):
            continue
        t = body_s[~_unseen(recording, robot, body_s)]
        # A simulated vehicle is a vehicle: it rolls on.
        is_simulated = not recording.fleet.robot(robot).kind.vehicle
        times = np.concatenate([[0.0], np.clip(t, 0.0, end_s), [end_s]])
        for row in np.flatnonzero(np.diff(times) > gap_s(recording)).tolist():
            start_s, stop_s = float(times[row]), float(times[row + 1])
            since_s = float(t[row - 1]) if row else -inf
            until_s = float(t[row]) if row < len(t) else inf
            rule = _stopped_by(recording, robot, start_s, stop_s)
            before, after = (int(each) for each in np.searchsorted(body_s, (since_s, until_s)))
            poses, lasts = (before if row else -1, after, since_s, until_s), stop_s >= end_s
            meanwhile_s = np.clip(body_s[before : after + 1], start_s, stop_s)
            is_seen = np.diff(meanwhile_s, prepend=start_s, append=stop_s).max() <= gap_s(recording)
            stands = lasts or any(
                since_s < down.end_s < inf and down.start_s < until_s
                for down in downs(recording, robot, "plant")
            )
            is_hidden = not is_seen and not (rule and is_simulated and stands)
            damaged = is_lost(recording, start_s, stop_s)
            out.append(PoseGap(robot, start_s, stop_s, *poses, lasts, rule, damaged, is_hidden))
    return out


def _unseen(recording: Recording, robot: int, times: Floats) -> Flags:
    """(k,): whether a pose of a vehicle came of no plant, but of virtual time itself."""
    out = np.zeros(len(times), dtype=np.bool_)
    if recording.mode == "simulate" and recording.fleet.robot(robot).kind.rolls_on_s:
        for start_s, end_s in untold(recording, robot):
            out |= (times >= start_s) & (times < end_s)
    return out


def is_lost(recording: Recording, start_s: float, end_s: float) -> bool:
    """Whether what is missing in a time is missing of a file that is damaged."""
    near_s = gap_s(recording)
    return any(each.start_s - near_s <= start_s and end_s <= each.end_s + near_s for each in recording.damage)


def _stopped_by(recording: Recording, robot: int, start_s: float, end_s: float) -> str:
    """Name of the rule that killed or paused a robot's plant within a time, or just before; "" if none."""
    return next(
        (
            event.rule
            for event in recording.events
            if event.robot == robot
            and event.role == "plant"
            and event.what in ("kill", "stop")
            and start_s - GAP_S <= recording.fleet_time_s(event.time_ns) <= end_s
        ),
        "",
    )


def unknown(gaps: Iterable[PoseGap], ids: Sequence[int], times: Floats) -> Flags:
    """(k, n): whether a robot's place is not known at these times, for a gap hides it."""
    out = np.zeros((len(times), len(ids)), dtype=np.bool_)
    for gap in gaps:
        if gap.is_hidden:
            out[:, ids.index(gap.robot)] |= (times > gap.since_s) & (times < gap.until_s)
    return out


def kept_through(flags: Flags, hidden: Flags) -> Flags:
    """`flags` (k, m), with those rows of a column that are `hidden` as they were before, or are after: what
    was so at either end of a gap may have been so all the while."""
    if not hidden.any():
        return flags
    rows = np.arange(len(flags))[:, None]
    before = np.maximum.accumulate(np.where(hidden, -1, rows), axis=0)
    after = np.minimum.accumulate(np.where(hidden, len(flags), rows)[::-1], axis=0)[::-1]
    columns = np.arange(flags.shape[1])
    was = (before >= 0) & flags[np.maximum(before, 0), columns]
    comes = (after < len(flags)) & flags[np.minimum(after, len(flags) - 1), columns]
    found: Flags = np.where(hidden, was | comes, flags)
    return found


def carried_off(recording: Recording, grid: Floats) -> Flags:
    """(k, n): where a robot's body had been carried off, and its agent had not said a word since."""
    out = np.zeros((len(grid), len(recording.ids)), dtype=np.bool_)
    for robot, time_ns in {row for mission in recording.held_missions for row in mission.removed}:
        if robot not in recording.robots:
            continue
        since_s, said = recording.fleet_time_s(time_ns), recording.robots[robot].status.t
        after = int(np.searchsorted(said, since_s, side="right"))
        until_s = float(said[after]) if after < len(said) else inf
        out[:, recording.ids.index(robot)] |= (grid >= since_s) & (grid < until_s)
    return out
