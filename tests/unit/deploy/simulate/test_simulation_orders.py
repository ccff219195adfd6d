"""What a fleet file orders, and who sends heartbeats, in virtual time."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Heartbeat, Message, Mission, PlantState, Resume, Status, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.supervision.state_machine import State
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import HEARTBEAT_PERIOD_NS
from handfast.deploy.simulate.simulation import Simulation
from tests.unit.deploy.orders.order_fleets import SQUARE, order, square

Heard = list[tuple[int, str, Message]]
DRIVE_NS = 60 * NS_PER_S


def simulated(orders: str = "", *overrides: str) -> tuple[Simulation, Heard]:
    """The square, at the places of its formation, with robots 7 and 8 standing by."""
    return listened(square("trajectory.kind=hold", *overrides, text=SQUARE + orders))


def listened(fleet: Fleet) -> tuple[Simulation, Heard]:
    heard: Heard = []

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        with suppress(Malformed):
            heard.append((time_ns, key, decode(payload)))

    return Simulation(resolved(fleet), sink), heard


def of(kind: type[Message], heard: Iterable[tuple[int, str, Message]]) -> list[Message]:
    return [message for _, _, message in heard if type(message) is kind]


def table(at: float, kind: str, more: str = "") -> str:
    return f'[[order]]\nat = {at}\nkind = "{kind}"\n{more}\n'


def states(simulation: Simulation) -> dict[int, State]:
    return {agent.robot: agent.state for agent in simulation.agents}


def test_a_robot_in_reserve_does_not_keep_the_fleet_from_starting() -> None:
    simulation, _ = simulated()
    assert simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + NS_PER_S)
    found = states(simulation)
    assert found[7] is found[8] is State.STANDBY
    assert all(found[robot] in (State.RUNNING, State.DEGRADED) for robot in (1, 2, 3, 4))


def test_orders_are_given_at_their_times_and_take_effect() -> None:
    text = table(3, "leave", "robot = 4") + table(1, "join", "robot = 7\nedges = [2, 3]")
    simulation, heard = simulated(text)
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + 5 * NS_PER_S)
    missions = [message for message in of(Mission, heard) if isinstance(message, Mission)]
    given = {mission.note: (mission.time_ns - simulation.epoch_ns) / NS_PER_S for mission in missions}
    assert given == {
        "": pytest.approx(given[""]),
        "robot 7 joins (edges to 2 and 3)": 1.0,
        "robot 4 leaves": 3.0,
    }
    found = states(simulation)
    assert found[4] is State.STANDBY
    assert found[7] in (State.RUNNING, State.DEGRADED)
    assert simulation.reasons == []


def test_an_order_that_cannot_be_given_is_a_reason_and_the_drive_goes_on() -> None:
    simulation, _ = simulated(table(1, "leave", "robot = 7") + table(2, "leave", "robot = 4"))
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + 4 * NS_PER_S)
    assert simulation.reasons == [
        "The order at 1 s (leave) was not given: robot 7 has no place in the formation: "
        "members are 1, 2, 3 and 4."
    ]
    assert states(simulation)[4] is State.STANDBY


def test_orders_by_hand() -> None:
    simulation, heard = simulated()
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + NS_PER_S)
    simulation.give(order("stop"))
    simulation.run_until(simulation.now_ns + 2 * NS_PER_S)
    assert set(states(simulation).values()) == {State.STOPPED}
    assert all(
        not message.driving
        for time_ns, _, message in heard
        if type(message) is PlantState and time_ns > simulation.now_ns - NS_PER_S
    )
    simulation.give(order("resume"))
    simulation.run_until(simulation.now_ns + 2 * NS_PER_S)
    assert states(simulation)[1] in (State.RUNNING, State.DEGRADED)
    assert states(simulation)[7] is State.STANDBY
    with pytest.raises(OrderError):
        simulation.give(order("leave", robot=8))


def test_a_process_that_starts_again_hears_of_the_stop_before_the_mission() -> None:
    """Its fleet has no other robot that could tell it; else it would drive."""
    rule = '[[faults.rule]]\nrobot = 1\nrestart = "agent"\nat = 3\n'
    alone = """
[fleet]
name = "alone"
[formation]
edges = []
offsets = [[0, 0]]
safe_distance_m = 0.2
[trajectory]
kind = "line"
velocity_mps = [0.3, 0]
[[robot]]
id = 1
x_m = 0
y_m = 0
"""
    text = alone + table(1, "stop") + rule
    simulation, heard = listened(square(text=text))
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + 6 * NS_PER_S)
    again = [
        type(m) for t, _, m in heard if t > simulation.epoch_ns + 3 * NS_PER_S and type(m) in (Stop, Mission)
    ]
    assert again[:2] == [Stop, Mission]
    driving = [
        time_ns
        for time_ns, _, message in heard
        if type(message) is PlantState and message.driving and time_ns > simulation.epoch_ns + 2 * NS_PER_S
    ]
    assert driving == []
    assert states(simulation)[1] is State.STOPPED


def test_an_operator_beside_it_is_followed() -> None:
    """The next order builds on the mission of somebody else, and is newer."""
    simulation, heard = simulated(table(4, "leave", "robot = 4"))
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + NS_PER_S)
    first = next(message for message in of(Mission, heard) if isinstance(message, Mission))
    theirs = first._replace(
        version=first.version + 10**9,
        from_ns=simulation.epoch_ns + 2 * NS_PER_S,
        blend_ns=NS_PER_S,
        note="theirs",
        robots=((1, 0.0, 0.0), (2, 1.0, 0.0), (4, 0.0, 1.0)),
        edges=((1, 2, 1.0), (1, 4, 1.0)),
    )
    simulation.publish(key_expressions.mission("square"), encode(theirs))
    simulation.run_until(simulation.epoch_ns + 6 * NS_PER_S)
    last = of(Mission, heard)[-1]
    assert isinstance(last, Mission)
    assert last.version == theirs.version + 1
    assert [row[0] for row in last.robots] == [1, 2]
    resume = Resume(theirs.version, simulation.now_ns, ())
    simulation.publish(key_expressions.resume("square"), encode(resume))
    simulation.publish(key_expressions.resume("square"), b"rubbish")
    simulation.give(order("stop"))
    stop = of(Stop, heard)[-1]
    assert isinstance(stop, Stop)
    assert stop.version == resume.version + 1


def test_heartbeats_only_where_they_are_needed() -> None:
    simulation, heard = simulated()
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + NS_PER_S)
    assert of(Heartbeat, heard) == []


def test_robots_hold_when_their_operator_is_gone() -> None:
    simulation, heard = simulated("", "supervision.deadman_s=0.5")
    simulation.start(DRIVE_NS)
    simulation.run_until(simulation.epoch_ns + 3 * NS_PER_S)
    times = [time_ns for time_ns, _, message in heard if type(message) is Heartbeat]
    assert {after - before for before, after in pairwise(times)} == {HEARTBEAT_PERIOD_NS}
    assert states(simulation)[1] in (State.RUNNING, State.DEGRADED)
    simulation.attended = False
    simulation.run_until(simulation.now_ns + NS_PER_S)
    assert states(simulation)[1] is State.HOLDING
    statuses = [m for m in of(Status, heard) if isinstance(m, Status) and m.robot == 1]
    assert "heartbeat" in statuses[-1].reason
    simulation.attended = True
    simulation.run_until(simulation.now_ns + NS_PER_S)
    assert states(simulation)[1] in (State.RUNNING, State.DEGRADED)
