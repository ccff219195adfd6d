"""Whole fleets in virtual time: who was away or cut off when something was ordered ends like the others."""

from __future__ import annotations

from math import hypot

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message, Mission, Wrench
from handfast.agent.supervision.state_machine import State
from handfast.deploy.simulate.simulation import Simulation

SQUARE = """
[fleet]
name = "square"
rate_hz = 50
duration_s = 30

[formation]
edges = [[1, 2], [2, 3], [3, 4], [1, 4], [1, 3]]
offsets = [[0, 0], [1, 0], [1, 1], [0, 1]]
safe_distance_m = 0.2

[trajectory]
kind = "line"
velocity_mps = [0.2, 0.0]
"""
PLACES = {1: (0.0, 0.0), 2: (1.1, 0.0), 3: (1.0, 1.1), 4: (0.0, 1.0), 7: (-1.0, -1.0)}
for _robot, (_x, _y) in PLACES.items():
    SQUARE += f"\n[[robot]]\nid = {_robot}\nx_m = {_x}\ny_m = {_y}\n"
    if _robot == 7:
        SQUARE += "reserve = true\n"

JOIN = "kind = 'join'\nrobot = 7\nedges = [1, 2]\noffset_m = [0.5, -1.0]"


class Run:
    """One drive, with all that was said in it."""

    def __init__(self, *tables: str, overrides: tuple[str, ...] = ()) -> None:
        text = SQUARE + "".join(f"\n{table}\n" for table in tables)
        self.fleet: Fleet = resolved(parse_fleet(text, source="here", overrides=overrides))
        self.log: list[tuple[int, str, Message]] = []
        self.simulation = Simulation(self.fleet, self._sink)
        assert self.simulation.start(round(self.fleet.fleet.duration_s * NS_PER_S))

    def _sink(self, time_ns: int, key: str, payload: bytes) -> None:
        self.log.append((time_ns, key, decode(payload)))

    def until(self, time_s: float) -> Run:
        self.simulation.run_until(self.simulation.epoch_ns + round(time_s * NS_PER_S))
        assert not self.simulation.reasons
        return self

    def states(self) -> dict[int, State]:
        return {agent.robot: agent.state for agent in self.simulation.agents}

    def missions(self) -> set[Mission | None]:
        return {agent._situation.mission for agent in self.simulation.agents}

    def edges(self, robot: int) -> dict[int, float]:
        """Weights of its edges, by the other's id."""
        agent = next(agent for agent in self.simulation.agents if agent.robot == robot)
        return {edge.other: edge.weight for edge, _ in agent._controller.edges}

    def drives(self, robot: int, since_s: float, until_s: float) -> bool:
        """Whether any wrench of it meanwhile lets it drive."""
        key, epoch_ns = key_expressions.wrench("square", robot), self.simulation.epoch_ns
        return any(
            not message.brake
            for time_ns, on, message in self.log
            if on == key
            and isinstance(message, Wrench)
            and epoch_ns + since_s * NS_PER_S <= time_ns < epoch_ns + until_s * NS_PER_S
        )

    def distance(self, i: int, j: int) -> float:
        (xi, yi), (xj, yj) = (self.hand(robot) for robot in (i, j))
        return hypot(xi - xj, yi - yj)

    def hand(self, robot: int) -> tuple[float, float]:
        agent = next(agent for agent in self.simulation.agents if agent.robot == robot)
        here = agent._own_hand.here
        assert here is not None
        return here.x, here.y


def order(at_s: float, what: str) -> str:
    return f"[[order]]\nat = {at_s}\n{what}"


def rule(what: str) -> str:
    return f"[[faults.rule]]\n{what}"


def test_a_robot_of_the_reserve_joins_and_comes_to_its_place():
    run = Run(order(3.0, JOIN)).until(2.9)
    assert run.states()[7] is State.STANDBY
    run.until(28.0)
    assert set(run.states().values()) == {State.RUNNING}
    assert run.edges(7) == {1: 1.0, 2: 1.0}
    assert run.distance(7, 1) == pytest.approx(hypot(0.5, 1.0), abs=0.03)
    assert len(run.missions()) == 1


def test_a_robot_that_leaves_stays_behind_and_the_others_drive_on():
    run = Run(order(4.0, "kind = 'leave'\nrobot = 4")).until(20.0)
    states = run.states()
    assert states.pop(4) is State.STANDBY
    assert states.pop(7) is State.STANDBY
    assert set(states.values()) == {State.RUNNING}
    assert run.edges(1) == {2: 1.0, 3: 1.0}
    assert run.distance(1, 4) > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("robot", [1, 7])
