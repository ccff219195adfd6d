"""Bodies in virtual time, and what becomes of them when their plant starts again."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import hypot
from pathlib import Path

import pytest

from agent.common.time import NS_PER_S
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages.codec import decode
from agent.messages.types import Checks, Message, PlantState, Status
from bridges.mavlink.bridge.backend import BEGUN_LATE
from bridges.mavlink.simulator.in_memory import SimulatedRoverPlant
from deploy.console.data_files import FLEETS
from deploy.simulate.bodies import Bodies
from deploy.simulate.simulation import Simulation
from plant.backend import Command

RESTART = """
[[faults.rule]]
name = "bridge"
robot = 2
restart = "plant"
at = 2
"""


@pytest.fixture
def mixed(tmp_path: Path) -> Fleet:
    """Robot 1 is a unicycle, robot 2 a rover whose bridge starts again after 2 s."""
    scenario = tmp_path / "restart.toml"
    scenario.write_text(RESTART)
    pair = FLEETS / "pair.toml"
    return resolved(
        load_fleet(
            pair,
            [
                "robot.2.plant=mavlink", "robot.2.mavlink.connection=tcp:10.0.0.1:5760",
                "datum.latitude_deg=-35.36", "datum.longitude_deg=149.16", "fleet.rate_hz=20",
                "control.plant_timeout_s=0.5", "formation.distance_m=3", "formation.offsets=[[0,0],[3,0]]",
                "robot.2.hand_offset_m=0.4", "robot.2.x_m=3", "fleet.duration_s=8",
            ],
            scenario=scenario,
        )
    )  # fmt: skip


def test_a_unicycle_stands_where_it_was(mixed: Fleet) -> None:
    bodies = Bodies(mixed)
    body = bodies.make(1, NS_PER_S)
    for k in range(1, 50):
        body.step(NS_PER_S + k * NS_PER_S // 50, Command(5.0, 0.1))
    x, y, heading, speed, _ = body.pose
    assert speed > 0.1
    again = bodies.make(1, 3 * NS_PER_S)
    assert again is not body
    assert tuple(again.pose) == (x, y, heading, 0.0, 0.0)


def test_a_rover_goes_on_with_a_bridge_that_knows_nothing(mixed: Fleet) -> None:
    bodies = Bodies(mixed)
    body = bodies.make(2, NS_PER_S)
    assert isinstance(body, SimulatedRoverPlant), "whatever its connection: here it is simulated"
    again = bodies.make(2, 2 * NS_PER_S)
    assert isinstance(again, SimulatedRoverPlant)
    assert again.rover is body.rover
    assert again.plant is not body.plant


def test_unicycle_and_rover_drive_together_until_a_restart_of_the_bridge(mixed: Fleet) -> None:
    heard: list[Message] = []
    simulation = Simulation(mixed, lambda now_ns, key, payload: heard.append(decode(payload)))
    simulation.run()
    assert simulation.reasons == []
    assert any(type(message) is Checks and message.robot == 2 for message in heard)
    begun_ns = simulation.epoch_ns + 2 * NS_PER_S
    since = [
        message
        for message in heard
        if type(message) is PlantState and message.robot == 2 and message.time_ns > begun_ns
    ]
    assert not since[0].healthy, "the new bridge has heard nothing of its vehicle yet"
    known = next(message for message in since if message.healthy)
    assert abs(known.x - 3.0) + abs(known.y) < 3.0
    assert not any(message.driving for message in since), "its operator may have had it"
    told = [message for message in heard if type(message) is Status and message.robot == 2]
    assert any(message.reason == BEGUN_LATE for message in told)


def test_where_a_vehicle_truly_is_is_known_though_no_bridge_steps_it(mixed: Fleet) -> None:
    """It rolls on; a simulated body whose plant is dead stands."""
    rules = tuple(
        replace(rule, restart=None, kill="plant", robot=robot)
        for rule in mixed.faults.rules
        for robot in (1, 2)
    )
    simulation = Simulation(replace(mixed, faults=replace(mixed.faults, rules=rules)))
    seen: list[int] = []
    simulation.every(NS_PER_S // 2, lambda: seen.append(simulation.now_ns))
    assert simulation.start(5 * NS_PER_S), simulation.reasons
    simulation.run_until(simulation.epoch_ns + round(2.1 * NS_PER_S))
    assert [simulation.runs(robot, "plant") for robot in (1, 2)] == [False, False]
    assert simulation.runs(2, "agent")
    before = simulation.poses()
    simulation.run_until(simulation.epoch_ns + 3 * NS_PER_S)
    after = simulation.poses()
    assert after[0] == before[0]
    went = hypot(after[1].x - before[1].x, after[1].y - before[1].y)
    assert went == pytest.approx(0.9 * abs(before[1].speed), rel=0.2)
    assert went > 0.01
    assert {b - a for a, b in pairwise(seen)} == {NS_PER_S // 2}
