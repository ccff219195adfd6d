"""Fault rules in words, continued: when they hold, and what they ask of a link (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.fault_settings import LINK_FIELDS, Effect, Impairments, Rule
from deploy.fault_words import words


def effects_text(effects: Mapping[str, Effect[Any]]) -> str:
    """`delay 200ms, loss 30%`: effects on links (`agent.faults.link_effects`) as a fleet file has them."""
    return ", ".join(name if effect.start is True else f"{name} {effect}" for name, effect in effects.items())


def gives_link_effects(settings: Impairments) -> bool:
    """Whether an effect on links is written."""
    return any(getattr(settings, name) is not None for name in LINK_FIELDS)


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
    """`loss 100% on 1->2, from 5 to 15 s`."""
    return f"{words(rule)}, {when(rule)}"
