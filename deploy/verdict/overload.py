"""Whether a machine was too slow for the processes of its robots, or some of them stood still: skipped ticks,
a lower rate that they asked for, times in which nothing came."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deploy.analysis.presence import downs
from deploy.console.wording import robots
from deploy.recording.recording import Recording
from deploy.verdict.standstills import Cause, Stall, Stand, machines, stalls, stood_alone
from deploy.verdict.violations import windows

SKIPPED_SHARE: Final = 0.05
"""So large a share of a robot's ticks is skipped where its machine, or the law of others, is named."""
STOOD_SHARE: Final = 0.1
"""What stood still for so large a share of a drive is named before what failed."""


def warnings(recording: Recording) -> list[str]:
    """Sentences that name what was too slow, or stood still: a machine, or some of its processes."""
    out = [_stall_words(stall) for stall in stalls(recording)]
    slow = late_robots(recording)  # a law of others that is slow is named as such
    out += _stand_words([stand for stand in stood_alone(recording) if stand.robot not in slow])
    period_ms = 1e3 / recording.fleet.fleet.rate_hz
    for host, ids in machines(recording).items():
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


def _stall_words(stall: Stall) -> str:
    when = f"from {stall.start_s:.2f} s to {stall.end_s:.2f} s"
    if stall.cause is Cause.MACHINE:
        stood = f"{_name(stall.host)} stood still {when}: none of its robots sent a pose."
        return f"{stood} That is not the fleet's doing."
    whose = f"of host {stall.host} " if stall.host else ""
    return f"No pose came of the robots {whose}{when}: {stall.cause.value}."


def _stand_words(stands: Sequence[Stand]) -> list[str]:
    """A sentence for all agents that stood still at the same time."""
    out = []
    left = sorted(stands, key=lambda stand: stand.start_s)
    while left:
        first = left[0]
        same = [stand for stand in left if stand.start_s < first.end_s]
        left = [stand for stand in left if stand.start_s >= first.end_s]
        who = robots(sorted({stand.robot for stand in same}))
        many = who.startswith("robots")
        agents, its, were = ("agents", "their", "they were") if many else ("agent", "its", "it was")
        lasts_s = max(stand.lasts_s for stand in same)
        out.append(
            f"The {agents} of {who} stood still for {lasts_s:.1f} s from {first.start_s:.1f} s on, while "
            f"{its} machine ran: {were} frozen, or starved."
        )
    return out


def explains(recording: Recording) -> list[str]:
    """A sentence where most robots failed for what was none of their doing, to be read before all that failed
    by it: machines that were too slow, or what stood still for long."""
    if recording.mode == "simulate":
        return []
    stood_s: dict[Cause, float] = {}
    for stall in stalls(recording):
        stood_s[stall.cause] = stood_s.get(stall.cause, 0.0) + stall.lasts_s
    late = late_robots(recording)
    if 2 * len(late) > len(recording.ids):
        machine_s = stood_s.get(Cause.MACHINE, 0.0)
        stood = f", and {machine_s:.1f} s none could do anything" if machine_s else ""
        were = "Machines were" if len(machines(recording)) > 1 else "The machine was"
        return [
            f"{were} too slow: {len(late)} of {len(recording.ids)} robots skipped many ticks{stood}. What "
            "follows may come of that alone; `handfast check` says how many robots a machine carries at "
            "which rate."
        ]
    cause = max(stood_s, key=stood_s.__getitem__, default=Cause.MACHINE)
    if stood_s.get(cause, 0.0) <= STOOD_SHARE * recording.end_s:
        return []
    return [
        f"For {stood_s[cause]:.1f} s no pose came of any robot: {cause.value}. What follows may come of that "
        "alone."
    ]


def late_robots(recording: Recording) -> frozenset[int]:
    """The robots whose agents could not keep their rate, though nobody had made them late: their machines
    did. What an agent skipped while it alone stood still is not the machine's."""
    if recording.mode == "simulate" or recording.fleet.control.law is not None:
        return frozenset()
    alone: dict[int, list[Stand]] = {}
    for stand in stood_alone(recording):
        alone.setdefault(stand.robot, []).append(stand)
    return frozenset(robot for robot in recording.ids if _was_late(recording, robot, alone.get(robot, ())))


def on_late_machines(recording: Recording) -> frozenset[int]:
    """All robots of machines that some of their robots found too slow."""
    late = late_robots(recording)
    return frozenset(
        robot for ids in machines(recording).values() if not late.isdisjoint(ids) for robot in ids
    )


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


def _was_late(recording: Recording, robot: int, alone: Sequence[Stand]) -> bool:
    """Whether a robot's agent skipped many ticks, or asked for a lower rate, for more than that it stood
    `alone`, and nobody had made it late or paused it."""
    ticks = len(recording.robots[robot].status.tick_us)
    skipped = _skipped(recording, robot) - sum(stand.skipped for stand in alone)
    asked_ms = recording.robots[robot].status.totals().get("overload.asked_ms", 0)
    asked_ms -= sum(stand.asked_ms for stand in alone)
    if not ticks or (skipped <= SKIPPED_SHARE * ticks and asked_ms <= 0):
        return False
    on_purpose: Sequence[object] = [
        *downs(recording, robot, "agent"),
        *(span for span in windows(recording) if span.rule.tick_jitter),
    ]
    return not on_purpose
