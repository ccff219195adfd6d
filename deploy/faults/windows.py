"""When which fault rules held in a run: those of its fleet file, and live ones of operators.

Times are true fleet time (s). A clock that is made wrong on purpose shifts a rule by its error for the
messages that it stamps; that is left out here.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Final, NamedTuple

from agent.fleet.fault_rules import Rule
from agent.fleet.scenario import ScenarioError, parse_scenario
from agent.links.fault_plan import FaultPlan
from agent.links.timed_rules import named
from agent.messages.types import EVERY_AUTHOR, Faults
from deploy.faults.wording import lasts

if TYPE_CHECKING:
    from deploy.recording.recording import Recording

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
    first: dict[tuple[str, int], Faults] = {}
    ends_ns: dict[tuple[str, int], float] = {}
    changes: list[tuple[str, int, int]] = []  # author, version that is over, when
    for received_ns, robot, _, message in recording.live_faults:
        author, version = message.author, message.version
        if not message.rules:
            # A process says when it dropped a set; an operator's empty one works once it has come.
            changes.append((author, version, message.time_ns if robot else received_ns))
            continue
        if not robot:
            continue  # what nobody held did nothing
        key = author, version
        if key not in first:
            first[key] = message
            changes.append((author, version - 1, received_ns))
        lease_end = message.time_ns + message.lease_ns if message.lease_ns else inf
        ends_ns[key] = max(ends_ns.get(key, 0.0), lease_end)
    found = []
    ids = recording.ids
    for (author, version), message in first.items():
        over = [
            when
            for who, until, when in changes
            if (who in (author, EVERY_AUTHOR)) and until >= version and when >= message.time_ns
        ]
        try:
            rules = named(parse_scenario(message.rules, ids).rules, "live rule")
        except ScenarioError:
            continue  # no node takes such a one either
        end_ns = min([ends_ns[author, version], *over])
        found.append(LiveSet(message, rules, (message.origin_ns - epoch_ns) / 1e9, (end_ns - epoch_ns) / 1e9))
    return sorted(found, key=lambda held: (held.origin_s, held.message.author, held.message.version))


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
