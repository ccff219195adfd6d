"""Times in which no pose of a robot came, and in which its place is not known (PURE)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.presence import Flags, downs, untold
from handfast.deploy.recording.recording import Recording, once

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
