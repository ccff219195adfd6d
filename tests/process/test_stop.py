"""`handfast stop` and `handfast resume` of real processes: nobody drives in between, wherever it was."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Ask, PlantState, Status, Stop, Wrench
from tests.process.fleet_harness import Robots, all_ready, robots
from tests.process.harness import no_trouble_in_logs
from tests.process.small_fleets import triangle

REASON = "a person on the field"
MOVING = ('trajectory.kind="line"', "trajectory.velocity_mps=[0.3,0.2]")


def moves(fleet: Robots, *ids: int) -> None:
    for robot in ids:
        fleet.wait(
            lambda robot=robot: (state := fleet.plant(robot)) and state.driving and abs(state.speed) > 0.1,
            f"robot {robot} moves",
        )


def stop(fleet: Robots) -> tuple[int, int, str]:
    """`handfast stop`; returns its status, when a plant drove last (wall-clock ns), and what it printed."""
    begun_ns = time.time_ns()
    status, out = fleet.told_by("stop", "--each", "--reason", REASON)
    for robot in fleet.fleet.ids:
        fleet.first(begun_ns, PlantState, robot, lambda m: not m.driving, f"robot {robot}'s plant brakes")
    drove = [
        m.time_ns
        for robot in fleet.fleet.ids
        for _, m in fleet.since(begun_ns, PlantState, robot)
        if m.driving
    ]
    return status, max(drove, default=begun_ns), out


def nobody_drives(fleet: Robots, from_ns: int) -> None:
    """No plant has driven after `from_ns`: one that began again would show."""
    for robot in fleet.fleet.ids:
        assert not any(m.driving for _, m in fleet.since(from_ns, PlantState, robot)), fleet.told()


def known_stop(fleet: Robots) -> Stop:
    """The stop as the fleet knows it: an operator's own messages go to its robots only."""
    fleet.bus.publish(key_expressions.ask(fleet.name), encode(Ask(time.time_ns(), "a test")))
    stops = fleet.wait(lambda: fleet.orders(Stop), "a robot says the stop again")
    assert len(set(stops)) == 1
    found = stops[0]
    assert isinstance(found, Stop)
    return found


@pytest.mark.parametrize("topology", ["mesh", "routed"])
def test_stop_holds_until_resume_whatever_comes_between(tmp_path: Path, topology: str) -> None:
    with all_ready(triangle(f'network.topology="{topology}"'), tmp_path / "r") as fleet:
        fleet.drive()
        moves(fleet, *fleet.members)
        status, stopped_ns, out = stop(fleet)
        assert status == 0, out
        for robot in fleet.members:
            assert f"robot {robot}: stop" in out
            fleet.wait(lambda robot=robot: fleet.states()[robot] == "stopped", f"robot {robot} stands")
            assert fleet.status(robot).reason == f"stop: {REASON}"
        assert known_stop(fleet).reason == REASON

        # Both processes of a robot are started again: they hear of the stop, from no operator.
        for role in key_expressions.ROLES:
            fleet.signal(2, role, signal.SIGKILL)
            fleet.processes[2, role].wait()
        started_ns = time.time_ns()
        for role in key_expressions.ROLES:
            fleet.start(2, role)
        _, told = fleet.first(
            started_ns, Status, 2, lambda m: m.state == "stopped", "the new agent is stopped"
        )
        assert told.reason == f"stop: {REASON}"
        assert not any(m.state == "running" for _, m in fleet.since(started_ns, Status, 2))
        assert all(m.brake for _, m in fleet.since(started_ns, Wrench, 2))

        # A mission is no resume, be it of a new epoch.
        mission = fleet.mission
        assert mission is not None
        epoch_ns = (time.time_ns() + NS_PER_S // 2) // fleet.fleet.period_ns * fleet.fleet.period_ns
        later = mission._replace(version=epoch_ns // 1_000, time_ns=time.time_ns(), epoch_ns=epoch_ns)
        fleet.bus.publish(key_expressions.mission(fleet.name), encode(later))
        fleet.wait(lambda: fleet.versions() == {later.version}, "every agent knows the new mission")
        fleet.wait(lambda: time.time_ns() > epoch_ns + NS_PER_S // 2, "its epoch has come")
        nobody_drives(fleet, stopped_ns)
        assert {fleet.states()[robot] for robot in fleet.members} == {"stopped"}

        status, out = fleet.told_by("resume")
        assert status == 0, out
        fleet.wait_until_all("running")
        moves(fleet, *fleet.members)
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)


def test_a_plant_brakes_by_the_stop_itself_while_its_agent_is_frozen(tmp_path: Path) -> None:
    """It would go on for half a minute on its last wrench; and the agent, when it wakes, is stopped."""
    with robots(tmp_path / "r", "pair", *MOVING, "control.wrench_timeout_s=30") as fleet:
        fleet.drive()
        moves(fleet, 1, 2)
        fleet.signal(2, "agent", signal.SIGSTOP)
        frozen_ns = time.time_ns()
        fleet.first(
            frozen_ns, PlantState, 2, lambda m: m.time_ns > frozen_ns + NS_PER_S // 2, "half a second passes"
        )
        assert all(m.driving for _, m in fleet.since(frozen_ns, PlantState, 2)), fleet.told()
        status, stopped_ns, out = stop(fleet)
        assert status == 1
        assert "robot 1: stop" in out
        assert "robot 2: nothing heard from its agent, its plant brakes after" in out
        assert "braking: stop: a person on the field" in fleet.log(2, "plant").read_text()
        woken_ns = fleet.signal(2, "agent", signal.SIGCONT)
        fleet.first(woken_ns, Status, 2, lambda m: m.state == "stopped", "the agent is stopped")
        version = known_stop(fleet).version
        fleet.wait(
            lambda: {fleet.status(robot).order_version for robot in (1, 2)} == {version},
            "both know of the stop",
        )
        nobody_drives(fleet, stopped_ns)
        assert fleet.told_by("resume")[0] == 0
        fleet.wait_until_all("running")
        moves(fleet, 1, 2)
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)
