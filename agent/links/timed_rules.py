"""Fault rules in time: what one rule does, to which link or sensor, and when (PURE)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.fault_rules import (
    EFFECTS,
    LIMIT,
    SENSOR_FIELDS,
    Effect,
    Impairments,
    Rule,
)
from handfast.agent.impairments.impairments import Corrupt, Delay, Duplicate, Loss, Range, Rate, Reorder, Slot

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
    limit: int = LIMIT
    slot: Slot | None = None
    hold: bool = False
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
