"""Whether a machine was too slow for the processes of its robots, or some of them stood still: skipped ticks,
a lower rate that they asked for, times in which nothing came."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from handfast.deploy.console.wording import robots
from handfast.deploy.recording.recording import Recording, once
from handfast.deploy.verdict.lateness import Late, Made, made_late, unexplained
from handfast.deploy.verdict.standstills import Cause, Stall, Stand, machines, stalls, stood_alone

SKIPPED_SHARE: Final = 0.05
"""So large a share of a robot's ticks is skipped where its machine, or the law of others, is named."""
STALLS_MAX: Final = 3
"""So many times in which one thing stood still are told one by one."""
STOOD_SHARE: Final = 0.1
"""What stood still for so large a share of a drive is named before what failed."""


def warnings(recording: Recording) -> list[str]:
    """Sentences that name what was too slow, or stood still: a machine, or some of its processes."""
    out = _all_stall_words(stalls(recording))
    slow = _too_late(recording)  # a law of others that is slow is named as such
    out += _stand_words([stand for stand in stood_alone(recording) if stand.robot not in slow])
    period_ms = 1e3 / recording.fleet.fleet.rate_hz
    for host, ids in machines(recording).items():
        late = [robot for robot in ids if robot in slow]
        if not late:
            continue
        took = np.concatenate([recording.robots[robot].status.tick_us for robot in late])
        though = ""
        if len(took):  # a status may count no tick: one that is forged, or cut out of a damaged file
            though = f", though a tick takes {float(np.median(took)) / 1e3:.1f} ms of {period_ms:.3g} ms"
        out.append(
            f"{_name(host)} was too slow for its processes: {robots(late)} {_did(recording, slow, late)}"
            f"{though}. What came late of that is not the fleet's doing: other programs run there, or too "
            "many robots at this rate."
        )
    return out


def _did(recording: Recording, slow: Mapping[int, Late], late: Sequence[int]) -> str:
    """How many ticks these robots skipped, and for how long they had the fleet slow down; no subject."""
    did = []
    if skipped := sum(slow[robot].skipped for robot in late):
        ticks = sum(len(recording.robots[robot].status.tick_us) for robot in late) + skipped
        did.append(f"skipped {skipped} of {ticks} ticks")
    if asked_ms := max(slow[robot].asked_ms for robot in late):
        did.append(f"had the fleet fall to a lower rate, for up to {asked_ms / 1e3:.1f} s")
    return " and ".join(did)


def _all_stall_words(found: Sequence[Stall]) -> list[str]:
    """A sentence for each time in which something stood still; one for many of one kind."""
    kinds: dict[tuple[str, Cause], list[Stall]] = {}
    for stall in found:
        kinds.setdefault((stall.host, stall.cause), []).append(stall)
    out = []
    for alike in kinds.values():
        if len(alike) <= STALLS_MAX:
            out += [_stall_words(each, f"from {each.start_s:.2f} s to {each.end_s:.2f} s") for each in alike]
            continue
        whole_s, most_s = sum(each.lasts_s for each in alike), max(each.lasts_s for each in alike)
        times = f"{len(alike)} times from {alike[0].start_s:.2f} s to {alike[-1].end_s:.2f} s"
        out.append(_stall_words(alike[0], f"{times}, for up to {most_s:.1f} s and {whole_s:.1f} s together"))
    return out


def _stall_words(stall: Stall, when: str) -> str:
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
    slow = {
        robot: late
        for robot, late in _too_late(recording).items()
        if _skips_many(recording, robot, late) or late.asked_ms > 1e3 * STOOD_SHARE * recording.end_s
    }
    if 2 * len(slow) > len(recording.ids):
        machine_s = stood_s.get(Cause.MACHINE, 0.0)
        stood = f", and {machine_s:.1f} s none could do anything" if machine_s else ""
        were = "Machines were" if len(machines(recording)) > 1 else "The machine was"
        return [
            f"{were} too slow: {len(slow)} of {len(recording.ids)} robots "
            f"{_did(recording, slow, sorted(slow))}{stood}. What follows may come of that alone; `handfast "
            "check` says how many robots a machine carries at which rate."
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
    return frozenset(_too_late(recording))


@once
def _too_late(recording: Recording) -> Mapping[int, Late]:
    """Of `late_robots`, by how much more than what was done to them, or that they stood alone, explains."""
    if recording.mode == "simulate" or recording.fleet.control.law is not None:
        return {}
    made = {robot: made_late(recording, robot) for robot in recording.ids}
    for stand in stood_alone(recording):
        made[stand.robot].append(Made(stand.start_s, stand.end_s))
    found = {robot: unexplained(recording, robot, each) for robot, each in made.items()}
    return {
        robot: late
        for robot, late in found.items()
        if late.asked_ms > 0 or _skips_many(recording, robot, late)
    }


def _skips_many(recording: Recording, robot: int, late: Late) -> bool:
    return late.skipped > SKIPPED_SHARE * len(recording.robots[robot].status.tick_us)


def on_late_machines(recording: Recording) -> frozenset[int]:
    """All robots of machines that some of their robots found too slow."""
    late = late_robots(recording)
    return frozenset(
        robot for ids in machines(recording).values() if not late.isdisjoint(ids) for robot in ids
    )


def _name(host: str) -> str:
    return f"Host {host}" if host else "The machine that ran the fleet"


def slowed_s(recording: Recording) -> float:
    """For how long robots drove at a lower rate, or more slowly at the lowest, for somebody's machine was
    overloaded, s: the longest of them."""
    totals = [data.status.totals() for data in recording.robots.values()]
    spent = [sum(ms for name, ms in each.items() if name.startswith("overload.level_")) for each in totals]
    return max(spent, default=0) / 1e3
