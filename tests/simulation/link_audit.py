"""Test oracle: do the recorded decisions on messages follow from the fault rules and the seed?

Decisions are functions of the seed, the link and the message's number and stamp
(`agent.links.link_emulator`). The audit makes every decision of a recording again, from its fleet file, the
live rules that each process reported, and the messages as they were sent. It does not check decisions that
depend on more: queues of a rate limit, and range channels.

A robot listens to the hand states of its neighbours, and of robots nearby. Recorded decisions are checked for
all of them; messages without any decision are counted only for neighbours. Beacons are not recorded.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.common.time import NS_PER_S
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.link_emulator import TRACE_PERIOD_NS, LinkEmulator
from handfast.agent.messages.types import OVERFLOW, TOPICS, Faults, Wrench
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.faults.rules import gives_link_effects
from handfast.deploy.recording.recording import LiveFaults, Recording
from handfast.deploy.recording.tables import Link, LinkTable, links_of

DIFFERENCES_MAX: Final = 20
"""Maximum number of differences that a result lists."""
_CHANGE_NS: Final = 3 * NS_PER_S // 10
"""Time around a change of the live rules in which it is unknown which of them a process had."""
_AWAY_NS: Final = 2 * NS_PER_S
"""Time after its start in which a process may lack the mission and the live rules."""
_FAR_NS: Final = 2**62
_BEGUN_S: Final = 0.5
"""Time around a change of an edge in which a robot may not listen to that neighbour."""

_Spans = tuple[tuple[float, float], ...]
_ALWAYS: Final[_Spans] = ((-inf, inf),)
_Copies = tuple[tuple[int, int], ...]
"""(what, delay_us) of each copy of one message."""


class Difference(NamedTuple):
    """A message whose recorded fate is not what its rules give; copies are (what, delay_us)."""

    link: Link
    sequence: int
    stamp_ns: int
    recorded: _Copies
    expected: _Copies


class _Change(NamedTuple):
    """A change of the live rules of a process between these times (true wall time, ns)."""

    since_ns: int
    said_ns: int


@dataclass
class AuditResult:
    """Counts of messages.

    Attributes:
        decided: messages with a recorded decision; the next four add up to it.
        agreeing, differing: decisions that were made again.
        unchecked: decisions that depend on more than the recording holds.
        unrecorded: decisions on messages that the recording lacks.
        unheard: messages under a rule without a decision: they never reached the receiver.
    """

    decided: int = 0
    agreeing: int = 0
    differing: int = 0
    unchecked: int = 0
    unrecorded: int = 0
    unheard: int = 0
    differences: list[Difference] = field(default_factory=list)


def audit(recording: Recording, a: Analysis) -> AuditResult:
    """Make every recorded decision again and compare. `a` says which robots shared an edge when."""
    result = AuditResult()
    if not len(recording.links) and not _has_rules(recording):
        return result
    by_receiver: dict[tuple[int, str], dict[Link, LinkTable]] = {}
    for link, rows in recording.links.by_link():
        by_receiver.setdefault(_receiver(link), {})[link] = rows
    plain = _plan(recording, ())
    neighbours = _neighbours(a)
    expected: dict[tuple[int, str], list[Link]] = {}
    for link in links_of(recording.ids, neighbours):
        expected.setdefault(_receiver(link), []).append(link)
    for (robot, role), links in expected.items():
        recorded = by_receiver.pop((robot, role), {})
        node = _Node(recording, robot, role, plain)
        for link in links:
            spans = neighbours[_pair(link)] if link.topic == "hand" else _ALWAYS
            node.check(link, recorded.pop(link, None), spans, result)
        for link, rows in recorded.items():
            if link.topic == "hand" and link.source != link.destination:
                node.check(link, rows, (), result)
                continue
            # A trace that names a link without messages.
            messages = int(rows.first_copies.sum())
            result.decided += messages
            result.unrecorded += messages
    return result


def _has_rules(recording: Recording) -> bool:
    section = recording.fleet.faults
    return bool(recording.live_faults or section.rules or gives_link_effects(section))


def _receiver(link: Link) -> tuple[int, str]:
    return link.destination, "plant" if link.topic == "wrench" else "agent"


def _pair(link: Link) -> tuple[int, int]:
    return min(link.source, link.destination), max(link.source, link.destination)


def _neighbours(a: Analysis) -> dict[tuple[int, int], _Spans]:
    """Return fleet times (s) in which pairs of robots, the lesser id first, certainly shared an edge."""
    found = {}
    times = a.grid.tolist()
    for (i, j), wanted in zip(a.edges.tolist(), a.wanted.T, strict=True):
        steps = np.diff(np.isfinite(wanted).astype(np.int8), prepend=0, append=0)
        spans = []
        for first, end in zip(
            np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True
        ):
            start_s = times[first] + _BEGUN_S if first else -inf
            end_s = times[end - 1] - _BEGUN_S if end < len(times) else inf
            spans.append((start_s, end_s))
        one, other = a.ids[i], a.ids[j]
        found[min(one, other), max(one, other)] = tuple(spans)
    return found


def _plan(recording: Recording, live: Sequence[Faults]) -> FaultPlan:
    plan = FaultPlan(recording.fleet)
    if recording.epoch_ns is not None:
        plan.begin(recording.epoch_ns)
    for message in live:
        # When a lease ended is known from when the process dropped it.
        plan.take(message._replace(lease_ns=0), message.time_ns)
    return plan


class _Node:
    """A receiving process: which rules it held when, and when it was not running."""

    def __init__(self, recording: Recording, robot: int, role: str, plain: FaultPlan) -> None:
        self._recording, self._robot = recording, robot
        self._epoch_ns = recording.epoch_ns or 0
        held = [each for each in recording.live_faults if (each.robot, each.role) == (robot, role)]
        self._changes, self._plans = _timeline(recording, held, plain)
        self._away_ns = list(_away(recording, robot, role))
        data = recording.robots[robot]
        said = data.plant.t if role == "plant" else data.status.t
        # A decision is reported a little later than it is made: what came after the last report is unknown.
        last_ns = round(float(said[-1]) * NS_PER_S) + self._epoch_ns if len(said) else 0
        self._known_ns = last_ns - TRACE_PERIOD_NS - 2 * recording.fleet.period_ns

    def check(self, link: Link, rows: LinkTable | None, heard: _Spans, result: AuditResult) -> None:
        """Count the messages of one link; all of them must have come in the times `heard` (s)."""
        recorded: dict[int, _Copies] = {}
        if rows is not None:
            for stamp, what, delay_us in zip(
                rows.stamp_ns.tolist(), rows.what.tolist(), rows.delay_us.tolist(), strict=True
            ):
                recorded[stamp] = (*recorded.get(stamp, ()), (what, delay_us))
        if not recorded and all(
            plan.rules_of_link(link.source, link.destination, link.topic).idle for plan in self._plans
        ):
            return
        data = self._recording.robots[link.source]
        table = {"hand": data.hand, "state": data.plant, "wrench": data.wrench}[link.topic]
        stamps, sequences = table.stamps_ns.tolist(), table.sequences.tolist()
        times = np.rint(table.t * NS_PER_S).astype(np.int64) + self._epoch_ns
        expected, beyond = self._decide(link, stamps, sequences, times.tolist())
        drive_ns = self._epoch_ns + round(self._recording.end_s * NS_PER_S)
        result.decided += len(recorded)
        last_ns = min(drive_ns, self._known_ns)
        for stamp, sequence, time_ns in zip(stamps, sequences, times.tolist(), strict=True):
            found, wanted = recorded.pop(stamp, None), expected.get(stamp)
            if found is None:
                known = wanted is not None and self._epoch_ns <= time_ns <= last_ns
                if known and self._within(time_ns, heard) and not self._unclear(time_ns):
                    result.unheard += 1
            elif stamp in beyond:
                result.unchecked += 1
            elif wanted is not None and _same(found, wanted):
                result.agreeing += 1
            elif self._unclear(time_ns) or _of_more(found, wanted or ()):
                result.unchecked += 1
            else:
                result.differing += 1
                if len(result.differences) < DIFFERENCES_MAX:
                    result.differences.append(Difference(link, sequence, stamp, found, wanted or ()))
        if rows is not None and recorded:
            left = np.isin(rows.stamp_ns, list(recorded)) & rows.first_copies
            driven = left & (rows.t >= 0.0) & (rows.t <= self._recording.end_s)
            result.unrecorded += int(driven.sum())
            # Before the drive the operator may not have listened yet, after it no more.
            result.unchecked += int(left.sum() - driven.sum())

    def _decide(
        self, link: Link, stamps: Sequence[int], sequences: Sequence[int], times: Sequence[int]
    ) -> tuple[dict[int, _Copies], set[int]]:
        """Return decisions by stamp, and stamps of messages whose decisions depend on more."""
        topic = TOPICS.index(link.topic)
        expected: dict[int, _Copies] = {}
        beyond: set[int] = set()
        first = 0
        for plan, until_ns in zip(
            self._plans, (*(change.said_ns for change in self._changes), _FAR_NS), strict=True
        ):
            last = bisect_right(times, until_ns - 1, first)
            part = range(first, last)
            first = last
            rules = plan.rules_of_link(link.source, link.destination, link.topic)
            if rules.idle:
                continue
            more = any({"rate", "range"} & effects.keys() for _, effects in rules.asked())
            links = LinkEmulator(plan, self._robot, {link.topic: (link.source,)})
            for k in part:
                stamp = stamps[k]
                if more:
                    effects = rules.effects(stamp)
                    if effects.rate is not None or effects.range is not None:
                        beyond.add(stamp)
                links.due(stamp)
                links.take("", b"\0", topic, Wrench(link.source, sequences[k], stamp, 0.0, 0.0, False))
            links.due(_FAR_NS)
            for trace in (*links.traced(_FAR_NS), *links.traced(_FAR_NS + TRACE_PERIOD_NS)):
                for _, _, _, stamp, what, delay_us in trace.entries:
                    expected[stamp] = (*expected.get(stamp, ()), (what, delay_us))
        return expected, beyond

    def _within(self, time_ns: int, spans: _Spans) -> bool:
        t = (time_ns - self._epoch_ns) / NS_PER_S
        return any(start_s <= t <= end_s for start_s, end_s in spans)

    def _unclear(self, time_ns: int) -> bool:
        """Return True if the process was changing its rules, or starting, when this message came."""
        return any(
            since - _CHANGE_NS <= time_ns <= said + _CHANGE_NS for since, said in self._changes
        ) or any(first <= time_ns <= last for first, last in self._away_ns)


def _same(found: _Copies, wanted: _Copies) -> bool:
    return sorted(found) == sorted(wanted)


def _of_more(found: _Copies, wanted: _Copies) -> bool:
    """Return True if a queue may explain the difference."""
    return any(what & OVERFLOW for what, _ in (*found, *wanted))


def _timeline(
    recording: Recording, held: Sequence[LiveFaults], plain: FaultPlan
) -> tuple[list[_Change], list[FaultPlan]]:
    """Return when the live rules of a process changed, and its plan before, between and after."""
    changes: list[_Change] = []
    plans = [plain]
    live: dict[str, Faults] = {}
    said_ns = 0
    for received_ns, _, _, message in held:
        before_ns, said_ns = said_ns, received_ns
        known = live.get(message.author)
        if (known is None and not message.rules) or (
            known is not None and message.rules and known.version == message.version
        ):
            continue
        if message.rules:
            live[message.author] = message
        else:
            del live[message.author]
        # It may have changed at any time since it last said what it holds, but not before it was sent.
        since_ns = max(before_ns, message.time_ns) if message.rules else before_ns
        changes.append(_Change(min(since_ns, received_ns), received_ns))
        plans.append(_plan(recording, tuple(live.values())))
    return changes, plans


def _away(recording: Recording, robot: int, role: str) -> Iterator[tuple[int, int]]:
    """Yield times (ns) at which a process was killed, paused, or had just come back."""
    since: int | None = None
    for event in recording.events:
        if (event.robot, event.role) != (robot, role):
            continue
        if event.what in ("kill", "stop"):
            since = event.time_ns if since is None else since
        elif since is not None:
            yield since - _CHANGE_NS, event.time_ns + _AWAY_NS
            since = None
    if since is not None:
        yield since - _CHANGE_NS, _FAR_NS
