"""What was asked of the links of a run, what was done to messages, and what their receivers measured."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handfast.agent.fleet.fault_rules import ACTION_FIELDS, Rule
from handfast.agent.fleet.sections import CLOCK_SKEW_MAX_S
from handfast.agent.formation.points import Floats
from handfast.agent.links.fault_plan import FaultPlan, link_effects
from handfast.agent.messages.types import CORRUPTED, DUPLICATED, OVERFLOW, RANGE, REORDERED
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.rounding import largest, mean, number, percentile
from handfast.deploy.console.wording import robots
from handfast.deploy.faults.rules import (
    LiveSet,
    acts_on_links,
    described,
    effects_text,
    gives_link_effects,
    live_sets,
    when,
    windows,
    words,
)
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import Ints, Link, LinkTable, StatusTable, links_of

Ages = Mapping[tuple[int, int], tuple[Floats, Floats]]
"""By (source, destination): fleet times of the receiver's ticks (s) and the age of what it had then (ms)."""


def describe_links(recording: Recording) -> dict[str, Any]:
    """What ``metrics.json`` says of links: `links`, `injected` and `clock_offsets`."""
    age = ages(recording)
    asked = _Asked(recording)
    return {
        "links": [_link(recording, link, rows, asked, age) for link, rows in recording.links.by_link()],
        "injected": injected(recording.links),
        "clock_offsets": clock_offsets(recording),
    }


def injected(rows: LinkTable) -> dict[str, Any]:
    """What was done to messages on purpose.

    `decided` messages, of which no copy of `lost` was let through (`rate` is their share; `range` and
    `overflow` are among them); delays of the copies that were let through.
    """
    messages, lost = int(rows.first_copies.sum()), int(rows.lost.sum())
    delays_ms = rows.delay_us[rows.delivered] / 1e3
    return {
        "decided": messages,
        "lost": lost,
        "rate": number(lost / messages) if messages else None,
        "duplicated": rows.count(DUPLICATED),
        "corrupted": rows.count(CORRUPTED),
        "reordered": rows.count(REORDERED),
        "overflow": rows.count(OVERFLOW),
        "range": rows.count(RANGE),
        "delay_ms": {
            "mean": mean(delays_ms),
            "p50": percentile(delays_ms, 50),
            "p95": percentile(delays_ms, 95),
            "max": largest(delays_ms),
        },
    }


def _link(recording: Recording, link: Link, rows: LinkTable, asked: _Asked, age: Ages) -> dict[str, Any]:
    done = injected(rows)
    pair = link.source, link.destination
    ages_ms = age[pair][1] if link.topic == "hand" and pair in age else np.zeros(0)
    return {
        "link": f"{link.source}->{link.destination}",
        "topic": link.topic,
        "asked": asked.of(link),
        "decided": done.pop("decided"),
        "injected": done,
        "measured": _measured(recording, link),
        "age_ms": _spread(ages_ms) if ages_ms.size else None,
    }


def _spread(ages_ms: Floats) -> dict[str, Any]:
    return {
        "mean": mean(ages_ms),
        "p50": percentile(ages_ms, 50),
        "p95": percentile(ages_ms, 95),
        "p99": percentile(ages_ms, 99),
        "max": largest(ages_ms),
    }


class _Asked:
    """What the rules say of a link, in words."""

    def __init__(self, recording: Recording) -> None:
        self._plan = FaultPlan(recording.fleet)
        self._live: list[tuple[LiveSet, FaultPlan]] = []
        for held in live_sets(recording):
            plan = FaultPlan(recording.fleet)
            plan.take(held.message._replace(lease_ns=0), held.message.time_ns)
            self._live.append((held, plan))

    def of(self, link: Link) -> str:
        """The rules of a link, the first first, each with its time; then what ``[faults]`` says."""
        parts = []
        for held, plan in reversed(self._live):
            for timed in plan.rules_of_link(*link).rules:
                if timed.live:
                    what = effects_text(timed.effects)
                    parts.append(f"{what} (live, {held.message.author}, from {held.origin_s:.1f} s)")
        file = self._plan.rules_of_link(*link)
        rules = {timed.rule.name: timed.rule for timed in file.rules}
        for name, effects in file.asked():
            rule = rules.get(name)
            parts.append(effects_text(effects) + (f" ({rule.name}, {when(rule)})" if rule else ""))
        return "; ".join(parts)

    def touched(self, every: Collection[Link]) -> Iterator[tuple[LiveSet | None, Rule, list[Link]]]:
        """Every rule with effects on links, the live set that it is of, and the links that it is for."""
        sources: list[tuple[LiveSet | None, FaultPlan, Sequence[Rule]]] = [
            (None, self._plan, self._plan.file_rules()),
            *((held, plan, held.rules) for held, plan in self._live),
        ]
        for held, plan, rules in sources:
            found: dict[str, list[Link]] = {rule.name: [] for rule in rules if acts_on_links(rule)}
            for link in every:
                for timed in plan.rules_of_link(*link).rules:
                    if timed.live == (held is not None):
                        found[timed.rule.name].append(link)
            for rule in rules:
                if rule.name in found:
                    yield held, rule, found.pop(rule.name)


