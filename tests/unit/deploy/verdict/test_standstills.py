"""Who stood when nothing came: told apart by what agents count."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.fault_rules import FaultsSection, Rule
from handfast.agent.messages.types import HandState, PlantState, Status
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.standstills import Cause, machines, stalls, stood_alone
from tests.unit.deploy.silent_run import (
    ALL,
    BOTH,
    FROM_S,
    OF_AGENTS,
    ROUTED,
    STOOD,
    UNHEARD,
    UNTIL_S,
    paused,
    silent,
)
from tests.unit.deploy.synthetic_run import make_fleet

CAUSES = [
    (silent(ALL, counted=STOOD), Cause.MACHINE),
    (silent(ALL, fleet=ROUTED, counted=STOOD | UNHEARD), Cause.MACHINE),
    (silent(ALL, counted={"overruns": 30}), Cause.MACHINE),  # of before agents said for how long they stood
    (silent(ALL, fleet=ROUTED, counted=UNHEARD), Cause.ROUTER),
    (silent(ALL, fleet=ROUTED, counted=UNHEARD | {"overruns": 2, "stood_ms": 40}), Cause.ROUTER),
    (silent(ALL, counted=UNHEARD), Cause.NETWORK),
    (silent(ALL, fleet=ROUTED), Cause.RECORDING),
    (silent((PlantState, HandState), fleet=ROUTED), Cause.RECORDING),
    (silent((PlantState, HandState), fleet=ROUTED, waits=True), Cause.ROUTER),  # what waited there came then
    (silent((PlantState,), fleet=ROUTED, state="fault"), Cause.PLANTS),
]


@pytest.mark.parametrize(
    ("recording", "cause"), CAUSES, ids=[f"{k}-{c.name}" for k, (_, c) in enumerate(CAUSES)]
)
def test_the_cause_of_a_stall_is_what_agents_tell(recording: Recording, cause: Cause) -> None:
    (stall,) = stalls(recording)
    assert stall == ("", pytest.approx(FROM_S), pytest.approx(UNTIL_S), cause)
    assert stall.lasts_s == pytest.approx(UNTIL_S - FROM_S)
    assert stood_alone(recording) == []


def test_one_plant_that_says_nothing_or_what_is_paused_on_purpose_is_no_stall() -> None:
    assert stalls(silent(ALL, (1,))) == []
    assert stalls(silent(ALL, mode="simulate")) == []
    assert stalls(replace(silent(ALL), events=paused(1, "plant"))) == []


def test_an_agent_that_stood_alone_is_told_from_the_machine() -> None:
    (stand,) = stood_alone(silent(OF_AGENTS, (2,), counted=STOOD | {"overload.asked_ms": 200}))
    assert stand.robot == 2
    assert (stand.start_s, stand.end_s) == (pytest.approx(FROM_S), pytest.approx(UNTIL_S))
    assert stood_alone(silent(OF_AGENTS, counted=STOOD)) == [], "agents have more to do than plants"
    assert stood_alone(silent(ALL, (2,), counted=STOOD)) != []


def test_who_was_not_heard_or_was_made_to_stand_did_not_stand_of_its_own() -> None:
    assert stood_alone(silent(OF_AGENTS, (2,))) == []
    assert stood_alone(silent(OF_AGENTS, (2,), counted=STOOD, mode="simulate")) == []
    late = silent(OF_AGENTS, (2,), counted=STOOD)
    assert stood_alone(replace(late, events=paused(2, "agent"))) == []
    for jitter_s, explains in ((0.005, False), (0.2, False), (0.3, True)):
        rules = FaultsSection(rules=(Rule(tick_jitter=jitter_s),))
        assert (stood_alone(replace(late, fleet=replace(late.fleet, faults=rules))) == []) is explains
    of_other = FaultsSection(rules=(Rule(tick_jitter=0.3, robot=(1,)),))
    assert stood_alone(replace(late, fleet=replace(late.fleet, faults=of_other))) != []


@pytest.mark.parametrize(("froze", "is_machine"), [(5, False), (8, True)])
def test_a_third_of_the_agents_may_be_frozen_at_once_beside_a_machine_that_runs(
    froze: int, is_machine: bool
) -> None:
    fleet = make_fleet([(float(k), 0.0) for k in range(16)], [(1, 2)])
    ids = tuple(range(1, froze + 1))
    found = stood_alone(silent(OF_AGENTS, ids, fleet=fleet, counted=STOOD))
    assert [stand.robot for stand in found] == ([] if is_machine else [*ids])


def test_an_agent_that_starts_again_counts_anew() -> None:
    again = silent(OF_AGENTS, (2,), counted={"stood_ms": 1, "overruns": -1})
    assert stood_alone(again) == []


def test_machines_are_told_apart() -> None:
    recording = silent((Status,))
    assert machines(recording) == {"": [*BOTH]}
    robots = tuple(replace(robot, host=f"pi{robot.id}") for robot in recording.fleet.robots)
    apart = replace(recording, fleet=replace(recording.fleet, robots=robots))
    assert machines(apart) == {"pi1": [1], "pi2": [2]}
