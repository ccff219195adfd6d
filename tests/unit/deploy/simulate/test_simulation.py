"""A fleet in virtual time and the bodies in it; tests/simulation drives whole fleets."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import hypot
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Checks, Message, PlantState, Status
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE
from handfast.bridges.mavlink.simulator.in_memory import SimulatedRoverPlant
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Bodies, Simulation
from handfast.plant.backend import Command

PAIR = resolved(load_fleet(FLEETS / "pair.toml", ["fleet.duration_s=2"]))


def poses(begin_ns: int) -> tuple[int, list[tuple[int, float, float]]]:
    """The epoch of a drive, and poses by fleet time (ns)."""
    found = []

    def sink(_: int, key: str, payload: bytes) -> None:
        message = decode(payload)
        if type(message) is PlantState:
            found.append((message.time_ns, message.x, message.y))

    simulation = Simulation(PAIR, sink, begin_ns)
    simulation.run()
    epoch_ns = simulation.epoch_ns
    return epoch_ns, [(time_ns - epoch_ns, x, y) for time_ns, x, y in found]


def test_it_begins_when_it_is_told_and_drives_the_same_way() -> None:
    late_ns = 1_700_000_000 * NS_PER_S + 1
    early, late = poses(0), poses(late_ns)
    assert late_ns <= late[0] < late_ns + 2 * NS_PER_S
    assert early[0] < 2 * NS_PER_S
    assert [each for each in early[1] if each[0] >= 0] == [each for each in late[1] if each[0] >= 0]


def test_a_message_is_read_once_for_its_robots_and_whoever_takes_it_from_the_sink() -> None:
    came: list[bytes] = []
    simulation = Simulation(PAIR, lambda _, key, payload: came.append(payload))
    simulation.run()
    latest = [payload for payload in came if type(decode(payload)) is PlantState][-4:]
    heard = {id(agent._situation.plant) for agent in simulation.agents}
    assert heard <= {id(simulation.decode(each)) for each in latest}
    assert [simulation.decode(each) for each in latest] == [decode(each) for each in latest]


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
        if type(message) is PlantState
        and message.robot == 2
        and message.sequence
        and message.time_ns > begun_ns
    ]
    assert not since[0].healthy, "the new bridge has heard nothing of its vehicle yet"
    known = next(message for message in since if message.healthy)
    assert abs(known.x - 3.0) + abs(known.y) < 3.0
    assert not any(message.driving for message in since), "its operator may have had it"
    told = [message for message in heard if type(message) is Status and message.robot == 2]
    assert any(message.reason == BEGUN_LATE for message in told)


def test_where_a_vehicle_truly_is_is_recorded_though_no_bridge_tells(mixed: Fleet) -> None:
    """It rolls on, and is told until its new bridge knows where it is. A simulated body stands."""
    rules = tuple(
        replace(rule, restart=None, kill="plant", duration=2.0, robot=robot)
        for rule in mixed.faults.rules
        for robot in (1, 2)
    )
    heard: list[tuple[str, Message]] = []
    simulation = Simulation(
        replace(mixed, faults=replace(mixed.faults, rules=rules)),
        lambda now_ns, key, payload: heard.append((key, decode(payload))),
    )
    simulation.run()
    told = [(key, message) for key, message in heard if type(message) is PlantState]
    assert not any(key == key_expressions.plant_truth(mixed.fleet.name, 1) for key, _ in told)
    true_key = key_expressions.plant_truth(mixed.fleet.name, 2)
    true = [message for key, message in told if key == true_key]
    seen = [message for key, message in told if key != true_key and message.robot == 2 and message.healthy]
    lost_ns = simulation.epoch_ns + 2 * NS_PER_S
    before = max(message.time_ns for message in seen if message.time_ns < lost_ns)
    back = min(message.time_ns for message in seen if message.time_ns > lost_ns)
    assert back > lost_ns + 2 * NS_PER_S, "the new bridge has its vehicle to find first"
    assert before < true[0].time_ns < true[-1].time_ns <= back
    assert {b.time_ns - a.time_ns for a, b in pairwise(true)} == {mixed.period_ns}
    first, last = true[0], next(message for message in true if message.time_ns > lost_ns + NS_PER_S)
    assert hypot(last.x - first.x, last.y - first.y) == pytest.approx(abs(first.speed), rel=0.2)
    assert abs(first.speed) > 0.02
    assert not any(message.driving or message.obeying for message in true)