# --- what receivers measured ------------------------------------------------------------------


def _measured(recording: Recording, link: Link) -> dict[str, Any]:
    """Messages of the drive: sent, and how many of them the receiver counted as come and as missing."""
    data = recording.robots[link.source]
    table = {"hand": data.hand, "state": data.plant, "wrench": data.wrench}[link.topic]
    start, end, received, lost = 0.0, recording.end_s, None, None
    if link.topic == "hand":
        status = recording.robots[link.destination].status
        times, entries = _of_neighbour(status, link.source)
        rows = np.flatnonzero(times <= recording.end_s)
        if len(rows):
            # From the last status before the drive, or the first within it: what the counter held then was
            # sent at times that nobody knows.
            rows = rows[max(int(np.count_nonzero(times[rows] <= 0.0)) - 1, 0) :]
            start, end = float(times[rows[0]]), float(times[rows[-1]])
            received, lost = (_counted(entries[name][rows]) for name in ("received", "lost"))
    sent = int(np.count_nonzero((table.t > start) & (table.t <= end)))
    return {"sent": sent, "received": received, "lost": lost}


def _counted(totals: Ints) -> int:
    """By how much a counter grew; one that starts again with its process begins at 0."""
    steps = np.diff(totals, prepend=totals[0])
    return int(np.where(steps >= 0, steps, totals).sum())


def _of_neighbour(status: StatusTable, neighbour: int) -> tuple[Floats, NDArray[Any]]:
    """Times (n,) of the statuses that speak of a neighbour, and what they say, (n,)."""
    rows = status.neighbours["robot"] == neighbour
    return np.repeat(status.t, status.neighbour_counts)[rows], status.neighbours[rows]


def ages(recording: Recording) -> Ages:
    """How old each neighbour's hand state was, tick by tick of the drive, by its receiver's estimate.

    That is what the law worked with: everything that the network and the faults did is in it. Statuses
    from when not all neighbours had been heard are left out: it is unknown which age is whose.
    """
    found: dict[tuple[int, int], list[tuple[Floats, Ints]]] = {}
    for robot, data in recording.robots.items():
        status = data.status
        ends = np.cumsum(status.age_counts)
        rows = np.cumsum(status.neighbour_counts)
        heard = False
        for k in range(len(status)):
            entries = status.neighbours[rows[k] - status.neighbour_counts[k] : rows[k]]
            was, heard = heard, bool(len(entries)) and bool((entries["age_us"] >= 0).all())
            count = int(status.age_counts[k])
            if not (was and heard) or count % len(entries) or not 0.0 < status.t[k] <= recording.end_s:
                continue
            ids = entries["robot"].tolist()
            table = status.ages_us[ends[k] - count : ends[k]].reshape(-1, len(ids))
            back = np.arange(len(table) - 1, -1, -1) / recording.fleet.fleet.rate_hz
            for column, source in enumerate(ids):
                found.setdefault((source, robot), []).append((status.t[k] - back, table[:, column]))
    return {
        link: (np.concatenate([t for t, _ in parts]), np.concatenate([ages_us for _, ages_us in parts]) / 1e3)
        for link, parts in found.items()
    }


# --- clocks -----------------------------------------------------------------------------------


def clock_offsets(recording: Recording) -> list[dict[str, Any]]:
    """The last estimate within the drive, by robot and neighbour: the neighbour's clock minus the own."""
    out = []
    for robot, data in recording.robots.items():
        times, entries = np.repeat(data.status.t, data.status.neighbour_counts), data.status.neighbours
        entries = entries[(times <= recording.end_s) & (entries["error_us"] >= 0)]
        last = {int(entry["robot"]): entry for entry in entries}
        for neighbour, entry in sorted(last.items()):
            out.append(
                {
                    "robot": robot,
                    "neighbour": neighbour,
                    "offset_ms": number(float(entry["offset_us"]) / 1e3),
                    "error_ms": number(float(entry["error_us"]) / 1e3),
                }
            )
    return out


