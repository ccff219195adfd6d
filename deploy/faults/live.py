"""Which live fault rules hold on a running fleet, by what its agents and plants echo (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.scenario import ScenarioError, parse_scenario
from handfast.agent.links.fault_plan import AUTHORS_MAX, ENDED_MAX
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Faults, Message
from handfast.deploy.faults.wording import held, words

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
