"""Fault rules in words, and when they hold (PURE)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from math import floor, inf
from typing import Any

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
from handfast.deploy.console.wording import robots

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
