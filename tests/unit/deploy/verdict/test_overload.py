"""Machines that were too slow for their robots are named as such."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Event, PlantState, Status
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.metrics import compute
from handfast.deploy.verdict.overload import _all_stall_words, explains, late_robots, slowed_s, warnings
from handfast.deploy.verdict.run_result import RunResult
from handfast.deploy.verdict.standstills import Cause, Stall
from tests.unit.deploy.judged_run import PAIR, recorded
from tests.unit.deploy.silent_run import ALL, OF_AGENTS, ROUTED, STOOD, UNHEARD, paused, silent
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages

SLOW = (
    "The machine that ran the fleet was too slow for its processes: robots 1 and 2 skipped 60 of 200 ticks, "
    "though a tick takes 0.1 ms of 20 ms. What came late of that is not the fleet's doing: other programs "
    "run there, or too many robots at this rate."
)


def late(skipped: int, mode: str = "run", **fleet: Any) -> Recording:
    sent = []
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        if type(message) is Status:
            message = message._replace(counters=(("overruns", skipped),))
        sent.append((received_ns, key, message))
    recording = recorded(PAIR, sent, mode)
    return replace(recording, fleet=replace(recording.fleet, **fleet))


def test_skipped_ticks_are_the_machines_and_fail_nothing() -> None:
    recording = late(30)
    ticks = sum(len(data.status.tick_us) for data in recording.robots.values())
    assert warnings(recording) == [SLOW.replace("of 200", f"of {ticks + 60}")]
    result = RunResult(recording)
    assert result.passed
    assert warnings(recording)[0] in result.warnings
    assert warnings(late(3)) == []


def test_a_machine_whose_robots_say_how_many_ticks_they_skipped_but_not_of_one_that_they_made() -> None:
    sent = []
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        if type(message) is Status:
            message = message._replace(counters=(("overruns", 30),), tick_us=())
        sent.append((received_ns, key, message))
    (text,) = warnings(recorded(PAIR, sent, "run"))
    assert "robots 1 and 2 skipped 60 of 60 ticks. What came late" in text


def test_metrics_tell_the_machine_from_the_fleet() -> None:
    assert RunResult(late(30)).metrics["machine"] == {"late_robots": [1, 2], "stood_still_s": 0.0}
    stood = silent(ALL, counted={"stood_ms": 600, "overruns": 3})
    assert RunResult(stood).metrics["machine"] == {"late_robots": [], "stood_still_s": 0.6}
    assert RunResult(gap(1, 2)).metrics["machine"] == {"late_robots": [], "stood_still_s": 0.0}
    assert RunResult(gap(1)).metrics["machine"] == {"late_robots": [], "stood_still_s": 0.0}


def test_a_machine_that_had_the_fleet_fall_to_a_lower_rate_is_named() -> None:
    """Few ticks are skipped then, for the rate is one that it keeps."""
    sent = []
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        if type(message) is Status:
            counted = ("overload.late", 7), ("overload.asked_ms", 1500 if message.robot == 1 else 0)
            spent = ("overload.level_1_ms", 500), ("overload.level_2_ms", 1200)
            message = message._replace(counters=(("overruns", 1), *counted, *spent))
        sent.append((received_ns, key, message))
    recording = recorded(PAIR, sent, "run")
    (text,) = warnings(recording)
    assert ": robot 1 skipped 1 of " in text
    assert (
        " and had the fleet fall to a lower rate, for up to 1.5 s, though a tick takes 0.1 ms of 20 ms."
        in text
    )
    assert slowed_s(recording) == pytest.approx(1.7)
    result = RunResult(recording)
    assert result.passed
    assert compute(result)["overload_s"] == pytest.approx(1.7)
    assert "overload_s" not in compute(RunResult(late(30)))


def test_hosts_are_named() -> None:
    recording = late(30)
    robots = tuple(replace(robot, host=f"pi{robot.id}") for robot in recording.fleet.robots)
    first, second = warnings(replace(recording, fleet=replace(recording.fleet, robots=robots)))
    assert first.startswith("Host pi1 was too slow for its processes: robot 1 skipped 30 of ")
    assert second.startswith("Host pi2 was too slow for its processes: robot 2 skipped 30 of ")


def test_who_is_made_late_or_is_slow_itself_is_no_matter_of_the_machine() -> None:
    assert warnings(late(30, "simulate")) == []
    assert warnings(late(30, control=replace(PAIR.control, law="my:Law"))) == []
    assert warnings(late(30, faults=FaultsSection(rules=(Rule(tick_jitter=0.02),)))) == []
    paused = Event(1, 0, EPOCH_NS - 10**9, "agent", "stop", "pause")
    (text,) = warnings(replace(late(30), events=(paused,)))
    assert ": robot 2 skipped 30 of " in text


def test_what_made_agents_a_little_late_does_not_hide_a_slow_machine() -> None:
    """No tick is skipped for a jitter of less than a period, and of other robots nothing is."""
    for rule in (
        Rule(tick_jitter=0.019),
        Rule(tick_jitter=0.02, robot=(3,)),
        Rule(tick_jitter=0.02, tick_jitter_share=0.01),
    ):
        assert late_robots(late(30, faults=FaultsSection(rules=(rule,)))) == {1, 2}


def test_few_skipped_ticks_explain_no_failure() -> None:
    recording = late(3)
    for data in recording.robots.values():
        for counters in data.status.counters:
            counters["overload.asked_ms"] = 100  # type: ignore[index]
    assert late_robots(recording) == {1, 2}
    (text,) = warnings(recording)
    assert "robots 1 and 2 skipped 6 of " in text
    assert explains(recording) == []


def test_a_machine_that_made_nobody_skip_a_tick_is_told_without_any() -> None:
    recording = late(0)
    for data in recording.robots.values():
        for counters in data.status.counters:
            counters["overload.asked_ms"] = 900  # type: ignore[index]
    (text,) = warnings(recording)
    assert ": robots 1 and 2 had the fleet fall to a lower rate, for up to 0.9 s, though a tick" in text
    (text,) = explains(recording)
    assert text.startswith("The machine was too slow: 2 of 2 robots had the fleet fall to a lower rate, for")


def gap(
    *ids: int, from_s: float = 0.8, until_s: float = 1.4, fleet: Fleet = PAIR, skipped: int = 0
) -> Recording:
    sent = [
        (received_ns, key, message._replace(counters=(("overruns", skipped),)))
        if type(message) is Status
        else (received_ns, key, message)
        for received_ns, key, message in messages(fleet, in_formation(fleet))
    ]
    return recorded(
        fleet,
        [
            each
            for each in sent
            if not (
                type(each[2]) is PlantState
                and each[2].robot in ids
                and from_s < (each[2].time_ns - EPOCH_NS) / 1e9 < until_s
            )
        ],
    )


def test_a_machine_that_stood_still_is_named_and_lacks_no_poses() -> None:
    result = RunResult(silent(ALL, counted={"stood_ms": 600, "overruns": 3}))
    assert result.passed
    assert result.warnings == [
        "The machine that ran the fleet stood still from 0.80 s to 1.40 s: none of its robots sent a pose. "
        "That is not the fleet's doing."
    ]


def test_where_robots_went_on_while_no_pose_came_of_them_it_was_not_their_machine() -> None:
    result = RunResult(silent(ALL, fleet=ROUTED, counted=UNHEARD))
    assert result.passed
    assert result.warnings == [
        "No pose came of the robots from 0.80 s to 1.40 s: their router passed nothing on, while their "
        "agents ran."
    ]
    (text,) = warnings(silent(ALL, fleet=ROUTED))
    assert text.endswith(
        "the program that records heard nothing, while their agents ran and heard each other."
    )


def test_an_agent_that_stood_alone_is_not_its_machine() -> None:
    """Though it skipped more than a machine that is named may."""
    recording = silent(OF_AGENTS, (2,), counted=STOOD | {"overload.asked_ms": 200})
    assert warnings(recording) == [
        "The agent of robot 2 stood still for 0.6 s from 0.8 s on, while its machine ran: it was frozen, or "
        "starved."
    ]
    assert late_robots(recording) == frozenset()
    (text,) = warnings(silent(OF_AGENTS, counted=STOOD))
    assert text.startswith("The machine that ran the fleet was too slow"), "both stood at once"


def test_agents_that_stood_at_the_same_time_share_a_sentence() -> None:
    """Two of 16 are not their machine."""
    fleet = make_fleet([(float(k), 0.0) for k in range(16)], [(1, 2)])
    (text,) = warnings(silent(OF_AGENTS, fleet=fleet, counted=STOOD))
    assert text == (
        "The agents of robots 1 and 2 stood still for 0.6 s from 0.8 s on, while their machine ran: they "
        "were frozen, or starved."
    )


def test_a_machine_that_runs_late_is_named_beside_an_agent_that_stood_alone() -> None:
    recording = silent(OF_AGENTS, (2,), counted={"stood_ms": 600, "overruns": 30, "overload.asked_ms": 200})
    for counters in recording.robots[1].status.counters:
        counters["overruns"] = 30  # type: ignore[index]
    assert late_robots(recording) == {1}
    assert len(warnings(recording)) == 2


def test_what_stood_is_said_before_much_that_failed() -> None:
    assert explains(silent(ALL, fleet=ROUTED, counted=UNHEARD)) == [
        "For 0.6 s no pose came of any robot: their router passed nothing on, while their agents ran. "
        "What follows may come of that alone."
    ]
    assert explains(silent(ALL, (1,))) == []
    (text,) = explains(silent(ALL, counted=STOOD))
    assert text.startswith(
        "The machine was too slow: 2 of 2 robots skipped 62 of 242 ticks, and 0.6 s none could"
    )


def test_plants_that_hang_fail_as_one_does() -> None:
    (reason,) = RunResult(silent((PlantState,), state="fault")).reasons
    assert reason == (
        "The data are incomplete: no pose came of robots 1 and 2 for up to 0.6 s: their plants stood still, "
        "while their agents ran; one of them may have come within 0.00 m of robot 2 (safe distance 0.22 m)."
    )


def test_one_plant_that_sends_nothing_is_no_machine() -> None:
    assert not RunResult(gap(1)).passed


def test_plants_that_are_paused_on_purpose_are_no_machine() -> None:
    recording = replace(gap(1, 2), events=(*paused(1, "plant"), *paused(2, "plant")))
    assert [each.split(":")[0] for each in RunResult(recording).warnings] == [
        "Rule 'freeze' stopped robot 1's plant", "Rule 'freeze' stopped robot 2's plant",
    ]  # fmt: skip


def moving(speed_mps: float) -> Fleet:
    return make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], velocity=(speed_mps, 0.0))


def test_poses_that_a_slow_machine_lost_are_a_warning_where_nothing_can_have_happened() -> None:
    result = RunResult(gap(1, fleet=moving(0.1), skipped=30))
    assert result.passed
    assert any("for its machine was too slow: it moved 0.06 m meanwhile." in each for each in result.warnings)
    (reason,) = RunResult(gap(1, fleet=moving(0.1))).reasons
    share = "The data are incomplete: in 30 % of the drive robot 1 sent no pose, where 20 % is allowed;"
    assert reason == f"{share} for longest from 0.80 s to 1.40 s."
    (reason,) = RunResult(gap(1, fleet=moving(1.0), skipped=30)).reasons
    assert reason == f"{share} for longest from 0.80 s to 1.40 s, for its machine was too slow."


def test_what_a_machine_that_stood_still_hides_may_be_what_it_broke() -> None:
    assert not RunResult(gap(1, 2, fleet=moving(1.0))).passed
    assert RunResult(gap(1, 2, fleet=moving(0.1))).passed


def test_what_stood_many_times_is_one_sentence() -> None:
    """As under busy loops beside it: not fifty that differ by their times."""
    stands = [Stall("", 2.0 * k, 2.0 * k + 0.1 * k, Cause.MACHINE) for k in range(6, 12)]
    router = Stall("", 30.0, 31.0, Cause.ROUTER)
    many, one = _all_stall_words([*stands, router])
    assert many == (
        "The machine that ran the fleet stood still 6 times from 12.00 s to 23.10 s, for up to 1.1 s and "
        "5.1 s together: none of its robots sent a pose. That is not the fleet's doing."
    )
    assert one.startswith("No pose came of the robots from 30.00 s to 31.00 s: ")
    assert len(_all_stall_words(stands[:3])) == 3
