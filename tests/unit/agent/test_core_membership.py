"""Robots join, leave and start again, and the formation changes, while the fleet drives."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, sqrt

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.formation.reference import Edge
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Beacon, HandState, Mission, Wrench
from handfast.agent.supervision.state_machine import State
from tests.hand_acceleration import hand_acceleration
from tests.unit.agent.fleet_bench import MISSION, PERIOD, FleetBench, three

PLACES = ((1, 0.0, 0.0), (2, 1.0, 0.0), (3, 0.0, 1.0))
EDGES = ((1, 2, 1.0), (2, 3, sqrt(2.0)), (1, 3, 1.0))
JOINED = (*PLACES, (4, 0.0, -1.0))
JOINED_EDGES = (*EDGES, (1, 4, 1.0), (2, 4, sqrt(2.0)))
BLEND_NS = 2 * NS_PER_S


def change(
    bench: FleetBench,
    version: int,
    robots: tuple[tuple[int, float, float], ...],
    edges: tuple[tuple[int, int, float], ...],
    ahead_ns: int = NS_PER_S // 2,
) -> Mission:
    """Another formation for a fleet that drives, said to all."""
    known = bench.sayings(MISSION)[0]
    assert isinstance(known, Mission)
    from_ns = bench.now // PERIOD * PERIOD + ahead_ns
    mission = known._replace(version=version, from_ns=from_ns, blend_ns=BLEND_NS, robots=robots, edges=edges)
    bench.say(MISSION, mission)
    return mission


@pytest.fixture
def bench() -> FleetBench:
    made = FleetBench(three())
    made.drive()
    made.run(6.0)
    return made


def edges(bench: FleetBench, robot: int) -> dict[int, Edge]:
    return {edge.other: edge for edge, _ in bench.agents[robot]._controller.edges}


def commands(bench: FleetBench, robot: int, seconds: float) -> list[tuple[float, float]]:
    """What is asked of a body in every tick meanwhile, as an acceleration of its hand; none may brake."""
    body, asked = bench.fleet.robot(robot), []
    for _ in range(round(seconds * NS_PER_S / PERIOD)):
        bench.step()
        wrench = bench.wrenches(robot)[-1]
        assert isinstance(wrench, Wrench)
        assert not wrench.brake
        asked.append(
            hand_acceleration(
                wrench.force,
                wrench.torque,
                bench.bodies[robot].pose,
                body.mass_kg,
                body.inertia_kgm2,
                body.hand_offset_m,
            )
        )
    return asked


def largest_step(asked: list[tuple[float, float]]) -> float:
    return max(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(asked))


# ---------------------------------------------------------------------- standing by


def test_a_robot_in_reserve_stands_by_and_tells_where_it_is(bench: FleetBench):
    agent = bench.agents[4]
    assert agent.condition == ("standby", "in reserve")
    assert all(wrench.brake for wrench in bench.wrenches(4) if isinstance(wrench, Wrench))
    assert not [key for key in agent.subscriptions if key.endswith("/hand")]
    told = [message for message in bench.sayings("few/robot/4/beacon") if isinstance(message, Beacon)]
    assert not told[-1].following
    assert told[-1].mission_version == 1  # it knows the mission all the same
    period_ns = told[-1].time_ns - told[-2].time_ns
    assert period_ns == NS_PER_S // 5


def test_a_reserve_is_no_reason_to_wait_for():
    bench = FleetBench(three())
    bench.cut = lambda key, _node: key.startswith("few/robot/4")
    bench.run(0.2)
    assert {bench.state(robot) for robot in (1, 2, 3)} == {State.READY}


# ---------------------------------------------------------------------- joining


def test_a_robot_joins_at_the_time_that_the_mission_says_and_not_before(bench: FleetBench):
    mission = change(bench, 2, JOINED, JOINED_EDGES)
    while bench.now < mission.from_ns - PERIOD:
        bench.step()
        assert bench.agents[4].condition == ("standby", "in reserve")
        assert edges(bench, 1).keys() == {2, 3}
    bench.run(0.1)
    assert bench.state(4) is State.RUNNING
    assert edges(bench, 1).keys() == {2, 3, 4}
    assert edges(bench, 4).keys() == {1, 2}
    assert edges(bench, 3).keys() == {1, 2}


def test_who_shares_an_edge_is_listened_to_from_then_on(bench: FleetBench):
    key = "few/robot/4/hand"
    assert key not in bench.agents[1].subscriptions
    before = bench.agents[1].subscriptions
    bench.step()
    assert bench.agents[1].subscriptions is before  # another object only when they change
    change(bench, 2, JOINED, JOINED_EDGES)
    bench.run(1.0)
    assert key in bench.agents[1].subscriptions
    assert key in bench.agents[2].subscriptions
    assert {"few/robot/1/hand", "few/robot/2/hand"} <= set(bench.agents[4].subscriptions)


@pytest.mark.slow
def test_new_edges_come_in_by_and_by_and_the_command_makes_no_jump(bench: FleetBench):
    change(bench, 2, JOINED, JOINED_EDGES)
    weights = []
    asked: list[tuple[float, float]] = []
    for _ in range(30):
        asked += commands(bench, 1, 0.1)
        weights.append(edges(bench, 1)[4].weight if 4 in edges(bench, 1) else 0.0)
    assert weights == sorted(weights)
    assert weights[0] == 0.0
    assert weights[-1] == 1.0
    assert max(b - a for a, b in pairwise(weights)) < 0.15
    assert largest_step(asked) < 0.02
    assert {bench.state(robot) for robot in (1, 2, 3)} == {State.RUNNING}


# ---------------------------------------------------------------------- leaving


@pytest.mark.slow
def test_a_robot_that_leaves_stands_by_and_is_let_go(bench: FleetBench):
    change(bench, 2, PLACES[:2], EDGES[:1])
    asked = commands(bench, 1, 1.5)
    assert bench.agents[3].condition == ("standby", "it has left the formation")
    last = bench.wrenches(3)[-1]
    assert isinstance(last, Wrench)
    assert last.brake
    assert edges(bench, 1).keys() == {2}
    assert largest_step(asked) < 0.03
    bench.run(20.0)  # until it is out of sight
    assert "few/robot/3/hand" not in bench.agents[1].subscriptions
    assert bench.state(1) is State.RUNNING


@pytest.mark.parametrize("off_ns", [PERIOD // 4, PERIOD // 2])
def test_a_mission_may_be_taken_over_at_any_time(bench: FleetBench, off_ns: int):
    """An operator's clock, and its program, need not know of the agents' ticks."""
    change(bench, 2, PLACES[:2], EDGES[:1], NS_PER_S // 2 + off_ns)
    bench.run(1.0)
    assert bench.state(3) is State.STANDBY


# ---------------------------------------------------------------------- another formation


@pytest.mark.slow
def test_another_formation_is_taken_over_by_all_without_a_jump(bench: FleetBench):
    wide = tuple((robot, 1.5 * x, 1.5 * y) for robot, x, y in PLACES)
    mission = change(bench, 2, wide, tuple((i, j, 1.5 * d) for i, j, d in EDGES))
    asked = commands(bench, 2, 4.0)
    # A quintic blend of D m within T s has a jerk of 60 D / T^3 at most.
    assert largest_step(asked) < 60.0 * 0.5 / (BLEND_NS / NS_PER_S) ** 3 * PERIOD / NS_PER_S
    assert {agent._situation.mission for agent in bench.agents.values()} == {mission}
    bench.run(15.0)
    (x1, y1), (x2, y2) = bench.position(1), bench.position(2)
    assert hypot(x2 - x1, y2 - y1) == pytest.approx(1.5, abs=0.03)


def test_a_mission_that_cannot_be_driven_is_refused_and_the_fleet_drives_on(bench: FleetBench):
    change(bench, 2, (*PLACES, (9, 5.0, 5.0)), EDGES)
    bench.run(1.0)
    assert {bench.state(robot) for robot in (1, 2, 3)} == {State.RUNNING}
    assert [
        agent._situation.mission.version for agent in bench.agents.values() if agent._situation.mission
    ] == [1] * 4
    assert all(agent.rejected["mission"] == 1 for agent in bench.agents.values())


def test_what_is_wrong_with_a_mission_is_told_by_who_waits_for_one():
    bench = FleetBench(three())
    bench.run(0.2)
    bench.say(MISSION, bench.mission(robots=(*PLACES, (9, 5.0, 5.0)), edges=EDGES))
    bench.run(0.1)
    state, reason = bench.agents[1].condition
    assert state == "ready"
    assert reason.startswith("the mission cannot be driven: robot 9 is not in the fleet")


# ---------------------------------------------------------------------- starting again


def test_who_missed_a_change_is_where_it_belongs_as_soon_as_it_is_told(bench: FleetBench):
    """A second late: from then on it follows the same blend as the others."""
    lost = {MISSION, *(key_expressions.relayed("few", robot) for robot in (1, 3, 4))}
    bench.cut = lambda key, node: key in lost and node is bench.agents[2]
    wide = tuple((robot, 1.5 * x, 1.5 * y) for robot, x, y in PLACES)
    mission = change(bench, 2, wide, tuple((i, j, 1.5 * d) for i, j, d in EDGES))
    while bench.now < mission.from_ns + NS_PER_S:
        bench.step()
    assert bench.agents[2]._situation.mission != mission
    bench.cut = lambda _key, _node: False
    bench.run(0.8)
    at_ns = bench.now
    one, other = (bench.agents[robot]._controller.reference for robot in (1, 2))
    assert bench.agents[2]._situation.mission == mission
    assert one.motion(2, at_ns) == other.motion(2, at_ns)
    hand = bench.sayings("few/robot/2/hand")[-1]
    assert isinstance(hand, HandState)
    assert hand.following
