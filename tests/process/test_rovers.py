"""Who has a rover, and what becomes of it when something fails: real processes, sockets and kills.

tests/simulation/test_rovers.py and test_rover_fleet.py have more of it, in virtual time.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import HandState, PlantState, Status, Wrench
from handfast.agent.supervision.orders import AWAITED
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE
from tests.ground_station import Operator
from tests.process.harness import measured, no_trouble_in_logs
from tests.process.rover_harness import Rovers, rovers

BRAKES_S = 0.3
SLACK_S = 1.0
"""For the way over the bus, and a machine that is busy. How fast they are is for `make bench`."""


def all_well(all_rovers: Rovers, *killed: tuple[int, str]) -> None:
    """Nobody died but those that the test killed, and nobody complained."""
    gone = {each for each, process in all_rovers.processes.items() if process.poll() is not None}
    assert gone == set(killed), all_rovers.told()
    no_trouble_in_logs(all_rovers.folder)


def drive(all_rovers: Rovers) -> None:
    all_rovers.drive()
    for robot in all_rovers.fleet.ids:
        all_rovers.wait(lambda robot=robot: all_rovers.moving(robot), f"robot {robot} moves")


def drives_again(fleet: Rovers, operator: Operator) -> None:
    fleet.wait_with(
        operator, lambda: fleet.states()[2] == "running" and fleet.moving(2), "robot 2 drives again"
    )


def waits_for_leave(fleet: Rovers, operator: Operator) -> None:
    fleet.wait_with(
        operator,
        lambda: AWAITED in getattr(fleet.plant(2), "note", ""),
        "robot 2 waits for leave",
    )


def stops_by_itself(fleet: Rovers, operator: Operator) -> None:
    fleet.wait_with(
        operator, lambda: constants.SETPOINT_TIMEOUT_TEXT in operator.texts, "the rover stops by itself", 6.0
    )


def test_the_operator_takes_over_gives_back_and_the_fleet_resumes(tmp_path: Path) -> None:
    with rovers(tmp_path / "r") as (fleet, *_), fleet.operator(2) as operator:
        operator.connect()
        drive(fleet)
        since_ns = time.time_ns()
        operator.set_mode("MANUAL")
        took, state = fleet.first(since_ns, PlantState, 2, lambda m: not m.obeying, "robot 2 is let go")
        measured("seconds from the mode's request to the release", took)
        assert took < 0.3 + SLACK_S
        assert (state.healthy, state.driving) == (True, False)
        assert state.note == "its operator has it: mode MANUAL, not GUIDED"
        _, status = fleet.first(since_ns, Status, 2, lambda m: m.state == "released", "its agent says so")
        assert status.reason == state.note
        fleet.first(since_ns, HandState, 2, lambda m: not m.following, "its neighbour is told")
        released_ns = time.time_ns()
        fleet.wait_with(operator, lambda: time.time_ns() > released_ns + NS_PER_S, "time passes")
        # The other one drives on, without an edge to a robot that does not do its part.
        assert {m.state for _, m in fleet.since(since_ns, Status, 1)} <= {"running", "degraded"}
        assert fleet.status(1).reason == "without robot 2 (does not follow)"
        assert all(m.driving for _, m in fleet.since(since_ns, PlantState, 1))
        assert all(m.brake for _, m in fleet.since(released_ns, Wrench, 2))

        operator.set_mode("GUIDED")
        waits_for_leave(fleet, operator)
        back_ns = time.time_ns()
        fleet.wait_with(operator, lambda: time.time_ns() > back_ns + NS_PER_S // 2, "time passes")
        assert fleet.states()[2] == "released"
        fleet.resume(2)
        drives_again(fleet, operator)
        all_well(fleet)


def test_a_bridge_that_is_killed_and_started_again(tmp_path: Path) -> None:
    with rovers(tmp_path / "r") as (fleet, *_), fleet.operator(2) as operator:
        operator.connect()
        drive(fleet)
        killed_ns = fleet.signal(2, "plant", signal.SIGKILL)
        took, _ = fleet.first(killed_ns, Status, 2, lambda m: m.state == "fault", "its agent says fault")
        assert took < fleet.fleet.control.plant_timeout_s + BRAKES_S + SLACK_S
        # Nobody brakes the rover: it stops by itself 3 s after the last setpoint.
        stops_by_itself(fleet, operator)
        assert measured("seconds until it stops", (time.time_ns() - killed_ns) / NS_PER_S) < 3.5 + SLACK_S
        fleet.start(2, "plant")
        # Its operator may have had it meanwhile, and given it back.
        fleet.wait_with(operator, lambda: fleet.status(2).reason == BEGUN_LATE, "it waits")
        fleet.wait_with(operator, lambda: fleet.plant(2).healthy, "its estimate is good")
        back_ns = time.time_ns()
        fleet.wait_with(operator, lambda: time.time_ns() > back_ns + NS_PER_S, "time passes")
        assert not any(m.driving for _, m in fleet.since(back_ns, PlantState, 2))
        fleet.resume(2)
        drives_again(fleet, operator)
        assert (operator.mode, operator.armed) == (constants.MODE_GUIDED, True)
        operator.set_mode("HOLD")
        operator.set_mode("GUIDED")
        waits_for_leave(fleet, operator)
        all_well(fleet)
