"""The agent of a robot whose operator takes its body, and gives it back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import hypot
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose, hand
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, Stop
from handfast.agent.supervision.state_machine import State
from handfast.plant.backend import Command, PlantBackend, Reading
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet
from tests.unit.agent.agent_bench import (
    LISTEN_TICKS,
    MISSION,
    PERIOD,
    START,
    STOP,
    TIMEOUT_TICKS,
    Bench,
    brakes,
    fleet,
)

TAKEN: Mapping[str, Any] = {"obeying": False, "driving": False, "note": "mode MANUAL"}


def test_a_released_robot_brakes_says_why_and_tells_its_neighbours_where_it_is():
    bench = Bench()
    bench.drive()
    bench.run(5)
    bench.plant, bench.pose = TAKEN, Pose(0.1, 0.0, 0.0, 0.3, 0.0)
    out = bench.tick()
    assert bench.agent.condition == ("released", "mode MANUAL")
    assert (out.status.state, out.status.reason) == ("released", "mode MANUAL")
    for each in [out, *bench.run(60)]:  # for longer than any timeout
        assert brakes(each)
        assert not each.hand.following
        assert each.hand.multipliers == ()
        assert each.hand[9:13] == (0.0, 0.0, 0.0, 0.0)
        assert each.hand.x == pytest.approx(0.2 + 0.3 * PERIOD / 2 / NS_PER_S, abs=2e-3)
    bench.plant = {"obeying": False, "note": ""}
    bench.tick()
    assert bench.agent.condition == ("released", "its body does not obey")
    assert bench.counters()["rejected"] == 0


def test_a_released_robot_drives_again_once_its_body_obeys_and_begins_with_fresh_multipliers():
    """What they grew to before says nothing about a formation that an operator has driven about in."""

    def bench_of_two_without_an_edge() -> Bench:
        # Too near, so that the multiplier changes for as long as the robot does as it is told.
        bench = Bench("formation.edges=[]", "trajectory.kind=hold")
        bench.pose, bench.other = Pose(0.0, 0.0, 0.0, 0.0, 0.0), (0.5, 0.0, -0.1, 0.0)
        return bench

    bench = bench_of_two_without_an_edge()
    bench.listen()
    epoch = bench.now + 3 * PERIOD
    bench.mission(epoch_ns=epoch)
    ((_, first),) = bench.run(4)[-1].hand.multipliers
    ((_, grown),) = bench.run(40)[-1].hand.multipliers
    assert abs(grown - first) > 0.3 * abs(first) > 0
    bench.plant = TAKEN
    bench.run(3)
    bench.plant = {}
    starts = bench_of_two_without_an_edge()
    starts.now = bench.now - LISTEN_TICKS * PERIOD
    starts.listen()
    starts.mission(epoch_ns=epoch)
    out = bench.tick()
    assert bench.agent.condition == ("running", "")
    assert not brakes(out)
    assert out.hand.multipliers == starts.tick().hand.multipliers
    assert abs(out.hand.multipliers[0][1] - grown) > 0.1 * abs(grown)


def test_a_robot_whose_body_was_not_handed_over_waits_with_the_reason():
    bench = Bench()
    bench.plant = TAKEN
    out = bench.tick()
    assert bench.agent.condition == ("waiting", "mode MANUAL")
    assert out.hand is not None
    bench.mission()
    for out in bench.run(LISTEN_TICKS):
        assert bench.agent.condition[1] == "mode MANUAL"
        assert brakes(out)
        assert not out.hand.following
    assert bench.state is State.RELEASED, "the drive goes on without it"
    bench.plant = {}
    bench.tick()
    assert bench.state is State.RUNNING


def test_a_new_mission_is_leave_to_drive_as_well():
    bench = Bench()
    bench.drive()
    bench.plant = TAKEN
    bench.run(3)
    bench.pose = None
    bench.run(TIMEOUT_TICKS + 2)
    bench.pose, bench.plant = Pose(0.0, 0.0, 0.0, 0.0, 0.0), {}
    bench.run(3)
    bench.mission(version=2)
    bench.run(4)
    assert bench.state is State.RUNNING


def test_a_stop_reaches_a_released_robot():
    bench = Bench()
    bench.drive()
    bench.plant = TAKEN
    bench.tick()
    bench.give(STOP, Stop(1, bench.now, "lunch"))
    bench.tick()
    assert bench.agent.condition == ("stopping", "stop: lunch")
    bench.tick()
    bench.plant = {}
    assert all(map(brakes, bench.run(10)))
    assert bench.agent.condition == ("stopped", "stop: lunch")


class Lent(PlantBackend):
    """A simulated body that its operator may take: then it drives ahead at 0.3 m/s, whatever it is asked."""

    def __init__(self, made: Fleet, robot: int) -> None:
        self._body, self._robot = from_fleet(made, robot), made.robot(robot)
        self.taken = False

    def step(self, now_ns: int, command: Command | None) -> Reading:
        if self.taken:
            speed = self.reading.pose.speed
            command = Command(self._robot.mass_kg * (0.3 - speed) / 0.1, 0.0)
        self.reading = self._body.step(now_ns, command)
        taken = self.taken
        return self.reading._replace(obeying=not taken, note="mode MANUAL" if taken else "")

    def close(self) -> None: ...


def test_neighbours_of_a_released_robot_carry_on_about_where_it_really_is():
    made = fleet("trajectory.kind=hold")
    bodies = {robot: Lent(made, robot) for robot in made.ids}
    plants = [PlantNode(made, robot, body) for robot, body in bodies.items()]
    agents = {robot: Agent(made, robot) for robot in made.ids}

    def tick(nodes: Iterable[PlantNode | Agent], now: int) -> None:
        out = [each for node in nodes for each in node.tick(now)]
        for key, payload in out:
            for node in (*plants, *agents.values()):
                if key in node.subscriptions:
                    node.receive(now, key, payload)

    def run(seconds: float, *states: str) -> None:
        nonlocal now
        for k in range(round(seconds * 50)):
            tick(plants, now)
            tick(agents.values(), now + PERIOD // 2)
            now += PERIOD
            if k:
                assert tuple(agent.state.value for agent in agents.values()) == states

    def distance() -> float:
        one, other = (hand(body.reading.pose, 0.1) for body in bodies.values())
        return hypot(one.x - other.x, one.y - other.y)

    now = START
    for _ in range(LISTEN_TICKS):
        tick(plants, now)
        tick(agents.values(), now + PERIOD // 2)
        now += PERIOD
    mission = encode(Mission(1, now, now, 60 * NS_PER_S, digest(made)))
    for node in (*plants, *agents.values()):
        node.receive(now, MISSION, mission)
    run(10.0, "running", "running")
    assert distance() == pytest.approx(1.0, abs=0.01)
    bodies[1].taken = True
    before = bodies[2].reading.pose
    run(4.0, "released", "degraded")
    # Pushed towards robot 2, which gives way rather than go on as if its neighbour were where it should be.
    assert hypot(bodies[2].reading.pose.x - before.x, bodies[2].reading.pose.y - before.y) > 0.15
    assert distance() > made.formation.safe_distance_m
    bodies[1].taken = False
    run(15.0, "running", "running")
    assert distance() == pytest.approx(1.0, abs=0.01)
    assert not any(agent.rejected for agent in agents.values())
