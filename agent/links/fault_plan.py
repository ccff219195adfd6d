"""The fault rules in force, by place and time: the fleet file's rules and operators' live rules (PURE).

Every node holds a `FaultPlan`. The stamp of a message decides which rules apply to it, so all receivers, and
a run and its simulation, decide alike. For each effect the first matching rule wins: live rules before the
file's (the newest author first), then ``[faults]`` for links between agents.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, NamedTuple

from handfast.agent.common.time import NS_PER_S, LocalTime
from handfast.agent.fleet.fault_rules import (
    ACTION_FIELDS,
    CLOCK_FIELDS,
    EFFECTS,
    SENSOR_FIELDS,
    ClockError,
    Effect,
    FaultsSection,
    Impairments,
    Rule,
)
from handfast.agent.fleet.loading import ScenarioError, parse_scenario
from handfast.agent.fleet.model import Fleet
from handfast.agent.impairments.impairments import Corrupt, Delay, Duplicate, Loss, Range, Rate, Reorder
from handfast.agent.messages.types import EVERY_AUTHOR, Faults

FOREVER_NS: Final = 2**62
"""An end that never comes: later than any time of a message."""

_LOST: Final = Effect(Loss.parse("100%"))


class LinkEffects(NamedTuple):
    """What a link does to one message; None where it does nothing of the kind."""

    delay: Delay | None = None
    loss: Loss | None = None
    duplicate: Duplicate | None = None
    reorder: Reorder | None = None
    corrupt: Corrupt | None = None
    rate: Rate | None = None
    range: Range | None = None


NONE: Final = LinkEffects()
"""The effects of a link to which nothing happens."""


def link_effects(settings: Impairments) -> dict[str, Effect[Any]]:
    """Effects on links that these settings give, by name."""
    found: dict[str, Effect[Any]] = {}
    for name in EFFECTS:
        value = getattr(settings, name)
        if value is not None:
            found[name] = value if isinstance(value, Effect) else Effect(value)
    return found


@dataclass(frozen=True, slots=True)
class TimedRule:
    """One rule with the wall clock that its times count from, None before the mission's epoch is known.

    A live rule holds from its origin on; `until_ns`, its lease, ends it whatever it says itself.
    """

    rule: Rule
    effects: dict[str, Effect[Any]]
    origin_ns: int | None
    until_ns: int = FOREVER_NS
    live: bool = False

    def fraction(self, time_ns: int) -> float | None:
        """Share of its time that has passed at a wall time, 0 without an end; None while it does not hold."""
        rule = self.rule
        if time_ns >= self.until_ns:
            return None
        if rule.at is None and rule.duration is None and not self.live:
            return 0.0
        if self.origin_ns is None:
            return None
        since_ns = time_ns - self.origin_ns - round((rule.at or 0.0) * NS_PER_S)
        if since_ns < 0:
            return None
        if rule.until is not None and time_ns >= self.origin_ns + round(rule.until * NS_PER_S):
            return None
        if rule.every is not None:
            since_ns %= round(rule.every * NS_PER_S)
        if rule.duration is None:
            return 0.0
        duration_ns = round(rule.duration * NS_PER_S)
        return since_ns / duration_ns if since_ns < duration_ns else None

    def touches(self, source: int, destination: int, topic: str, ids: Sequence[int]) -> bool:
        """Whether its effects on links are for this one."""
        rule = self.rule
        if not self.effects or rule.topic not in (topic, "all"):
            return False
        if rule.link is not None:
            return rule.link.has(source, destination)
        if rule.partition is not None:
            return rule.partition.cuts(source, destination, ids)
        return rule.robots is None or source in rule.robots or destination in rule.robots


class SensorFaults(NamedTuple):
    """Faults of one measurement; names and units of `agent.fleet.fault_rules.Rule`, 0 for nothing."""

    position_bias_m: tuple[float, float] = (0.0, 0.0)
    heading_bias_rad: float = 0.0
    jump_m: float = 0.0


def named(rules: Sequence[Rule], kind: str) -> tuple[Rule, ...]:
    """The rules, those without a name called after their kind and place: ``rule 1``, ``live rule 2``."""
    return tuple(
        rule if rule.name else replace(rule, name=f"{kind} {number}") for number, rule in enumerate(rules, 1)
    )


def effects_of(rule: Rule) -> dict[str, Effect[Any]]:
    """Effects of a rule on links, by name; a partition that gives none loses all messages."""
    effects = link_effects(rule)
    if rule.partition is not None and not rule.given(EFFECTS):
        effects["loss"] = _LOST
    return effects


class LinkRules:
    """The rules of one link, in the order in which they win."""

    def __init__(self, rules: tuple[TimedRule, ...], defaults: dict[str, Effect[Any]]) -> None:
        self.rules = rules
        self._defaults = defaults
        self._known: dict[tuple[int, ...], LinkEffects] = {}
        self.idle: Final = not rules and not defaults
        """True when nothing ever happens to messages of this link, as long as no rule changes."""

    def effects(self, time_ns: int) -> LinkEffects:
        """What happens to a message that was sent at the wall time `time_ns`."""
        holding: list[tuple[TimedRule, float]] = []
        ramped = False
        for timed in self.rules:
            fraction = timed.fraction(time_ns)
            if fraction is not None:
                holding.append((timed, fraction))
                ramped = ramped or any(effect.end is not None for effect in timed.effects.values())
        if ramped:
            return self._merged(holding)
        key = tuple(id(timed) for timed, _ in holding)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = self._merged(holding)
        return known

    def _merged(self, holding: Sequence[tuple[TimedRule, float]]) -> LinkEffects:
        found: dict[str, Any] = {}
        for timed, fraction in holding:
            for name, effect in timed.effects.items():
                if name not in found:
                    found[name] = effect.at(fraction)
        for name, effect in self._defaults.items():
            if name not in found:
                found[name] = effect.at(0.0)
        return LinkEffects(**found) if found else NONE

    def asked(self) -> Iterator[tuple[str, dict[str, Effect[Any]]]]:
        """(name, effects) of every rule, and of the defaults under ``[faults]``."""
        for timed in self.rules:
            yield timed.rule.name, timed.effects
        if self._defaults:
            yield "[faults]", self._defaults


assert {field.name for field in fields(Impairments)} == set(EFFECTS)

assert SensorFaults._fields == SENSOR_FIELDS


AUTHORS_MAX: Final = 16
"""Authors whose live rules hold at once."""

ENDED_MAX: Final = 64
"""Authors whose ended rules are remembered by their version."""


class LiveSet(NamedTuple):
    """The live rules of one author as they were sent, and what they are."""

    message: Faults
    rules: tuple[Rule, ...]


class FaultPlan:
    """All faults of `fleet`, those of the file and live ones. One for each node.

    Attributes:
        seed: of every draw.
        changes: counts up whenever other rules hold than before; what was worked out from them is stale then.
    """

    def __init__(self, fleet: Fleet) -> None:
        section = fleet.faults
        self.ids: Final = fleet.ids
        self.seed: Final = fleet.fleet.seed if section.seed is None else section.seed
        self.changes = 0
        self.epoch_ns: int | None = None
        self._defaults = link_effects(section)
        self._file = named(section.rules, "rule")
        self._live: dict[str, LiveSet] = {}
        self._ended: dict[str, int] = {}
        self._cleared_version = 0
        self._timed: tuple[TimedRule, ...] = ()
        self._build()

    def begin(self, epoch_ns: int) -> None:
        """Begins a mission: times of the file's rules count from `epoch_ns`, wall time."""
        if epoch_ns != self.epoch_ns:
            self.epoch_ns = epoch_ns
            self._build()

    def take(self, message: Faults, now_ns: int) -> str | None:
        """Takes live rules; returns why not, None when they are taken.

        ``out_of_order``, ``duplicate``, ``expired``, ``scenario`` (not valid), ``authors`` (too many).

        The same version again, with a later time, renews the lease; a set without rules is its author's end.
        """
        if message.author == EVERY_AUTHOR:
            if message.version <= self._cleared_version:
                return "duplicate"
            self._cleared_version = message.version
            self._ended.clear()
            kept = {a: held for a, held in self._live.items() if held.message.version > message.version}
            if len(kept) != len(self._live):
                self._live = kept
                self._build()
            return None
        known = self._live.get(message.author)
        newest = known.message.version if known is not None else self._ended.get(message.author, 0) + 1
        if message.version <= self._cleared_version or message.version < newest:
            return "out_of_order"
        if message.lease_ns and now_ns >= message.time_ns + message.lease_ns:
            return "expired"
        if known is not None and message.version == known.message.version:
            if message.rules != known.message.rules or message.time_ns < known.message.time_ns:
                return "duplicate"
            rules = known.rules
        else:
            try:
                section = parse_scenario(message.rules, self.ids)
            except ScenarioError:
                return "scenario"
            of_a_file = any(rule.given((*ACTION_FIELDS, *CLOCK_FIELDS)) for rule in section.rules)
            if of_a_file or section != FaultsSection(rules=section.rules):
                return "scenario"  # nodes can live with rules alone, and those that they can carry out
            rules = named(section.rules, "live rule")
        if not rules:
            self._end(message.author, message.version)
            return None
        if known is None and len(self._live) >= AUTHORS_MAX:
            return "authors"
        self._live[message.author] = LiveSet(message, rules)
        self._build()
        return None

    def _end(self, author: str, version: int) -> None:
        """Forgets the rules of an author, but not their number: they do not come back by a late message."""
        self._ended.pop(author, None)
        if len(self._ended) >= ENDED_MAX:
            del self._ended[next(iter(self._ended))]
        self._ended[author] = version
        if self._live.pop(author, None) is not None:
            self._build()

    def ended(self, author: str) -> int:
        """Version of what ended an author's rules; 0 when it was not done by anybody."""
        return max(self._ended.get(author, 0), self._cleared_version)

    def expire(self, now_ns: int) -> bool:
        """Forgets live rules whose lease has run out; True when there were any."""
        if not self._live:
            return False
        over = [
            author
            for author, held in self._live.items()
            if held.message.lease_ns and now_ns >= held.message.time_ns + held.message.lease_ns
        ]
        for author in over:
            del self._live[author]
        if over:
            self._build()
        return bool(over)

    @property
    def live(self) -> Sequence[LiveSet]:
        """Live rules that are held, the newest first."""
        return sorted(self._live.values(), key=lambda held: (-held.message.version, held.message.author))

    def _build(self) -> None:
        timed = [
            TimedRule(
                rule,
                effects_of(rule),
                held.message.origin_ns,
                held.message.time_ns + held.message.lease_ns if held.message.lease_ns else FOREVER_NS,
                live=True,
            )
            for held in self.live
            for rule in held.rules
        ]
        timed += [TimedRule(rule, effects_of(rule), self.epoch_ns) for rule in self._file]
        self._timed = tuple(timed)
        self.changes += 1

    def rules_of_link(self, source: int, destination: int, topic: str) -> LinkRules:
        """What may happen to the messages of one link, until `changes` counts up.

        Beacons go over the same air as hand states: what is for one is for both.
        """
        ruled = _ruled_as(topic)
        return LinkRules(
            tuple(timed for timed in self._timed if timed.touches(source, destination, ruled, self.ids)),
            self._defaults if ruled == "hand" else {},
        )

    def is_ruled(self, source: int, destination: int, topic: str) -> bool:
        """Whether `rules_of_link` has anything: what most links are asked."""
        ruled = _ruled_as(topic)
        return any(timed.touches(source, destination, ruled, self.ids) for timed in self._timed) or (
            ruled == "hand" and bool(self._defaults)
        )

    @property
    def rules_links(self) -> bool:
        """Whether there is anything that may happen to the messages of a link, until `changes` counts up."""
        return bool(self._timed or self._defaults)

    def sensor(self, robot: int, time_ns: int) -> SensorFaults | None:
        """Faults of a measurement of `robot` that is taken at `time_ns`; None for none."""
        found = self._settings(SENSOR_FIELDS, robot, time_ns)
        return SensorFaults(**found) if found else None

    def tick_jitter(self, robot: int, time_ns: int) -> tuple[int, float]:
        """By how much at most the ticks of `robot` come late at `time_ns` (ns), and which share does."""
        for timed in self._timed:
            rule = timed.rule
            if rule.tick_jitter is None or (rule.robots is not None and robot not in rule.robots):
                continue
            if timed.fraction(time_ns) is not None:
                return int(rule.tick_jitter.most_s * NS_PER_S), rule.tick_jitter.share
        return 0, 1.0

    def clock(self, robot: int) -> tuple[int, float]:
        """How far the clock of `robot` is ahead (ns), and how much faster it is (1 is twice as fast)."""
        error = self._settings(CLOCK_FIELDS, robot, 0).get("clock_skew", ClockError(0.0))
        return round(error.ahead_s * NS_PER_S), error.drift

    def local_time(self, robot: int) -> LocalTime | None:
        """The injected error of the clock of `robot`; None for none."""
        skew_ns, drift = self.clock(robot)
        return LocalTime(skew_ns, drift, self.epoch_ns) if skew_ns or drift else None

    def file_rules(self) -> Sequence[Rule]:
        """The fleet file's rules; each has a name."""
        return self._file

    def rules(self) -> Sequence[Rule]:
        """All rules, live ones too, whether or not they hold now."""
        return [timed.rule for timed in self._timed]

    def _settings(self, names: Sequence[str], robot: int, time_ns: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for timed in self._timed:
            rule = timed.rule
            if rule.robots is not None and robot not in rule.robots:
                continue
            given = rule.given(names)
            if given and timed.fraction(time_ns) is not None:
                for name in given:
                    found.setdefault(name, getattr(rule, name))
        return found


def _ruled_as(topic: str) -> str:
    """By the rules of which topic a message goes."""
    return "hand" if topic == "beacon" else topic
