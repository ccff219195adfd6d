"""Live fault rules that robots' recordings tell of: those of most count."""

from __future__ import annotations

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Faults
from handfast.agent.recorder.segments import Received
from handfast.deploy.merging import held_faults
from handfast.deploy.merging.held_faults import HeldFaults

RULES = '[[faults.rule]]\nloss = "50 %"\n'
SET = Faults(1, 1000, "ann", 900, 0, RULES)


def held(robot: int, message: Faults = SET, role: str = "agent") -> Received:
    return 5, key_expressions.faults_held("f", robot, role), encode(message)


def test_rules_that_most_hold_count_whenever_they_say_so() -> None:
    told = [held(1), held(2, SET._replace(time_ns=7)), held(2, SET._replace(author="eve"))]
    found = HeldFaults("f", (1, 2, 3), told)
    assert [found.made_up_by(*each[1:]) for each in told] == [None, None, 2]
    assert found.made_up_by(*held(3, SET._replace(time_ns=10))[1:]) is None
    assert found.made_up_by(*held(3, SET._replace(version=2))[1:]) == 3


def test_both_processes_of_one_robot_are_one_robot() -> None:
    found = HeldFaults("f", (1, 2, 3), [held(2), held(2, role="plant")])
    assert found.made_up_by(*held(2)[1:]) == 2


def test_other_messages_are_none_of_its() -> None:
    found = HeldFaults("f", (1, 2), [(5, key_expressions.hand("f", 1), b"x"), (5, "f/robot/1/faults", b"x")])
    assert found.made_up_by(key_expressions.hand("f", 2), b"x") is None
    assert found.made_up_by(key_expressions.faults_held("f", 2, "agent"), b"x") == 2


def test_so_many_sets_of_one_robot_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_faults, "SETS_MAX", 3)
    flood = [held(2, SET._replace(version=version)) for version in range(10, 20)]
    found = HeldFaults("f", (1, 2, 3), [*flood, held(1), held(3)])
    assert found.made_up_by(*held(1)[1:]) is None
    assert [found.made_up_by(*each[1:]) for each in flood] == [2] * 10
