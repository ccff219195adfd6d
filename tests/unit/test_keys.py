"""Keys: those of live faults and of links as documented, none twice, and what a token's key says."""

from __future__ import annotations

import pytest

from agent import keys


def test_keys_of_faults_and_links():
    assert keys.faults("delta") == "delta/faults"
    assert keys.faults_held("delta", 3, "agent") == "delta/robot/3/faults"
    assert keys.faults_held("delta", 3, "plant") == "delta/robot/3/plant/faults"
    assert keys.links("delta", 3) == "delta/robot/3/links"
    assert keys.plant_links("delta", "*") == "delta/robot/*/plant/links"


def test_keys_of_what_operators_say_to_plants_and_hear_of_them():
    assert keys.resume("delta") == "delta/resume"
    assert keys.checks("delta", 3) == "delta/robot/3/plant/checks"
    assert keys.checks("delta", "*") == "delta/robot/*/plant/checks"


def test_keys_of_what_a_fleet_says_to_all():
    assert keys.beacon("delta", 3) == "delta/robot/3/beacon"
    assert keys.beacon("delta", "*") == "delta/robot/*/beacon"
    assert keys.told("delta", 3) == "delta/robot/3/told"
    assert keys.heartbeat("delta") == "delta/heartbeat"
    assert keys.ask("delta") == "delta/ask"


def test_no_key_is_used_twice():
    by_robot = (
        keys.hand,
        keys.status,
        keys.plant_state,
        keys.plant_truth,
        keys.wrench,
        keys.links,
        keys.checks,
        keys.beacon,
        keys.told,
    )
    used = [key("delta", 3) for key in (*by_robot, keys.plant_links)]
    used += [keys.faults_held("delta", 3, role) for role in keys.ROLES]
    used += [keys.alive("delta", 3, role) for role in keys.ROLES]
    used += [
        keys.mission("delta"),
        keys.stop("delta"),
        keys.resume("delta"),
        keys.faults("delta"),
        keys.events("delta"),
        keys.heartbeat("delta"),
        keys.ask("delta"),
    ]
    assert len(set(used)) == len(used)


@pytest.mark.parametrize("role", keys.ROLES)
def test_a_token_names_its_process(role: str):
    assert keys.robot_of_alive(keys.alive("delta", 3, role)) == (3, role)


@pytest.mark.parametrize(
    "robot", ["", "x", "-3", "\N{SUPERSCRIPT TWO}", "\N{ARABIC-INDIC DIGIT THREE}", "9" * 5000]
)
def test_a_token_of_no_robot_is_not_one(robot: str):
    assert keys.robot_of_alive(keys.alive("delta", robot, "agent")) is None