def test_who_was_dead_when_a_robot_joined_knows_it_when_it_is_back(robot: int):
    away = rule(f"robot = {robot}\nat = 3\nfor = 4\nkill = 'both'")
    run = Run(order(5.0, JOIN), away).until(8.0)
    assert len(run.missions()) == 1
    assert run.edges(7).keys() == {1, 2}
    run.until(28.0)
    assert set(run.states().values()) == {State.RUNNING}
    assert run.distance(7, 2) == pytest.approx(hypot(0.5, 1.0), abs=0.03)


@pytest.mark.parametrize("role", ["agent", "plant", "both"])
def test_who_was_dead_when_a_stop_came_does_not_drive_when_it_is_back(role: str):
    away = rule(f"robot = 3\nat = 3\nfor = 3\nkill = '{role}'")
    run = Run(order(5.0, "kind = 'stop'"), away).until(12.0)
    stopped = dict.fromkeys(PLACES, State.STOPPED)
    assert run.states() == stopped
    assert not run.drives(3, 6.0, 12.0)
    assert not any(plant.condition[0] == "driving" for plant in run.simulation.plants)


def test_a_stop_is_over_only_with_the_leave_though_the_formation_changes_meanwhile():
    orders = (
        order(4.0, "kind = 'stop'"),
        order(6.0, "kind = 'reshape'\nscale = 1.5"),
        order(9.0, "kind = 'resume'"),
    )
    run = Run(*orders).until(8.9)
    assert set(run.states().values()) == {State.STOPPED}
    assert not any(run.drives(robot, 4.2, 9.0) for robot in (1, 2, 3, 4))
    run.until(28.0)
    assert run.distance(1, 2) == pytest.approx(1.5, abs=0.03)


def test_a_partition_leaves_nobody_with_another_mission_once_it_has_healed():
    """Hand states and beacons are cut for 4 s, and the formation changes meanwhile."""
    cut = rule("partition = '1,2 | 3,4'\nat = 4\nfor = 4")
    run = Run(order(5.0, "kind = 'reshape'\nscale = 1.4"), cut).until(7.9)
    assert State.DEGRADED in run.states().values()
    run.until(28.0)
    assert len(run.missions()) == 1
    states = run.states()
    states.pop(7)
    assert set(states.values()) == {State.RUNNING}
    assert run.distance(1, 2) == pytest.approx(1.4, abs=0.03)


@pytest.mark.slow
def test_a_dead_neighbour_is_seen_before_it_is_missed_and_replaced_by_the_reserve():
    away = rule("robot = 3\nat = 4\nkill = 'agent'")
    run = Run(order(8.0, "kind = 'replace'\nrobot = 3\nby = 7"), away).until(4.2)
    agent = run.simulation.agents[0]
    assert agent.condition == ("degraded", "without robot 3 (no connection to its agent)")
    run.until(28.0)
    assert [run.states()[robot] for robot in (1, 2, 4, 7)] == [State.RUNNING] * 4
    assert run.distance(7, 1) == pytest.approx(hypot(1.0, 1.0), abs=0.05)


def test_without_its_operator_a_fleet_with_a_dead_mans_switch_holds_and_goes_on():
    run = Run(overrides=("supervision.deadman_s=0.5",)).until(4.0)
    assert [run.states()[robot] for robot in (1, 2, 3, 4)] == [State.RUNNING] * 4
    run.simulation.attended = False
    run.until(5.0)
    assert [run.states()[robot] for robot in (1, 2, 3, 4)] == [State.HOLDING] * 4
    run.simulation.attended = True
    run.until(8.0)
    assert [run.states()[robot] for robot in (1, 2, 3, 4)] == [State.RUNNING] * 4


def test_who_starts_again_is_told_of_a_robot_that_nobody_hears_any_more():
    """Robot 3's agent dies for good; then 2's starts again, and could know of 3 from nobody else."""
    rules = [
        "[[faults.rule]]\nname = 'dead'\nrobot = 3\nat = 3\nkill = 'agent'",
        "[[faults.rule]]\nname = 'again'\nrobot = 2\nat = 5\nfor = 0.2\nkill = 'agent'",
    ]
    run = Run(*rules).until(5.9)
    known = run.simulation.agents[1]._peers.get(3).message
    there = run.simulation.plants[2]
    assert known is not None
    pose = there._backend.pose  # type: ignore[attr-defined]
    assert hypot(known.x - pose.x - 0.1, known.y - pose.y) < 0.15
    run.until(20.0)
    x, y = run.hand(2)
    assert hypot(x - pose.x - 0.1, y - pose.y) > 0.2
