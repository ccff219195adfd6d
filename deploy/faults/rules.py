"""Fault rules of a run: in words, when they hold, and as lanes for figures and players (PURE).

The rules are those of the fleet file, and live ones of operators. Times are true fleet time (s). A clock that
is made wrong on purpose shifts a rule by its error for the messages that it stamps; that is left out here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import floor, inf
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from handfast.agent.common.models import plain
from handfast.agent.common.quantities import UNITS, text
from handfast.agent.common.settings import entries
from handfast.agent.fleet.fault_rules import (
    EFFECTS,
    PROCESS_FIELDS,
    SENSOR_FIELDS,
    Effect,
    FaultsSection,
    Impairments,
    Rule,
)
from handfast.agent.fleet.loading import ScenarioError, parse_scenario
from handfast.agent.links.fault_plan import FaultPlan, named
from handfast.agent.messages.types import EVERY_AUTHOR, Faults
from handfast.deploy.console.wording import robots

if TYPE_CHECKING:
    from handfast.deploy.recording.recording import Recording

_WHERE_AND_WHEN = ("name", "link", "robot", "topic", "partition", "at", "for", "every", "until")


def _effects(rule: Rule) -> dict[str, object]:
    return {name: value for name, value in plain(rule).items() if name not in _WHERE_AND_WHEN}


def words(rule: Rule) -> str:
    """One rule on one line, without its times: ``loss 30%, delay 80ms on 1->2``."""
    what = ", ".join(_effect(name, value) for name, value in _effects(rule).items())
    topic = "" if rule.topic == "hand" else "all topics, " if rule.topic == "all" else f"{rule.topic}, "
    if rule.partition is not None:
        return f"{topic}partition {rule.partition}" + (f": {what}" if what else "")
    if rule.link is not None:
        return f"{what} on {topic}{rule.link}"
    if rule.given((*SENSOR_FIELDS, *PROCESS_FIELDS)):
        return f"{what} of {'every robot' if rule.robots is None else robots(rule.robots)}"
    where = "every link" if rule.robots is None else f"links of {robots(rule.robots)}"
    return f"{what} on {topic}{where}"


def _effect(name: str, value: object) -> str:
    if value is True:
        return name
    unit = entries(Rule)[name].setting.unit or ""
    if isinstance(value, float) and unit in UNITS:
        value = text(value, unit)  # as a fleet file would have it: 5ms
    return f"{name} {' '.join(map(str, value)) if isinstance(value, list) else value}"


def effects_text(effects: Mapping[str, Effect[Any]]) -> str:
    """`delay 200ms, loss 30%`: effects on links (`agent.links.timed_rules.link_effects`) as a fleet file has
    them."""
    return ", ".join(name if effect.start is True else f"{name} {effect}" for name, effect in effects.items())


def gives_link_effects(settings: Impairments) -> bool:
    """Whether an effect on links is written."""
    return any(getattr(settings, name) is not None for name in EFFECTS)


def acts_on_links(rule: Rule) -> bool:
    """Whether a rule does something to messages; a partition does, even where nothing else is written."""
    return gives_link_effects(rule) or rule.partition is not None


def when(rule: Rule) -> str:
    """`from 5 to 15 s`, `for 0.5 s every 1 s from 5 to 20 s`, `from 5 s on`, `at 5 s`, `all the time`."""
    start = rule.at or 0.0
    if rule.every is not None and rule.duration is not None:
        to = f" to {rule.until:g} s" if rule.until is not None else " s on"
        return f"for {rule.duration:g} s every {rule.every:g} s from {start:g}{to}"
    if rule.duration is not None:
        return f"from {start:g} to {start + rule.duration:g} s"
    if rule.restart is not None and rule.at is not None:
        return f"at {start:g} s" if rule.every is None else f"every {rule.every:g} s from {start:g} s"
    return "all the time" if rule.at is None else f"from {start:g} s on"


def described(rule: Rule) -> str:
    """A rule with its times: `loss 100% on 1->2, from 5 to 15 s`."""
    return f"{words(rule)}, {when(rule)}"


def window(rule: Rule, time_s: float) -> tuple[float, float] | None:
    """Start and end of the time for which `rule` holds at `time_s`, both counted as its `at`; None when it
    does not hold.

    The end is infinite where the rule has none. One without `at` and `for` holds before time 0, too.
    """
    if rule.at is None and rule.duration is None:
        return -inf, inf
    start, last = rule.at or 0.0, inf if rule.until is None else rule.until
    if rule.every is not None and time_s >= start:
        start += floor((time_s - start) / rule.every) * rule.every
    end = min(last, inf if rule.duration is None else start + rule.duration)
    return (start, end) if start <= time_s < end else None


def next_begin(rule: Rule, time_s: float) -> float | None:
    """When `rule` holds next, counted as its `at`; None when it holds at `time_s`, or never again."""
    if window(rule, time_s) is not None:
        return None
    start = rule.at or 0.0
    if time_s >= start:
        if rule.every is None:
            return None
        start += (floor((time_s - start) / rule.every) + 1) * rule.every
    return start if start < end_of(rule) else None


def lasts(rule: Rule) -> bool:
    """Whether a rule holds for a time: a restart is done at once."""
    return set(_effects(rule)) - {"wipe"} != {"restart"} or rule.partition is not None


def end_of(rule: Rule) -> float:
    """When `rule` ends for good, counted as its `at`; infinite where it does not."""
    if rule.every is not None:
        return inf if rule.until is None else rule.until
    return inf if rule.duration is None else (rule.at or 0.0) + rule.duration


def held(rules: Iterable[Rule], time_s: float) -> Iterator[tuple[Rule, float]]:
    """Those of `rules` that hold at `time_s`, and until when."""
    for rule in rules:
        found = window(rule, time_s)
        if found is not None:
            yield rule, found[1]


def defaults(section: FaultsSection) -> Rule | None:
    """What ``[faults]`` itself gives for every link between agents, as a rule; None for nothing."""
    given = {name: getattr(section, name) for name in Rule.__match_args__ if hasattr(section, name)}
    given = {name: value for name, value in given.items() if value is not None}
    return Rule(name="[faults]", **given) if given else None


_Key = tuple[str, int]
"""(author, version) of a live set."""
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


@dataclass
class _Held:
    """What one robot's processes said of a live set: their first message, when that came, and its end."""

    message: Faults
    received_ns: int
    lease_end_ns: float = 0.0
    dropped_ns: float = inf


