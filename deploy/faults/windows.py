"""When which fault rules held in a run: those of its fleet file, and live ones of operators.

Times are true fleet time (s). A clock that is made wrong on purpose shifts a rule by its error for the
messages that it stamps; that is left out here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Final, NamedTuple

from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.fleet.scenario import ScenarioError, parse_scenario
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.timed_rules import named
from handfast.agent.messages.types import EVERY_AUTHOR, Faults
from handfast.deploy.faults.wording import lasts

if TYPE_CHECKING:
    from handfast.deploy.recording.recording import Recording

WINDOWS_MAX: Final = 2000
"""A rule that comes again more often than this is taken to hold all the time."""


@dataclass(frozen=True)
class LiveSet:
    """The rules of one live message. Their times count from `origin_s`; at `end_s` they were over."""

    message: Faults
    rules: tuple[Rule, ...]
    origin_s: float
    end_s: float


class Span(NamedTuple):
    """One time that one rule held, s of fleet time; `author` of a live rule, "" for the fleet file's."""

    rule: Rule
    start_s: float
    end_s: float
    author: str


def live_sets(recording: Recording) -> list[LiveSet]:
    """Every live set that a process of the run held, in the order in which they began.

    A set ends when its lease runs out, when a newer one of its author replaces it, or when the
    processes say that they hold it no more.
    """
    epoch_ns = recording.epoch_ns or 0
    held: dict[tuple[str, int], dict[int, _Held]] = {}
    dropped: list[tuple[str, int, float]] = []  # author, version that is over, when
    for received_ns, robot, _, message in recording.live_faults:
        author, version = message.author, message.version
        if not robot:
            if not message.rules:  # an operator's empty set works once it has come
                dropped.append((author, version, received_ns))
            continue  # what nobody held did nothing
        if message.rules:
            of_robot = held.setdefault((author, version), {}).setdefault(robot, _Held(message, received_ns))
            lease_end = message.time_ns + message.lease_ns if message.lease_ns else inf
            of_robot.lease_end_ns = max(of_robot.lease_end_ns, lease_end)
            continue
        for (whose, earlier), robots in held.items():  # a process says when it dropped a set
            since = robots.get(robot)
            if author not in (whose, EVERY_AUTHOR) or since is None or version < earlier:
                continue
            if message.time_ns >= since.message.time_ns:
                since.dropped_ns = min(since.dropped_ns, message.time_ns)
    # One robot's word does not decide when a set began or ended for all: what half of its holders say does.
    for (author, version), robots in held.items():
        dropped.append((author, version - 1, _median_low(each.received_ns for each in robots.values())))
    found = []
    ids = recording.ids
    for (author, version), robots in held.items():
        by_time = sorted(robots.values(), key=lambda each: each.message.time_ns)
        message = by_time[(len(by_time) - 1) // 2].message
        over = [
            when
            for who, until, when in dropped
            if who in (author, EVERY_AUTHOR) and until >= version and when >= message.time_ns
        ]
        try:
            rules = named(parse_scenario(message.rules, ids).rules, "live rule")
        except ScenarioError:
            continue  # no node takes such a one either
        own = _median_low(min(each.lease_end_ns, each.dropped_ns) for each in robots.values())
        end_ns = min([own, *over])
        found.append(LiveSet(message, rules, (message.origin_ns - epoch_ns) / 1e9, (end_ns - epoch_ns) / 1e9))
    return sorted(found, key=lambda held: (held.origin_s, held.message.author, held.message.version))


@dataclass
class _Held:
    """What one robot's processes said of a set: as they said it first, when that came, and its end."""

    message: Faults
    received_ns: int
    lease_end_ns: float = 0.0
    dropped_ns: float = inf


def _median_low(times: Iterable[float]) -> float:
    """As of `statistics`, which loads decimals, fractions and random numbers at every start."""
    ordered = sorted(times)
    return ordered[(len(ordered) - 1) // 2]


def spans(recording: Recording, end_s: float) -> list[Span]:
    """Every time between 0 and `end_s` that a rule held, file rules first.

    A restart is a moment: its span ends where it begins.
    """
    found = []
    for rule in FaultPlan(recording.fleet).file_rules():
        found += [Span(rule, start, end, "") for start, end in windows(rule, end_s)]
    for held in live_sets(recording):
        for rule in held.rules:
            found += [
                Span(rule, max(held.origin_s + start, 0.0), held.origin_s + end, held.message.author)
                for start, end in windows(rule, min(held.end_s, end_s) - held.origin_s)
                if held.origin_s + end > 0.0
            ]
    return found


def windows(rule: Rule, end_s: float) -> list[tuple[float, float]]:
    """(start, end) of each time that a rule holds until `end_s`, s as its `at`; one if they are very many."""
    if rule.every is not None and end_s / rule.every > WINDOWS_MAX:
        first = next(rule.windows(end_s), None)
        return [] if first is None else [(first[0], end_s if rule.until is None else min(end_s, rule.until))]
    moment = lasts(rule)
    return [(start, end if moment else start) for start, end in rule.windows(end_s)]