def clock_warnings(recording: Recording, offsets: list[dict[str, Any]]) -> list[str]:
    """One sentence for each robot whose clock is off by more than `CLOCK_SKEW_MAX_S`.

    Two robots alone cannot tell whose clock is wrong. The one that most others disagree with is named. What
    one end of a link says and the other denies counts for nothing: both find the same offset.
    """
    limit_ms = 1e3 * CLOCK_SKEW_MAX_S
    wrong: dict[frozenset[int], list[tuple[int, int, float, float]]] = {}
    denied: set[frozenset[int]] = set()
    for entry in offsets:
        offset, error = entry["offset_ms"], entry["error_ms"]
        robot, neighbour = entry["robot"], entry["neighbour"]
        pair = frozenset((robot, neighbour))
        if abs(offset) - error > limit_ms:
            wrong.setdefault(pair, []).append((neighbour, robot, offset, error))
        elif abs(offset) + error <= limit_ms:
            denied.add(pair)
    wrong = {pair: found for pair, found in wrong.items() if pair not in denied}
    out = []
    while wrong:
        counts = {robot: sum(robot in pair for pair in wrong) for pair in wrong for robot in pair}
        # Among equals the first: nothing tells them apart.
        culprit = max(counts, key=lambda robot: (counts[robot], -robot))
        pairs = [pair for pair in wrong if culprit in pair]
        seen: dict[int, tuple[float, float]] = {}
        for pair in pairs:
            for neighbour, robot, offset, error in wrong.pop(pair):
                other, ahead = (robot, offset) if neighbour == culprit else (neighbour, -offset)
                if other not in seen or error < seen[other][1]:
                    seen[other] = (ahead, error)
        ahead = float(np.median([offset for offset, _ in seen.values()])) / 1e3
        error = max(error for _, error in seen.values()) / 1e3
        way = "ahead of" if ahead > 0 else "behind"
        out.append(
            f"Robot {culprit}'s clock is {abs(ahead):.3f} s {way} "
            f"{'that' if len(seen) == 1 else 'those'} of {robots(sorted(seen))}, within {error:.3f} s, as "
            f"their messages tell; {limit_ms / 1e3:g} s is allowed."
            + (" It may be the other one's that is wrong." if len(seen) == 1 else "")
        )
    return out


# --- what is not as it should be -------------------------------------------------------------------


def idle_rules(recording: Recording, a: Analysis) -> list[str]:
    """One sentence for each rule that did nothing in the run, and why."""
    out = []
    times = {link: rows.t for link, rows in recording.links.by_link()}
    end_s = recording.end_s
    section = recording.fleet.faults
    if (
        gives_link_effects(section)
        and recording.fleet.formation.edges
        and not any(link.topic == "hand" for link in times)
    ):
        out.append(f"What [faults] gives every link ({effects_text(link_effects(section))}) met no message.")
    edges = [(a.ids[i], a.ids[j]) for i, j in a.edges.tolist()]
    # Who is near is listened to as well.
    every = dict.fromkeys([*links_of(recording.ids, edges), *times])
    for held, rule, links in _Asked(recording).touched(every):
        start, end = (0.0, end_s) if held is None else (held.origin_s, min(held.end_s, end_s))
        times_held = [(start + first, start + last) for first, last in windows(rule, end - start)]
        which = f"Rule '{rule.name}'" + (f" of {held.message.author}" if held is not None else "")
        if not links and rule.topic in ("hand", "all"):
            out.append(
                f"{which} ({words(rule)}) met no hand state: no edge joined these robots, and they were not "
                "near each other. What it did to beacons is not recorded."
            )
        elif not links:
            out.append(f"{which} ({words(rule)}) is for no link of this fleet: no message goes there.")
        elif not times_held:
            what = "the drive" if end == end_s else "its set"
            out.append(
                f"{which} never held: it begins at {start + (rule.at or 0.0):.1f} s, and {what} ended at "
                f"{end:.1f} s."
            )
        elif not any(
            np.any((times[link] >= first) & (times[link] < last))
            for link in links
            if link in times
            for first, last in times_held
        ):
            out.append(f"{which} ({described(rule)}) met no message.")
    done = {event.rule for event in recording.events}
    for rule in FaultPlan(recording.fleet).file_rules():
        if rule.given(ACTION_FIELDS) and rule.name not in done:
            out.append(f"Rule '{rule.name}' ({described(rule)}) did nothing.")
    return out
