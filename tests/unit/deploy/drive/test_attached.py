"""Processes of others, seen by their tokens: whose connection is lost, and what the verdict is told."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.messages.key_expressions import ROLES
from handfast.deploy.drive.attached import Attached
from handfast.deploy.faults.process_actions import Action
from tests.unit.agent.fleet.test_hosts import fleet as hosts_fleet
from tests.unit.deploy.orders.order_fleets import square

FLEET = square()
ALL = frozenset((robot, role) for robot in FLEET.ids for role in ROLES)
AGENT = 2, "agent"


def there() -> Attached:
    made = Attached(FLEET)
    assert made.look(frozenset(), None) == []
    assert not made.up(*AGENT)
    assert made.look(ALL, None) == []  # that they come at first is no news
    return made


def test_who_goes_and_comes_back_is_said_and_warned_of() -> None:
    made = there()
    assert made.names[AGENT] == "robot 2's agent"
    assert made.look(ALL - {AGENT}, 5.04) == ["5.0 s: no connection to robot 2's agent"]
    assert not made.up(*AGENT)
    assert made.look(ALL - {AGENT}, 6.0) == []
    assert made.lacking(FLEET.ids) == ["No connection to robot 2's agent since 5.0 s."]
    assert made.look(ALL, 7.25) == ["7.2 s: connected again: robot 2's agent"]
    assert made.up(*AGENT)
    assert made.lacking(FLEET.ids) == []
    assert made.warnings == ["No connection to robot 2's agent from 5.0 s to 7.2 s"]


def test_who_has_no_place_any_more_is_a_warning() -> None:
    made = there()
    made.look(ALL - {AGENT}, 5.0)
    assert made.lacking([1, 3, 4]) == []
    assert made.warnings == [
        "No connection to robot 2's agent since 5.0 s; it has no place in the formation any more"
    ]


def test_they_are_left_as_they_are() -> None:
    made = there()
    assert not made.ours
    assert not made.carry_out(Action(1.0, 2, "agent", "kill", "x"), None)
    assert made.deaths() == ()
    made.resume_all()
    assert made.up(*AGENT)


@pytest.mark.parametrize("records", [True, False])
def test_who_may_have_driven_on_unheard_is_told_where_that_is_recorded(records: bool) -> None:
    fleet = hosts_fleet()
    made = Attached(replace(fleet, recording=replace(fleet.recording, max_mb=20 if records else 0)))
    everybody = frozenset(made.names)
    made.look(everybody, None)
    made.look(frozenset(), -1.0)  # before the drive
    made.look(everybody, -0.5)
    made.look(everybody - {(1, "agent"), (2, "agent")}, 3.0)
    made.look(everybody, 4.0)
    before = len(made.warnings)
    assert before == 2
    made.look(everybody - {(2, "agent")}, 5.0)
    made.look(everybody - {(2, "agent"), (2, "plant")}, 5.1)
    made.look(everybody, 6.0)
    told = [warning for warning in made.warnings if "fetch" in warning]
    assert told == records * [
        "Nothing could be heard of robot 2 for a while: if only this machine was cut off, they drove on, and "
        "`handfast fetch` has what they recorded"
    ]
