"""Lanes of the rules of a run, and the plan of what rules do to processes."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import parse_scenario
from handfast.deploy.faults.process_actions import Action, actions
from handfast.deploy.faults.rules import lanes
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from tests.unit.deploy.simulated_run import driven, trio


def recorded(faults: str) -> Recording:
    fleet = trio(faults)
    data = RunData(fleet)
    for sent in driven(fleet):
        data.feed(*sent)
    return data.recording()


def test_every_rule_has_a_lane_and_what_holds_everywhere_comes_first() -> None:
    many = "".join(
        f'[[faults.rule]]\nname = "r{k}"\nlink = "1->2"\nloss = "9%"\nat = {k / 10}\nfor = 0.05\n'
        for k in range(12)
    )
    found = lanes(recorded('[faults]\ndelay = "1ms"\n' + many), 2.0)
    assert [lane.text for lane in found] == [
        "[faults]: delay 1ms on every link",
        *(f"r{k}: loss 9% on 1->2" for k in range(12)),
    ]
    assert found[0].times == [(0.0, 2.0)]
    assert found[1].times == [(0.0, 0.05)]


def test_a_run_without_faults_has_no_lane() -> None:
    assert lanes(recorded(""), 2.0) == []


IDS = (1, 2, 3)


def planned(text: str, end: float = 100.0) -> list[Action]:
    return actions(parse_scenario(text, IDS).rules, IDS, end)


def short(plan: list[Action]) -> list[str]:
    return [f"{each.time_s:g} {each.robot} {each.role} {each.what}" for each in plan]


def rule(more: str, name: str = "x") -> str:
    return f'[[faults.rule]]\nname = "{name}"\n{more}\n'


def test_kill_for_a_while_starts_again() -> None:
    plan = planned(rule('robot = 2\nkill = "agent"\nat = 5\nfor = 3', "crash"))
    assert plan == [Action(5.0, 2, "agent", "kill", "crash"), Action(8.0, 2, "agent", "start", "crash")]


def test_kill_without_an_end_is_for_good() -> None:
    assert short(planned(rule('robot = 2\nkill = "plant"\nat = 5'))) == ["5 2 plant kill"]


def test_both_means_agent_and_plant_of_every_robot_named() -> None:
    assert short(planned(rule('robot = [1, 3]\npause = "both"\nat = 1\nfor = 2'))) == [
        "1 1 agent stop",
        "1 1 plant stop",
        "1 3 agent stop",
        "1 3 plant stop",
        "3 1 agent continue",
        "3 1 plant continue",
        "3 3 agent continue",
        "3 3 plant continue",
    ]


def test_restart_is_kill_and_start_at_once() -> None:
    assert short(planned(rule('robot = 1\nrestart = "agent"\nat = 4'))) == [
        "4 1 agent kill",
        "4 1 agent start",
    ]


def test_a_disk_goes_with_the_process_that_is_killed() -> None:
    plan = planned(rule('robot = 2\nkill = "agent"\nat = 5\nfor = 3\nwipe = true', "card"))
    assert [(each.what, each.wipe) for each in plan] == [("kill", True), ("start", False)]
    plan = planned(rule('robot = 2\nrestart = "both"\nat = 5\nwipe = true'))
    assert [each.wipe for each in plan if each.what == "kill"] == [True, True]
    assert not any(each.wipe for each in planned(rule('robot = 2\nrestart = "both"\nat = 5')))


def test_every_comes_again_until_its_end() -> None:
    text = rule('robot = 1\npause = "plant"\nat = 1\nfor = "500ms"\nevery = 2\nuntil = 5.2')
    assert short(planned(text)) == [
        "1 1 plant stop",
        "1.5 1 plant continue",
        "3 1 plant stop",
        "3.5 1 plant continue",
        "5 1 plant stop",
        "5.2 1 plant continue",
    ]


@pytest.mark.parametrize("end", [5.0, 6.0, 8.0])
def test_nothing_is_planned_for_the_end_or_later(end: float) -> None:
    plan = planned(rule('robot = 2\nkill = "agent"\nat = 5\nfor = 3'), end)
    assert short(plan) == (["5 2 agent kill"] if end > 5.0 else [])


def test_overlapping_kills_are_one() -> None:
    one = rule('robot = 1\nkill = "agent"\nat = 2\nfor = 4', "one")
    other = rule('robot = 1\nkill = "both"\nat = 5\nfor = 4', "other")
    assert planned(one + other) == [
        Action(2.0, 1, "agent", "kill", "one"),
        Action(5.0, 1, "plant", "kill", "other"),
        Action(9.0, 1, "agent", "start", "other"),
        Action(9.0, 1, "plant", "start", "other"),
    ]


def test_a_kill_that_follows_at_once_leaves_it_down() -> None:
    text = rule('robot = 1\nkill = "agent"\nat = 2\nfor = 2', "a") + rule(
        'robot = 1\nkill = "agent"\nat = 4\nfor = 2', "b"
    )
    assert short(planned(text)) == ["2 1 agent kill", "6 1 agent start"]


def test_restart_of_what_is_down_does_nothing() -> None:
    text = rule('robot = 1\nkill = "agent"\nat = 2\nfor = 4', "a") + rule(
        'robot = 1\nrestart = "agent"\nat = 3', "b"
    )
    assert short(planned(text)) == ["2 1 agent kill", "6 1 agent start"]


def test_what_starts_within_a_pause_is_paused() -> None:
    text = rule('robot = 1\npause = "agent"\nat = 1\nfor = 9', "a") + rule(
        'robot = 1\nkill = "agent"\nat = 2\nfor = 4', "b"
    )
    assert short(planned(text)) == [
        "1 1 agent stop",
        "2 1 agent kill",
        "6 1 agent start",
        "6 1 agent stop",
        "10 1 agent continue",
    ]


def test_a_pause_that_ends_while_it_is_down_continues_nothing() -> None:
    text = rule('robot = 1\npause = "agent"\nat = 1\nfor = 2', "a") + rule(
        'robot = 1\nkill = "agent"\nat = 2\nfor = 4', "b"
    )
    assert short(planned(text)) == ["1 1 agent stop", "2 1 agent kill", "6 1 agent start"]


def test_rules_without_a_process_order_nothing() -> None:
    assert planned(rule('link = "1->2"\nloss = "30%"\nat = 1')) == []
