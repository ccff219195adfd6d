"""What agents and neighbours make of a rover that is taken, lost or killed: three rovers in virtual time."""

from __future__ import annotations

from itertools import pairwise
from math import cos, hypot, sin
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.core import Agent
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import HandState, PlantState, Resume, Status, Stop, Wrench
from handfast.agent.supervision.state_machine import State
from handfast.bridges.mavlink.ardupilot import frames
from handfast.bridges.mavlink.ardupilot.frames import datum_of
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE
from handfast.bridges.mavlink.simulator.in_memory import SimulatedRoverPlant
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.deploy.simulate.simulation import Simulation
from tests.rover_fleet import three

BRAKES_S = 0.3


class Run:
    """A mission of three rovers, and everything that was said in it."""

    def __init__(self, *overrides: str, rules: tuple[str, ...] = (), duration_s: float = 600.0) -> None:
        self.fleet = three(*overrides, rules=rules)
        self.name = self.fleet.fleet.name
        self.said: list[tuple[int, str, Any]] = []
        self.simulation = Simulation(
            self.fleet, lambda at, key, data: self.said.append((at, key, decode(data)))
        )
        assert self.simulation.start(round(duration_s * NS_PER_S)), self.simulation.reasons

    def _hear(self, time_ns: int, key: str, payload: bytes) -> None:
        self.said.append((time_ns, key, decode(payload)))

    @property
    def now_ns(self) -> int:
        return self.simulation.now_ns

    def body(self, robot: int) -> SimulatedRoverPlant:
        """The bridge and vehicle that a robot has now."""
        body = self.simulation._bodies._bodies[robot]
        assert isinstance(body, SimulatedRoverPlant)
        return body

    def rover(self, robot: int) -> Rover:
        return self.body(robot).rover

    def agent(self, robot: int) -> Agent:
        return self.simulation.agents[robot - 1]

    def states(self) -> dict[int, str]:
        return {agent.robot: agent.state.value for agent in self.simulation.agents}

    def until_fleet_time(self, time_s: float) -> None:
        self.simulation.run_until(self.simulation.epoch_ns + round(time_s * NS_PER_S))

    def run(self, seconds: float) -> None:
        self.simulation.run_until(self.now_ns + round(seconds * NS_PER_S))

    def until(self, condition: Any, most_s: float = 20.0) -> float:
        """Runs until something is true; how long that took, s."""
        begun_ns = self.now_ns
        while not condition():
            assert self.now_ns < begun_ns + most_s * NS_PER_S, (self.states(), self.reasons())
            self.run(0.01)
        return (self.now_ns - begun_ns) / NS_PER_S

    def reasons(self) -> dict[int, str]:
        return {agent.robot: agent.reason for agent in self.simulation.agents}

    def heard(self, kind: type[Any], robot: int, since_ns: int = 0) -> list[Any]:
        """What a robot said on the bus at `since_ns` and later, by its own time."""
        return [m for _, _, m in self.said if type(m) is kind and m.robot == robot and m.time_ns >= since_ns]

    def resume(self, *robots: int) -> None:
        message = Resume(self.now_ns // 1_000, self.now_ns, robots)
        self.simulation.publish(key_expressions.resume(self.name), encode(message))

    def stop(self) -> None:
        message = Stop(self.now_ns // 1_000, self.now_ns, "lunch")
        self.simulation.publish(key_expressions.stop(self.name), encode(message))

    def distance(self, one: int, other: int) -> float:
        """Of two hand points in truth, m."""
        a, b = self.body(one).pose, self.body(other).pose
        offset = self.fleet.robot(one).hand_offset_m
        return hypot(
            a.x + offset * cos(a.heading) - b.x - offset * cos(b.heading),
            a.y + offset * sin(a.heading) - b.y - offset * sin(b.heading),
        )

    def edges_within(self, metres: float) -> bool:
        return all(abs(self.distance(i, j) - 3.0) < metres for i, j in ((1, 2), (1, 3), (2, 3)))


@pytest.mark.slow
def test_taken_over_its_neighbours_are_told_and_carry_on_and_resumed_it_comes_back() -> None:
    run = Run()
    run.until_fleet_time(15.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "running")
    assert run.edges_within(0.15)
    taken_ns = run.now_ns
    assert run.rover(2).set_mode("MANUAL")
    took = run.until(lambda: run.agent(2).state is State.RELEASED)
    assert took < 0.2, "the heartbeat, the bridge's tick, the agent's tick"
    run.run(0.2)
    status = run.heard(Status, 2, taken_ns)[0]
    assert (status.state, status.reason) == ("released", "its operator has it: mode MANUAL, not GUIDED")
    # The neighbours are told by the next hand state, go on without it and keep away from where it really is.
    released_ns = status.time_ns
    run.run(6.0)
    hands = run.heard(HandState, 2, released_ns)
    assert len(hands) > 100
    assert not any(hand.following for hand in hands)
    for robot in (1, 3):
        states = [s.state for s in run.heard(Status, robot, taken_ns)]
        assert set(states) <= {"running", "degraded"}
        assert states[-1] == "degraded"
        without = "without robot 2 (does not follow)"
        assert run.agent(robot).reason in (without, f"{without}; on its way round robot 2")
        assert all(not wrench.brake for wrench in run.heard(Wrench, robot, taken_ns))
        assert all(state.driving for state in run.heard(PlantState, robot, taken_ns))
    assert all(wrench.brake for wrench in run.heard(Wrench, 2, released_ns))
    state = run.heard(PlantState, 2, released_ns)[-1]
    assert (state.healthy, state.obeying, state.driving) == (True, False, False)
    assert abs(run.rover(2).speed) < 0.01

    assert run.rover(2).set_mode("GUIDED")
    run.run(3.0)
    assert run.agent(2).state is State.RELEASED
    assert "waiting to be told to resume" in run.reasons()[2]
    run.resume(1, 3)  # not for it
    run.run(1.0)
    assert run.agent(2).state is State.RELEASED
    run.resume(2)
    run.until(lambda: run.agent(2).state is State.RUNNING, 0.5)
    run.run(15.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "running")
    assert run.edges_within(0.15)


def test_an_agent_that_dies_has_its_rover_brake_and_a_new_one_drives_on() -> None:
    run = Run(rules=("robot = 2\nat = 8\nfor = 4\nkill = 'agent'",))
    run.until_fleet_time(8.0)
    assert abs(run.rover(2).speed) > 0.25
    killed_ns = run.now_ns
    run.run(BRAKES_S)
    assert not run.heard(PlantState, 2)[-1].driving
    assert run.rover(2).mode == "GUIDED"
    braked_ns = next(m.time_ns for m in run.heard(PlantState, 2, killed_ns) if not m.driving)
    assert braked_ns - killed_ns <= BRAKES_S * NS_PER_S
    run.until(lambda: abs(run.rover(2).speed) < 0.06, 2.0)
    run.until_fleet_time(11.5)
    assert run.agent(1).condition == ("degraded", "without robot 2 (3.5 s)")
    run.until_fleet_time(14.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "running")
    run.run(12.0)
    assert run.edges_within(0.15)


@pytest.mark.slow
def test_a_bridge_that_dies_leaves_its_rover_standing_and_a_new_one_drives_on_when_told() -> None:
    run = Run(rules=("robot = 2\nat = 8\nfor = 6\nkill = 'plant'",))
    run.until_fleet_time(8.0)
    rover = run.rover(2)
    killed_ns = run.now_ns
    run.run(run.fleet.control.plant_timeout_s + 0.1)
    assert run.agent(2).state is State.FAULT
    while run.now_ns < killed_ns + 4 * NS_PER_S:  # nobody else lets time pass for it now
        run.run(0.05)
        rover.advance(run.now_ns)
    assert abs(rover.speed) < 0.06
    assert (rover.mode, rover.armed) == ("GUIDED", True)
    run.until_fleet_time(14.0)
    run.until(lambda: run.reasons()[2] == BEGUN_LATE, 5.0)
    run.run(3.0)
    assert abs(rover.speed) < 0.06, "a new bridge does not know what its operator did before"
    run.resume(2)
    run.until(lambda: run.agent(2).state is State.RUNNING, 5.0)
    assert run.rover(2) is rover
    run.run(15.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "running")
    assert run.edges_within(0.15)


def test_when_both_of_its_processes_die_no_new_ones_drive_on_before_they_are_told() -> None:
    """However soon they are back, and though the others still drive by the mission."""
    run = Run(rules=tuple(f"robot = 2\nat = 8\nfor = 1\nkill = '{role}'" for role in ("agent", "plant")))
    run.until_fleet_time(12.0)
    run.until(lambda: run.reasons()[2] == BEGUN_LATE, 5.0)
    run.run(3.0)
    assert abs(run.rover(2).speed) < 0.06
    assert not any(m.driving for m in run.heard(PlantState, 2, run.now_ns - 3 * NS_PER_S))
    run.resume(2)
    run.until(lambda: run.agent(2).state is State.RUNNING, 5.0)


def test_a_cut_link_is_a_fault_until_it_is_back() -> None:
    run = Run()
    run.until_fleet_time(8.0)
    run.body(2).transport.cut = True
    took = run.until(lambda: run.agent(2).state is State.FAULT, 2.0)
    assert took < 0.8
    run.run(5.0)
    assert abs(run.rover(2).speed) < 0.06
    run.body(2).transport.cut = False
    run.until(lambda: "may have had it" in run.reasons()[2], 5.0)
    run.run(3.0)
    assert abs(run.rover(2).speed) < 0.06, "its operator may have had it"
    run.resume(2)
    run.until(lambda: run.agent(2).state is State.RUNNING, 5.0)
    places = [(m.x, m.y, m.time_ns) for m in run.heard(PlantState, 2) if m.healthy]
    for (x, y, before), (x1, y1, after) in pairwise(places):
        assert hypot(x1 - x, y1 - y) < 0.1 + 1.0 * (after - before) / NS_PER_S
    run.run(15.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "running")
    assert run.edges_within(0.15)


def test_the_mission_ends_with_all_standing_in_guided() -> None:
    run = Run(duration_s=6.0)
    run.until_fleet_time(12.0)
    assert run.states() == dict.fromkeys((1, 2, 3), "stopped")
    for robot in (1, 2, 3):
        assert abs(run.rover(robot).speed) < 0.02
        assert run.rover(robot).mode == "GUIDED"


def test_rovers_with_an_origin_each_drive_in_one_world() -> None:
    """Warm rovers took their own origins, where each was switched on: metres apart."""
    run = Run()
    run.until_fleet_time(10.0)
    datum = datum_of(run.fleet)
    origins = [frames.geodetic_to_world(datum, run.rover(robot).origin) for robot in (1, 2, 3)]
    assert min(hypot(a[0] - b[0], a[1] - b[1]) for a, b in pairwise(origins)) > 2.0
    for robot in (1, 2, 3):
        state, truth = run.heard(PlantState, robot)[-1], run.body(robot).pose
        assert (state.x, state.y) == pytest.approx((truth.x, truth.y), abs=0.1)
