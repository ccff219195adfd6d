"""Neighbours and operators that fall silent: real processes that are killed and started again."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import Status, Wrench
from tests.process.fleet_harness import Robots, all_ready, robots
from tests.process.harness import measured, no_trouble_in_logs
from tests.process.small_fleets import triangle

DEADMAN_S = 0.8
TRANSIT_S = 0.2
"""For the way of a heartbeat, and a machine that is busy."""


def all_well(fleet: Robots) -> None:
    assert not fleet.died(), fleet.told()
    no_trouble_in_logs(fleet.folder)


def restart(fleet: Robots, robot: int, role: str) -> int:
    """Starts a process in the place of one that is gone; returns when, wall-clock ns."""
    fleet.processes[robot, role].wait()
    now_ns = time.time_ns()
    fleet.start(robot, role)
    return now_ns


@pytest.mark.long
def test_the_only_neighbour_is_killed_and_comes_back(tmp_path: Path) -> None:
    """Who hears nobody holds at once; who starts again has the mission from the other one, and both go on."""
    with robots(tmp_path / "r", "pair") as fleet:
        fleet.drive()
        killed_ns = fleet.signal(2, "agent", signal.SIGKILL)
        took, status = fleet.first(killed_ns, Status, 1, lambda m: m.state == "holding", "robot 1 holds")
        measured("seconds", took)
        assert status.reason == "hears none of its neighbours: robot 2 (no connection to its agent)"
        held_ns = status.time_ns
        before = fleet.counters(1)["received"]
        started_ns = restart(fleet, 2, "agent")
        _, status = fleet.first(started_ns, Status, 2, lambda m: m.state == "running", "the new agent drives")
        assert fleet.mission is not None
        assert status.mission_version == fleet.mission.version
        _, status = fleet.first(started_ns, Status, 1, lambda m: m.state == "running", "robot 1 drives on")
        assert all(m.brake for _, m in fleet.since(held_ns, Wrench, 1) if m.time_ns < started_ns)
        fleet.wait(lambda: fleet.counters(1)["received"] > before + 10, "robot 1 hears it again")
        assert fleet.counters(1)["rejected"] == 0, fleet.counters(1)
        all_well(fleet)


def test_one_of_two_neighbours_is_killed_and_comes_back(tmp_path: Path) -> None:
    """The others drive on without that edge, say so, and take it back."""
    with all_ready(triangle(), tmp_path / "r") as fleet:
        fleet.drive()
        killed_ns = fleet.signal(3, "agent", signal.SIGKILL)
        for robot in (1, 2):
            _, status = fleet.first(
                killed_ns, Status, robot, lambda m: m.state == "degraded", f"robot {robot} misses it"
            )
            assert status.reason == "without robot 3 (no connection to its agent)"
        started_ns = restart(fleet, 3, "agent")
        for robot in fleet.members:
            fleet.first(
                started_ns, Status, robot, lambda m: m.state == "running", f"robot {robot} drives by the law"
            )
        for robot in (1, 2):
            states = {m.state for _, m in fleet.since(killed_ns, Status, robot)}
            assert states <= {"running", "degraded"}, states
            assert not any(m.brake for _, m in fleet.since(killed_ns, Wrench, robot))
        all_well(fleet)


def test_the_operators_heartbeat_is_the_dead_mans_switch(tmp_path: Path) -> None:
    """Robots hold when the process that sends it is killed, and drive on with another one."""
    with robots(tmp_path / "r", "pair", f"supervision.deadman_s={DEADMAN_S:g}") as fleet:
        with fleet.command("heartbeat") as operator:
            operator.wait_for_line("heartbeats heard by 2 of 2 agents")
            fleet.drive()
            operator.process.kill()
            operator.process.wait()
            killed_ns = time.time_ns()
        for robot in fleet.members:
            _, status = fleet.first(
                killed_ns, Status, robot, lambda m: m.state == "holding", f"robot {robot} holds"
            )
            assert status.reason.startswith("no operator's heartbeat for "), status.reason
        due_ns = killed_ns + round((DEADMAN_S + TRANSIT_S) * NS_PER_S) + 2 * fleet.fleet.period_ns
        for robot in fleet.members:
            drove = [m.time_ns for _, m in fleet.since(killed_ns, Wrench, robot) if not m.brake]
            assert all(at_ns <= due_ns for at_ns in drove), fleet.told()
            assert max(drove) > killed_ns + NS_PER_S // 4, "it held long before it had to"
        with fleet.command("heartbeat"):
            fleet.wait_until_all("running")
        all_well(fleet)
