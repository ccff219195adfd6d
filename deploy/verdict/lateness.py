"""How many ticks agents skipped, for how long they asked for a lower rate, and what of that comes of faults
that were injected, or of standing still alone: the rest is their machine's doing (PURE)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import Final, NamedTuple

from handfast.deploy.analysis.presence import downs
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import StatusTable
from handfast.deploy.verdict.violations import is_constant, windows

WOKEN_S: Final = 3.0
"""What an agent skips or asks for so soon after it was made late comes of that."""


@dataclass(frozen=True, slots=True)
class Made:
    """A `share` of an agent's ticks were made late by up to `late_s`, from `start_s` to `end_s` (fleet time);
    infinite where it did not run."""

    start_s: float
    end_s: float
    late_s: float = inf
    share: float = 1.0

    def makes_stand(self, start_s: float, end_s: float) -> bool:
        """Whether an agent may have stood from `start_s` to `end_s` for it: ticks of its that came late twice
        running, at most."""
        return self.start_s < end_s and self.end_s > start_s and 2.0 * self.late_s >= end_s - start_s

    def skips(self, period_s: float) -> float:
        """How many ticks may be skipped for it: none where a tick comes late by less than a period."""
        if self.late_s == inf:
            return inf
        return self.share * (self.end_s - self.start_s) / period_s * (self.late_s // period_s)


class Late(NamedTuple):
    """An agent of its own, or its machine's, doing skipped `skipped` ticks, and asked for a lower rate for
    `asked_ms`."""

    skipped: int
    asked_ms: int


def made_late(recording: Recording, robot: int) -> list[Made]:
    """When rules paused or killed the agent of a robot, or made its ticks late."""
    found = [Made(down.start_s, down.end_s) for down in downs(recording, robot, "agent")]
    first_s = next(iter(recording.robots[robot].status.t.tolist()), inf)
    for span in windows(recording):
        rule = span.rule
        if rule.tick_jitter is not None and (rule.robots is None or robot in rule.robots):
            share = 1.0 if rule.tick_jitter_share is None else rule.tick_jitter_share
            start_s = min(first_s, span.start_s) if is_constant(rule) else span.start_s
            found.append(Made(start_s, span.end_s, rule.tick_jitter, share))
    return found


def unexplained(recording: Recording, robot: int, made: Iterable[Made]) -> Late:
    """By how much an agent was late beyond what `made` may have made of it.

    What a rule explains it does while it holds and for `WOKEN_S` afterwards, and it explains no more skipped
    ticks than it can cause; of a lower rate that was asked for then, all until it is asked for no more.
    """
    status, period_s = recording.robots[robot].status, recording.fleet.period_ns / 1e9
    causes = [(each, each.skips(period_s)) for each in made]
    left = {each: skips for each, skips in causes if skips > 0.0}
    skipped = asked_ms = 0
    is_explained = False
    for row in range(len(status)):
        start_s = float(status.t[row - 1]) if row else -inf
        there = [each for each in left if each.start_s <= status.t[row] and each.end_s + WOKEN_S > start_s]
        more = grown(status, "overruns", row - 1, row)
        for each in there:
            of_it = min(more, int(left[each])) if left[each] < inf else more
            more -= of_it
            left[each] -= of_it if left[each] < inf else 0.0
        skipped += more
        asked = grown(status, "overload.asked_ms", row - 1, row)
        is_explained = bool(there) or (is_explained and asked > 0)
        asked_ms += 0 if is_explained else asked
    return Late(skipped, asked_ms)


def stood_s(recording: Recording, status: StatusTable, first: int, last: int) -> float:
    """For how long an agent's loop stood between two of its statuses, s: as it says itself, else, before it
    did, by the ticks that it skipped."""
    if "stood_ms" in status.counters[last]:
        return grown(status, "stood_ms", first, last) / 1e3
    return grown(status, "overruns", first, last) * recording.fleet.period_ns / 1e9


def grown(status: StatusTable, name: str, first: int, last: int) -> int:
    """By how much a counter grew between two statuses, -1 for the start; one that started again counts from
    0."""
    before = status.counters[first].get(name, 0) if first >= 0 else 0
    after = status.counters[last].get(name, 0)
    return after - before if after >= before else after
