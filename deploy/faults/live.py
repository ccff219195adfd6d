"""Live fault rules: which hold on a running fleet, and rules from options or a scenario file (PURE)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, get_args, get_origin

from handfast.agent.common.models import plain
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Entry, entries
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, CLOCK_FIELDS, FaultsSection, Rule
from handfast.agent.fleet.loading import ScenarioError, parse_scenario
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import AUTHORS_MAX, ENDED_MAX, named
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import RULES_MAX, Faults, Message
from handfast.deploy.console.arguments import InputError
from handfast.deploy.faults.rules import defaults, held, words

Receiver = tuple[int, str]
"""(robot, role) of a process that live rules are for."""


def receivers(fleet: Fleet) -> list[Receiver]:
    """All processes that live rules are for: every agent and plant."""
    return [(robot, role) for robot in fleet.ids for role in key_expressions.ROLES]


class LiveSet(NamedTuple):
    """The live rules of one author, and who holds them. `message` is the newest that was echoed."""

    message: Faults
    rules: tuple[Rule, ...]
    holders: frozenset[Receiver]

    def time_s(self, now_ns: int) -> float:
        """Time from which its rules' `at` counts, s."""
        return (now_ns - self.message.origin_ns) / NS_PER_S

    def lines(self, now_ns: int) -> list[str]:
        """Those of its rules that hold now, in words."""
        return [words(rule) for rule, _ in held(self.rules, self.time_s(now_ns))]


class Held:
    """Which live rules each agent and plant of a fleet holds, from their echoes on the bus.

    Echoes come on `agent.messages.key_expressions.faults_held`.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._ids = fleet.ids
        name = fleet.fleet.name
        self._receivers = {
            key_expressions.faults_held(name, robot, role): (robot, role) for robot, role in receivers(fleet)
        }
        self._latest: dict[tuple[Receiver, str], Faults] = {}
        self._latest_max = len(self._receivers) * (AUTHORS_MAX + ENDED_MAX)
        self._rules: dict[str, tuple[Rule, ...]] = {}

    def feed(self, key: str, message: Message) -> None:
        """Takes a message that came on `key`; what is no echo is ignored."""
        receiver = self._receivers.get(key)
        if receiver is not None and type(message) is Faults:
            known = receiver, message.author
            self._latest.pop(known, None)
            self._latest[known] = message  # the latest last: what is held is said again and again
            if len(self._latest) > self._latest_max:
                del self._latest[next(iter(self._latest))]

    def forget(self, receiver: Receiver) -> None:
        """Forgets what a process held: it has started again, and holds nothing."""
        for known in [known for known in self._latest if known[0] == receiver]:
            del self._latest[known]

    def echo(self, receiver: Receiver, author: str) -> Faults | None:
        """The last echo of one process of an author's rules; without rules when it holds none any more."""
        return self._latest.get((receiver, author))

    def sets(self, now_ns: int) -> list[LiveSet]:
        """The live rules that are held at the wall time `now_ns`, the newest first."""
        found: dict[str, tuple[Faults, set[Receiver]]] = {}
        for (receiver, author), message in self._latest.items():
            over = message.lease_ns and now_ns >= message.time_ns + message.lease_ns
            if not message.rules or over:
                continue
            newest, holders = found.setdefault(author, (message, set()))
            holders.add(receiver)
            if (message.version, message.time_ns) > (newest.version, newest.time_ns):
                found[author] = message, holders
        newest_first = sorted(found.values(), key=lambda each: -each[0].version)
        sets = [
            LiveSet(message, self._parsed(message.rules), frozenset(holders))
            for message, holders in newest_first
        ]
        self._rules = {each.message.rules: each.rules for each in sets}
        return sets

    def _parsed(self, text: str) -> tuple[Rule, ...]:
        if text not in self._rules:
            try:
                rules = parse_scenario(text, self._ids).rules
            except ScenarioError:  # of another version of this program
                rules = ()
            # Live rules begin at their origin, also those that in a file would hold from before the start.
            self._rules[text] = tuple(replace(rule, at=rule.at or 0.0) for rule in rules)
        return self._rules[text]


def shown(sets: Sequence[LiveSet], now_ns: int) -> list[str]:
    """What holds now of these sets, each on one line with its author."""
    return [f"live {line} ({each.message.author})" for each in sets for line in each.lines(now_ns)]


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
