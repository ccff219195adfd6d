"""A rule that a page sets holds for its time, with a lease, and is healed; what is none is refused."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import nan
from typing import Any

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import EVERY_AUTHOR, Faults
from handfast.deploy.session.faults import (
    AFTER_END_NS,
    ECHO_S,
    LEASE_NS,
    ORIGIN_AHEAD_NS,
    SEND_PERIOD_NS,
)
from handfast.deploy.view.faults import FaultUnderWay, HealUnderWay, LiveFaults
from handfast.deploy.view.orders import RefusedError, UnderWay
from tests.unit.deploy.orders.order_fleets import S
from tests.unit.deploy.view.running import NAME, Running

RULE = {"link": "1<->2", "loss": "30%", "for": "4s"}


class Faulty:
    """Live rules of a fleet whose processes do what they are told."""

    def __init__(self, running: Running) -> None:
        self.running = running
        self.faults = LiveFaults(running.state, running.bus)
        running.live.listeners.append(self.faults.feed)
        self.deaf: set[tuple[int, str]] = set()
        self.held: dict[str, Faults] = {}
        self._taken = 0

    def said(self) -> list[Faults]:
        return self.running.of(Faults)

    def step(self, *under_way: UnderWay, after_ns: int = S // 10) -> None:
        """Processes take what was said, and say what they hold."""
        said = self.said()
        for message in said[self._taken :]:
            if message.author == EVERY_AUTHOR:
                self.held = {
                    author: each._replace(version=message.version, rules="")
                    for author, each in self.held.items()
                }
            elif self.held.get(message.author, message).version <= message.version:
                self.held[message.author] = message
        self._taken = len(said)
        for receiver in self.faults.receivers:
            if receiver not in self.deaf:
                for message in self.held.values():
                    self.running.bus.put(key_expressions.faults_held(NAME, *receiver), message)
        self.running.step(after_ns)
        for each in under_way:
            if not each.is_over:
                each.step(self.running.clock.ns)


@pytest.fixture
def faulty() -> Iterator[Faulty]:
    with Running() as running:
        running.come()
        running.step()
        yield Faulty(running)


def fault(faulty: Faulty, **fields: Any) -> FaultUnderWay:
    return FaultUnderWay(faulty.faults, {"rule": {**RULE, **fields}})


# ---------------------------------------------------------------------- what is a rule


@pytest.mark.parametrize(
    "rule",
    [
        None,
        [],
        "loss",
        {},
        {"loss": "30%"},
        {**RULE, "kill": "agent"},
        {**RULE, "name": "x"},
        {**RULE, "at": "0s"},
        {**RULE, "for": "inf"},
        {**RULE, "for": "1e400s"},
        {**RULE, "for": None},
        {**RULE, "for": -1},
        {**RULE, "for": nan},
        {**RULE, "loss": "130%"},
        {**RULE, "loss": {}},
        {**RULE, "loss": [1, 2]},
        {**RULE, "loss": '1"\nkill = "agent"'},
        {**RULE, "link": "1->9"},
        {**RULE, "link": ""},
        {**RULE, "robot": 99},
        {**RULE, "delay": "soon"},
        {**RULE, "delay": "9" * 10_000},
        {"link": "1->2", "for": "4s"},
    ],
)
def test_what_is_no_rule_is_refused_and_not_said(faulty: Faulty, rule: Any) -> None:
    with pytest.raises(RefusedError) as caught:
        FaultUnderWay(faulty.faults, {"rule": rule})
    assert "\n" not in str(caught.value)
    assert faulty.said() == []


# ---------------------------------------------------------------------- for its time


def test_a_rule_is_sent_again_with_its_lease_and_healed_at_its_end(faulty: Faulty) -> None:
    given = fault(faulty)
    begun_ns = faulty.running.clock.ns
    (first,) = faulty.said()
    assert first.lease_ns == LEASE_NS
    assert "loss" in first.rules
    assert given.what == "loss 30% on 1->2; 2->1"
    assert (given.count, given.done, given.is_over) == ((0, 12), False, False)
    assert given.lines()[0].startswith("not held by robot 1's agent and plant, ")
    while all(each.rules for each in faulty.said()):
        faulty.step(given)
        if faulty.running.clock.ns - begun_ns > S:
            assert given.count == (12, 12)
            assert given.lines() == []
            assert not given.is_over
        assert faulty.running.clock.ns - begun_ns < 10 * S
    *said, healing = faulty.said()
    lasted_ns = ORIGIN_AHEAD_NS + 4 * S + AFTER_END_NS
    assert healing.time_ns - begun_ns == pytest.approx(lasted_ns, abs=S // 5)
    assert len(said) == pytest.approx(lasted_ns / SEND_PERIOD_NS, abs=2)
    assert {(each.author, each.version, each.origin_ns, each.rules) for each in said} == {
        (first.author, first.version, first.origin_ns, first.rules)
    }
    assert max(b.time_ns - a.time_ns for a, b in pairwise(said)) < LEASE_NS / 2
    assert (healing.author, healing.rules) == (first.author, "")
    assert healing.version > first.version
    assert not given.is_over
    faulty.step(given)
    faulty.step(given)
    assert (given.is_over, given.done, given.lines()) == (True, True, [])
    assert faulty.said()[-1] == healing


def test_who_has_not_taken_a_rule_is_named(faulty: Faulty) -> None:
    faulty.deaf = {(3, "agent"), (3, "plant")}
    given = fault(faulty)
    for _ in range(10):
        faulty.step(given)
    assert (given.count, given.lines()) == ((10, 12), ["not held by robot 3's agent and plant"])
    for _ in range(50):
        faulty.step(given)
    assert (given.is_over, given.done) == (True, False)


def test_who_does_not_say_that_it_is_healed_is_named(faulty: Faulty) -> None:
    given = fault(faulty)
    while all(each.rules for each in faulty.said()):
        faulty.step(given)
    faulty.deaf = {(2, "plant")}
    healed_ns = faulty.running.clock.ns
    while not given.is_over:
        faulty.step(given)
    assert faulty.running.clock.ns - healed_ns == pytest.approx(ECHO_S * S, abs=S // 4)
    assert not given.done
    assert given.lines() == ["not heard to be healed: robot 2's plant; the lease ends in 2 s"]


# ---------------------------------------------------------------------- healed


def test_all_links_are_healed_whoever_set_the_rules(faulty: Faulty) -> None:
    given = fault(faulty)
    now_ns = faulty.running.clock.ns
    other = Faults(2**50, now_ns, "somebody", now_ns, 0, faulty.said()[0].rules)
    faulty.held["somebody"] = other
    for _ in range(5):
        faulty.step(given)
    heal = HealUnderWay(faulty.faults)
    said = faulty.said()[-1]
    assert (said.author, said.rules) == (EVERY_AUTHOR, "")
    assert said.version > max(each.version for each in faulty.held.values())
    assert (heal.count, heal.done, heal.is_over) == ((0, 12), False, False)
    assert heal.lines()[0].startswith("not heard to be healed: robot 1's agent and plant, ")
    faulty.step(given, heal)
    assert (heal.count, heal.done, heal.is_over, heal.lines()) == ((12, 12), True, True, [])
    while not given.is_over:
        faulty.step(given)
    assert (given.done, given.lines()) == (True, ["healed"]), "it was ended from here, as meant"
