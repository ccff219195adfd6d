"""Whether a machine was too slow for the processes of its robots: skipped ticks, a lower rate that they asked
for, times in which it stood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from deploy.analysis.presence import downs
from deploy.console.wording import robots
from deploy.recording.recording import Recording
from deploy.verdict.violations import windows

SKIPPED_SHARE: Final = 0.05
"""So large a share of a robot's ticks is skipped where its machine, or the law of others, is named."""
STOOD_SHARE: Final = 0.1
"""A machine that stood still for so large a share of a drive is named before what failed."""
STALL_S: Final = 0.5
"""A machine of whose robots none sent a pose for longer than this stood still."""

_BETWEEN: Final = "what is between them and the recording stood still, a router or the program that records"


class Stall(NamedTuple):
    """A time in which no robot of a machine sent a pose; `host` is its name in the fleet file, "" without."""

    host: str
    start_s: float
    end_s: float


def stalls(recording: Recording) -> list[Stall]:
    """The times in which machines stood still, of those that went on before the end, and had more than one
    robot: a plant that hangs is no machine."""
    if recording.mode == "simulate":
        return []
    found = []
    for host, ids in _machines(recording).items():
        if len(ids) < 2:
            continue
        times = np.unique(np.concatenate([recording.robots[robot].body.t for robot in ids]))
        times = times[: int(np.searchsorted(times, recording.end_s, side="right"))]
        paused = [down for robot in ids for down in downs(recording, robot, "plant")]
        for k in np.flatnonzero(np.diff(times) > STALL_S).tolist():
            stall = Stall(host, float(times[k]), float(times[k + 1]))
            on_purpose = any(
                down.start_s < stall.end_s and down.end_s > stall.start_s - STALL_S for down in paused
            )
            if stall.end_s > 0.0 and not on_purpose:
                found.append(stall)
    return found


def warnings(recording: Recording) -> list[str]:
    """Sentences that name a machine as the cause: nothing of it is the fleet's doing."""
    out = [_stall_words(recording, stall) for stall in stalls(recording)]
    slow = late_robots(recording)  # a law of others that is slow is named as such
    period_ms = 1e3 / recording.fleet.fleet.rate_hz
    for host, ids in _machines(recording).items():
        late = [robot for robot in ids if robot in slow]
        if not late:
            continue
        skipped = sum(_skipped(recording, robot) for robot in late)
        ticks = skipped + sum(len(recording.robots[robot].status.tick_us) for robot in late)
        took = np.concatenate([recording.robots[robot].status.tick_us for robot in late])
        takes_ms = float(np.median(took)) / 1e3
        out.append(
            f"{_name(host)} was too slow for its processes: {robots(late)} skipped {skipped} of {ticks} "
            f"ticks, though one takes {takes_ms:.1f} ms of {period_ms:.3g} ms{_asked(recording, late)}. What "
            "came late of that is not the fleet's doing: other programs run there, or too many robots at "
            "this rate."
        )
    return out


def _stall_words(recording: Recording, stall: Stall) -> str:
    """Robots that went on while nothing came of them stood on no machine that stood."""
    when = f"from {stall.start_s:.2f} s to {stall.end_s:.2f} s"
    if any(_skipped(recording, robot) for robot in _machines(recording)[stall.host]):
        stood = f"{_name(stall.host)} stood still {when}: none of its robots sent a pose."
        return f"{stood} That is not the fleet's doing."
    whose = f"of host {stall.host} " if stall.host else ""
    return f"Nothing came of the robots {whose}{when}, though none of them skipped a tick: {_BETWEEN}."


def explains(recording: Recording) -> list[str]:
    """A sentence where machines were too slow for most robots, to be read before all that failed by it."""
    if recording.mode == "simulate":
        return []
    stood_s, late = sum(stall.end_s - stall.start_s for stall in stalls(recording)), late_robots(recording)
    if 2 * len(late) <= len(recording.ids) and stood_s <= STOOD_SHARE * recording.end_s:
        return []
    if not late and not any(_skipped(recording, robot) for robot in recording.ids):
        return [
            f"For {stood_s:.1f} s nothing came of any robot, though none skipped a tick: {_BETWEEN}. What "
            "follows may come of that alone."
        ]
    stood = f", and {stood_s:.1f} s none could do anything" if stood_s else ""
    were = "Machines were" if len(_machines(recording)) > 1 else "The machine was"
    return [
        f"{were} too slow: {len(late)} of {len(recording.ids)} robots skipped many ticks{stood}. What "
        "follows may come of that alone; `handfast check` says how many robots a machine carries at which "
        "rate."
    ]


def late_robots(recording: Recording) -> frozenset[int]:
    """The robots whose agents could not keep their rate, though nobody had made them late: their machines
    did."""
    if recording.mode == "simulate" or recording.fleet.control.law is not None:
        return frozenset()
    return frozenset(robot for robot in recording.ids if _was_late(recording, robot))


def on_late_machines(recording: Recording) -> frozenset[int]:
    """All robots of machines that some of their robots found too slow."""
    late = late_robots(recording)
    return frozenset(
        robot for ids in _machines(recording).values() if not late.isdisjoint(ids) for robot in ids
    )


def _machines(recording: Recording) -> dict[str, list[int]]:
    """The robots of each machine."""
    found: dict[str, list[int]] = {}
    for robot in recording.ids:
        found.setdefault(recording.fleet.robot(robot).host or "", []).append(robot)
    return found


def _name(host: str) -> str:
    return f"Host {host}" if host else "The machine that ran the fleet"


def _asked(recording: Recording, among: Sequence[int]) -> str:
    """For how long robots had the whole fleet drive at a lower rate, as part of a sentence."""
    totals = [recording.robots[robot].status.totals() for robot in among]
    asked_s = max(each.get("overload.asked_ms", 0) for each in totals) / 1e3
    return f", and had the fleet fall to a lower rate, for up to {asked_s:.1f} s" if asked_s else ""


def slowed_s(recording: Recording) -> float:
    """For how long robots drove at a lower rate, or more slowly at the lowest, for somebody's machine was
    overloaded, s: the longest of them."""
    totals = [data.status.totals() for data in recording.robots.values()]
    spent = [sum(ms for name, ms in each.items() if name.startswith("overload.level_")) for each in totals]
    return max(spent, default=0) / 1e3


def _skipped(recording: Recording, robot: int) -> int:
    return recording.robots[robot].status.totals().get("overruns", 0)


def _was_late(recording: Recording, robot: int) -> bool:
    """Whether a robot's agent skipped many ticks, or asked for a lower rate, and nobody had made it late or
    paused it."""
    ticks = len(recording.robots[robot].status.tick_us)
    asked = recording.robots[robot].status.totals().get("overload.asked_ms", 0)
    if not ticks or (_skipped(recording, robot) <= SKIPPED_SHARE * ticks and not asked):
        return False
    on_purpose: Sequence[object] = [
        *downs(recording, robot, "agent"),
        *(span for span in windows(recording) if span.rule.tick_jitter),
    ]
    return not on_purpose
