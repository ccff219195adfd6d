"""Agents that could not keep their rate, by their own account, beyond what fault rules made of it (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from handfast.deploy.analysis.patience import SHARE_MAX
from handfast.deploy.analysis.presence import downs
from handfast.deploy.console.wording import robots
from handfast.deploy.recording.recording import Recording, once
from handfast.deploy.recording.tables import StatusTable
from handfast.deploy.verdict.violations import is_constant, windows

SKIPPED_SHARE: Final = 0.05
"""Share of skipped ticks above which a robot's machine, or the law of a plugin, is named."""
WOKEN_S: Final = 3.0
"""Time after a rule made an agent late in which it still catches up, s."""


class Late(NamedTuple):
    """Ticks that an agent skipped, and the time for which it asked for a lower rate, ms."""

    skipped: int
    asked_ms: int


@once
def late_robots(recording: Recording) -> Mapping[int, Late]:
    """Return how late those agents were that skipped many ticks, or asked for a lower rate."""
    found: dict[int, Late] = {}
    if recording.mode == "simulate" or recording.fleet.control.law is not None:
        return found
    for robot in recording.ids:
        status, made = recording.robots[robot].status, _made_late(recording, robot)
        skipped = asked_ms = 0
        for row in range(len(status)):
            since_s = float(status.t[row - 1]) if row else -np.inf
            if not any(start_s <= status.t[row] and since_s < end_s + WOKEN_S for start_s, end_s in made):
                skipped += grown(status, "overruns", row - 1, row)
                asked_ms += grown(status, "overload.asked_ms", row - 1, row)
        if asked_ms or skipped > SKIPPED_SHARE * len(status.tick_us):
            found[robot] = Late(skipped, asked_ms)
    return found


def warnings(recording: Recording) -> list[str]:
    """Return a sentence for each machine that was too slow, and for each robot with a law that was."""
    late, period_ms = late_robots(recording), 1e3 / recording.fleet.fleet.rate_hz
    slow: dict[str, list[int]] = {}
    for robot in late:
        slow.setdefault(recording.fleet.robot(robot).host or "", []).append(robot)
    out = []
    for host, ids in slow.items():
        took_us = np.concatenate([recording.robots[robot].status.tick_us for robot in ids])
        skipped, asked_s = sum(late[robot].skipped for robot in ids), max(late[r].asked_ms for r in ids) / 1e3
        did = [f"skipped {skipped} of {len(took_us) + skipped} ticks"] if skipped else []
        did += [f"asked for a lower rate for up to {asked_s:.1f} s"] if asked_s else []
        though = f" though a tick takes {np.median(took_us) / 1e3:.1f} ms" if len(took_us) else ""
        out.append(
            f"{robots(ids).capitalize()} {' and '.join(did)}{though} of {period_ms:.3g} ms: "
            f"{f'host {host}' if host else 'the machine'} was too slow, or the agents were frozen."
        )
    return out + _late_laws(recording)


def slowed_s(recording: Recording) -> float:
    """Return the longest time for which a robot drove at a lower rate, s."""
    totals = [data.status.totals() for data in recording.robots.values()]
    spent = [sum(ms for name, ms in each.items() if name.startswith("overload.level_")) for each in totals]
    return max(spent, default=0) / 1e3


def grown(status: StatusTable, name: str, first: int, last: int) -> int:
    """Return by how much a counter grew between two statuses, -1 for the start; a process starts at 0."""
    before = status.counters[first].get(name, 0) if first >= 0 else 0
    after = status.counters[last].get(name, 0)
    return after - before if after >= before else after


def _made_late(recording: Recording, robot: int) -> list[tuple[float, float]]:
    """Times in which rules paused or killed an agent, or made it skip many ticks."""
    found = [(down.start_s, down.end_s) for down in downs(recording, robot, "agent")]
    for span in windows(recording):
        rule, late = span.rule, span.rule.tick_jitter
        if late is None or late.most_s < recording.fleet.period_ns / 1e9:
            continue
        if late.share > SKIPPED_SHARE and (rule.robots is None or robot in rule.robots):
            found.append((-np.inf if is_constant(rule) else span.start_s, span.end_s))
    return found


def _late_laws(recording: Recording) -> list[str]:
    """Return a sentence that names the robots which skipped ticks because the law of a plugin is slow."""
    law, period_us = recording.fleet.control.law, 1e6 / recording.fleet.fleet.rate_hz
    slow: dict[int, int] = {}
    took_us: list[float] = []
    for robot, data in recording.robots.items() if law is not None else ():
        skipped = data.status.totals().get("overruns", 0)
        long_us = data.status.tick_us[data.status.tick_us > SHARE_MAX * period_us]
        explains = len(long_us) > 0 and float(long_us.sum()) > 0.5 * skipped * period_us
        if skipped > SKIPPED_SHARE * len(data.status.tick_us) and explains:
            slow[robot] = skipped
            took_us += long_us.tolist()
    if not slow:
        return []
    return [
        f"{robots(slow).capitalize()} skipped {sum(slow.values())} ticks: there one takes "
        f"{np.median(took_us) / 1e3:.3g} ms, of {period_us / 1e3:.3g} ms; the law {law} may be too slow."
    ]
