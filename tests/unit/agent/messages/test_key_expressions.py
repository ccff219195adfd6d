"""Keys: those of live faults and of links as documented, none twice, and what a token's key says."""

from __future__ import annotations

import pytest

from handfast.agent.messages import key_expressions


def test_keys_of_faults_and_links():
    assert key_expressions.faults("delta") == "delta/faults"
    assert key_expressions.faults_held("delta", 3, "agent") == "delta/robot/3/faults"
    assert key_expressions.faults_held("delta", 3, "plant") == "delta/robot/3/plant/faults"
    assert key_expressions.links("delta", 3) == "delta/robot/3/links"
    assert key_expressions.plant_links("delta", "*") == "delta/robot/*/plant/links"


def test_keys_of_what_operators_say_to_plants_and_hear_of_them():
    assert key_expressions.resume("delta") == "delta/resume"
    assert key_expressions.checks("delta", 3) == "delta/robot/3/plant/checks"
    assert key_expressions.checks("delta", "*") == "delta/robot/*/plant/checks"


def test_keys_of_what_a_fleet_says_to_all():
    assert key_expressions.beacon("delta", 3) == "delta/robot/3/beacon"
    assert key_expressions.beacon("delta", "*") == "delta/robot/*/beacon"
    assert key_expressions.relayed("delta", 3) == "delta/robot/3/told"
    assert key_expressions.heartbeat("delta") == "delta/heartbeat"
    assert key_expressions.ask("delta") == "delta/ask"


def test_no_key_is_used_twice():
    by_robot = (
        key_expressions.hand,
        key_expressions.status,
        key_expressions.plant_state,
        key_expressions.plant_truth,
        key_expressions.wrench,
        key_expressions.links,
        key_expressions.checks,
        key_expressions.beacon,
        key_expressions.relayed,
    )
    used = [key("delta", 3) for key in (*by_robot, key_expressions.plant_links)]
    used += [key_expressions.faults_held("delta", 3, role) for role in key_expressions.ROLES]
    used += [key_expressions.alive("delta", 3, role) for role in key_expressions.ROLES]
    used += [
        key_expressions.mission("delta"),
        key_expressions.stop("delta"),
        key_expressions.resume("delta"),
        key_expressions.faults("delta"),
        key_expressions.events("delta"),
        key_expressions.heartbeat("delta"),
        key_expressions.ask("delta"),
    ]
    assert len(set(used)) == len(used)


@pytest.mark.parametrize("role", key_expressions.ROLES)
def test_a_token_names_its_process(role: str):
    assert key_expressions.robot_of_alive(key_expressions.alive("delta", 3, role)) == (3, role)


@pytest.mark.parametrize(
    "robot", ["", "x", "-3", "\N{SUPERSCRIPT TWO}", "\N{ARABIC-INDIC DIGIT THREE}", "9" * 5000]
)
def test_a_token_of_no_robot_is_not_one(robot: str):
    assert key_expressions.robot_of_alive(key_expressions.alive("delta", robot, "agent")) is None


def test_what_one_robot_says_is_heard_by_who_listens_to_any():
    for key in (key_expressions.hand, key_expressions.wrench, key_expressions.checks):
        assert key_expressions.of_any_robot(key("two", 7)) == key("two", "*")
    assert key_expressions.of_any_robot(key_expressions.stop("two")) == "two/stop"
