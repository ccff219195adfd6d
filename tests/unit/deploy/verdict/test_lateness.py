"""Machines that were too slow are named, and what fault rules made of it is not theirs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule, TickJitter
from handfast.agent.messages.types import Event, Status
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.lateness import late_robots, warnings
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.judged_run import PAIR, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, messages


def late(skipped: int, mode: str = "run", more: tuple[tuple[str, int], ...] = (), **fleet: Any) -> Recording:
    sent = []
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        if type(message) is Status:
            message = message._replace(counters=(("overruns", skipped), *more))
        sent.append((received_ns, key, message))
    return recorded(replace(PAIR, **fleet), sent, mode)


def test_skipped_ticks_are_the_machines_and_fail_nothing() -> None:
    result = RunResult(late(30))
    ticks = sum(len(data.status.tick_us) for data in result.recording.robots.values())
    assert result.passed
    assert result.warnings == [
        f"Robots 1 and 2 skipped 60 of {ticks + 60} ticks though a tick takes 0.1 ms of 20 ms: the machine "
        "was too slow, or the agents were frozen."
    ]
    assert result.metrics["machine"] == {"late_robots": [1, 2]}
    assert warnings(late(3)) == []


def test_a_lower_rate_that_was_asked_for_is_named() -> None:
    more = ("overload.asked_ms", 1500), ("overload.level_1_ms", 500), ("overload.level_2_ms", 1200)
    recording = late(0, more=more)
    (text,) = warnings(recording)
    assert text.startswith("Robots 1 and 2 asked for a lower rate for up to 1.5 s though a tick takes 0.1 ms")
    assert RunResult(recording).metrics["overload_s"] == pytest.approx(1.7)
    assert "overload_s" not in RunResult(late(30)).metrics


def test_statuses_without_ticks_are_named_without_their_duration() -> None:
    recording = late(30)
    for robot, data in recording.robots.items():
        recording.robots[robot] = replace(data, status=replace(data.status, tick_us=data.status.tick_us[:0]))  # type: ignore[index]
    assert warnings(recording)[0].startswith("Robots 1 and 2 skipped 60 of 60 ticks of 20 ms: ")


def test_hosts_are_named() -> None:
    robots = tuple(replace(robot, host=f"pi{robot.id}") for robot in PAIR.robots)
    first, second = warnings(late(30, robots=robots))
    assert first.startswith("Robot 1 skipped 30 of ")
    assert ": host pi1 was too slow" in first
    assert ": host pi2 was too slow" in second


@pytest.mark.parametrize(
    ("rule", "explains"),
    [
        (Rule(tick_jitter=TickJitter(0.02)), True),
        (Rule(tick_jitter=TickJitter(0.019)), False),  # less than a period skips no tick
        (Rule(tick_jitter=TickJitter(0.02), robot=(3,)), False),
        (Rule(tick_jitter=TickJitter(0.02, 0.01)), False),
        (
            Rule(tick_jitter=TickJitter(0.02), at=1.0, duration=0.5),
            False,
        ),
    ],
)
def test_a_rule_explains_what_it_can_have_caused(rule: Rule, explains: bool) -> None:
    recording = late(30, faults=FaultsSection(rules=(rule,)))
    assert set(late_robots(recording)) == (set() if explains else {1, 2})


def test_an_agent_that_a_rule_paused_wakes_up_late() -> None:
    paused = Event(1, 0, EPOCH_NS - 10**9, "agent", "stop", "pause")
    assert set(late_robots(replace(late(30), events=(paused,)))) == {2}


def test_virtual_time_and_laws_of_plugins_are_no_machines() -> None:
    assert warnings(late(30, "simulate")) == []
    assert warnings(late(30, control=replace(PAIR.control, law="my:Law"))) == []