def live_sets(recording: Recording) -> list[LiveSet]:
    """Return every live set that a process of the run held, in the order in which they began.

    A set ends when its lease runs out, when a newer one of its author replaces it, or when the processes say
    that they hold it no more.
    """
    epoch_ns = recording.epoch_ns or 0
    sets, dropped = _reported(recording)
    found = []
    for (author, version), holders in sets.items():
        by_time = sorted(holders.values(), key=lambda each: each.message.time_ns)
        message = by_time[(len(by_time) - 1) // 2].message
        over = [
            when
            for who, until, when in dropped
            if who in (author, EVERY_AUTHOR) and until >= version and when >= message.time_ns
        ]
        try:
            rules = named(parse_scenario(message.rules, recording.ids).rules, "live rule")
        except ScenarioError:
            continue  # no node takes such a one either
        own = _median_low(min(each.lease_end_ns, each.dropped_ns) for each in holders.values())
        end_ns = min([own, *over])
        found.append(LiveSet(message, rules, (message.origin_ns - epoch_ns) / 1e9, (end_ns - epoch_ns) / 1e9))
    return sorted(found, key=lambda each: (each.origin_s, each.message.author, each.message.version))


def _reported(recording: Recording) -> tuple[dict[_Key, dict[int, _Held]], list[tuple[str, int, float]]]:
    """Return what robots said of each set, and (author, last version that is over, when)."""
    sets: dict[_Key, dict[int, _Held]] = {}
    dropped: list[tuple[str, int, float]] = []
    for received_ns, robot, _, message in recording.live_faults:
        key = message.author, message.version
        if not robot:  # rules that no process held did nothing
            if not message.rules:  # an operator's empty set works once it has come
                dropped.append((*key, received_ns))
        elif message.rules:
            holder = sets.setdefault(key, {}).setdefault(robot, _Held(message, received_ns))
            lease_end_ns = message.time_ns + message.lease_ns if message.lease_ns else inf
            holder.lease_end_ns = max(holder.lease_end_ns, lease_end_ns)
        else:
            _drop(sets, robot, message)
    # One robot's word does not decide when a set began or ended for all: what half of its holders say does.
    for (author, version), holders in sets.items():
        dropped.append((author, version - 1, _median_low(each.received_ns for each in holders.values())))
    return sets, dropped


def _drop(sets: dict[_Key, dict[int, _Held]], robot: int, message: Faults) -> None:
    """Note that a robot said that it dropped sets."""
    for (author, version), holders in sets.items():
        holder = holders.get(robot)
        if message.author not in (author, EVERY_AUTHOR) or holder is None or message.version < version:
            continue
        if message.time_ns >= holder.message.time_ns:
            holder.dropped_ns = min(holder.dropped_ns, message.time_ns)


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
    for live in live_sets(recording):
        for rule in live.rules:
            found += [
                Span(rule, max(live.origin_s + start, 0.0), live.origin_s + end, live.message.author)
                for start, end in windows(rule, min(live.end_s, end_s) - live.origin_s)
                if live.origin_s + end > 0.0
            ]
    return found


def windows(rule: Rule, end_s: float) -> list[tuple[float, float]]:
    """(start, end) of each time that a rule holds until `end_s`, s as its `at`; one if they are very many."""
    if rule.every is not None and end_s / rule.every > WINDOWS_MAX:
        first = next(rule.windows(end_s), None)
        return [] if first is None else [(first[0], end_s if rule.until is None else min(end_s, rule.until))]
    moment = lasts(rule)
    return [(start, end if moment else start) for start, end in rule.windows(end_s)]


@dataclass(frozen=True)
class Lane:
    """What a rule is called and does, and when it held (s of fleet time)."""

    text: str
    times: Sequence[tuple[float, float]]


def lanes(recording: Recording, end_s: float) -> list[Lane]:
    """One lane for each rule, in the order in which they begin; before them what holds everywhere."""
    times: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for span in spans(recording, end_s):
        name = f"{span.rule.name} ({span.author})" if span.author else span.rule.name
        times.setdefault((name, words(span.rule), span.author), []).append((span.start_s, span.end_s))
    ordered = sorted(times.items(), key=lambda item: min(item[1]))
    found = [Lane(f"{name}: {text}", each) for (name, text, _), each in ordered]
    everywhere = defaults(recording.fleet.faults)
    if everywhere is not None:
        found.insert(0, Lane(f"{everywhere.name}: {words(everywhere)}", [(0.0, end_s)]))
    return found
