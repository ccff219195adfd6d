"""Live fault rules from what an operator gives: options of the command line, or a scenario file (PURE)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, get_args, get_origin

from handfast.agent.common.models import plain
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Entry, entries
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, CLOCK_FIELDS, FaultsSection, Rule
from handfast.agent.fleet.scenario import ScenarioError, parse_scenario
from handfast.agent.links.timed_rules import named
from handfast.agent.messages.types import RULES_MAX
from handfast.deploy.console.arguments import InputError
from handfast.deploy.faults.wording import defaults

NOT_LIVE: Final = (*ACTION_FIELDS, *CLOCK_FIELDS)
"""Fields of a rule that a running fleet cannot take."""


class LiveRulesError(InputError):
    """Rules that cannot be sent; the text is one clear message, of a line for each problem."""


def option(key: str) -> str:
    """The option of ``faults set`` that gives the field `key`."""
    return f"--{key.replace('_', '-')}"


def live_entries() -> list[Entry]:
    """The fields that a live rule may give."""
    return [entry for entry in entries(Rule).values() if entry.key not in NOT_LIVE]


def rule_of_options(given: Mapping[str, str], ids: Sequence[int]) -> Rule:
    """The rule of ``faults set``: `given` holds, by key of the field, what was written after its option.

    Raises:
        LiveRulesError: naming the options.
    """
    for key in NOT_LIVE:
        if key in given:
            raise LiveRulesError(f"{option(key)}: {_why_not(key)}")
    raw: dict[str, Any] = {}
    reader = Reader(Rule)
    for key, written in given.items():
        reader.override(raw, f"{key}={_spelled(entries(Rule)[key], written)}")
    try:
        section = parse_scenario(_toml([raw]), ids)
    except ScenarioError as error:
        lines = [_as_option(problem.place, problem.message) for problem in error.problems]
        raise LiveRulesError("\n".join(lines)) from None
    return section.rules[0]


def _as_option(place: str, message: str) -> str:
    key, dot, rest = place.removeprefix("faults.rule[1]").removeprefix(".").partition(".")
    name, bracket, index = key.partition("[")
    where = option(name) + bracket + index + dot + rest
    return f"{where}: {message}" if key else message


def _spelled(entry: Entry, written: str) -> str:
    """What was written, with brackets where the field wants an array: ``1,2`` for ``--robot``."""
    arrays = [hint for hint in (entry.hint, *get_args(entry.hint)) if get_origin(hint) is tuple]
    if entry.setting.parse is not None or not arrays or "," not in written or "[" in written:
        return written
    return f"[{', '.join(map(_number_or_text, written.split(',')))}]"


def _number_or_text(part: str) -> str:
    try:
        float(part)
    except ValueError:
        return json.dumps(part.strip())
    return part.strip()


def rules_of_scenario(text: str, source: str, ids: Sequence[int]) -> list[Rule]:
    """The rules of a scenario file: its ``[[faults.rule]]`` and, after them, what ``[faults]`` itself gives.

    Raises:
        LiveRulesError: with each problem in the file `source`.
    """
    try:
        section = parse_scenario(text, ids)
    except ScenarioError as error:
        raise LiveRulesError("\n".join(f"{source}: {problem}" for problem in error.problems)) from None
    problems = [
        f"faults.rule[{number}].{key}: {_why_not(key)}"
        for number, rule in enumerate(section.rules, 1)
        for key in rule.given(NOT_LIVE)
    ]
    problems += [f"{place}: {why}" for place, why in _beyond_rules(section)]
    rules = list(named(section.rules, "rule"))
    everywhere = defaults(section)
    if everywhere is not None:
        rules.append(everywhere)
    if not rules and not problems:
        problems.append('holds no faults: write [[faults.rule]] and below it, for example, loss = "30%"')
    if problems:
        raise LiveRulesError("\n".join(f"{source}: {problem}" for problem in problems))
    return rules


def _beyond_rules(section: FaultsSection) -> list[tuple[str, str]]:
    out = []
    if section.seed is not None:
        out.append(("faults.seed", "a running fleet draws with the seed of its own file: leave it out"))
    whole = "is not for a running fleet: run with it (handfast run --faults)"
    if section.traces:
        out.append(("faults.trace[1]", whole))
    return out


def _why_not(key: str) -> str:
    if key in CLOCK_FIELDS:
        return "a clock holds for a whole run: write it into the fleet file, [[faults.rule]], and run that"
    return (
        "processes are killed, paused and restarted by the `handfast run` that has started them: write it "
        "into the fleet file, [[faults.rule]], and run that"
    )


def text_of(rules: Sequence[Rule]) -> str:
    """The rules as a message carries them.

    Raises:
        LiveRulesError: it is longer than a message may hold.
    """
    text = _toml([plain(rule) for rule in rules])
    size = len(text.encode())
    if size > RULES_MAX:
        raise LiveRulesError(
            f"the {len(rules)} rules are {size} bytes as text, a message holds {RULES_MAX}: give fewer, or "
            "run with them in the fleet file"
        )
    return text


def _toml(rules: Sequence[Mapping[str, Any]]) -> str:
    import tomli_w  # here: the command line's parser, which robots have too, does without

    return tomli_w.dumps({"faults": {"rule": rules}})
