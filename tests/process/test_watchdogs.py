"""The two watchdogs, and what neighbours do: by killing and by freezing real processes.

Times are taken over the bus, from the signal to the message that shows its effect.
"""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path

import pytest

from agent.clock import NS_PER_S
from agent.messages import PlantState, Status
from tests.process.harness import Robots, measured, no_trouble_in_logs, robots

BRAKES_S = 0.3
"""Within this a plant brakes, and an agent says fault, after the other has gone."""
AT_REST = 0.02
HORIZON_S = 0.5
MOVING = ('trajectory.kind="line"', "trajectory.velocity_mps=[0.3,0.2]")
"""A formation that goes on moving, so that a robot that does not brake shows."""


def assert_only(all_robots: Robots, *killed: tuple[int, str]) -> None:
    """Nobody died but those that the test killed, and nobody complained."""
    gone = {each for each, process in all_robots.processes.items() if process.poll() is not None}
    assert gone == set(killed), all_robots.told()
    no_trouble_in_logs(all_robots.folder)


def brakes_after(all_robots: Robots, robot: int, from_ns: int) -> float:
    """Waits until the plant of `robot` says that it brakes; how long after `from_ns`, s."""
    took, _ = all_robots.first(
        from_ns, PlantState, robot, lambda m: not m.driving, f"robot {robot}'s plant brakes"
    )
    return took


def stands(all_robots: Robots, robot: int, from_ns: int) -> None:
    """Waits until `robot` stands, and checks that its speed only fell until then."""
    all_robots.first(
        from_ns,
        PlantState,
        robot,
        lambda m: not m.driving and abs(m.speed) < AT_REST,
        f"robot {robot} stands",
    )
    braking = [abs(m.speed) for _, m in all_robots.since(from_ns, PlantState, robot) if not m.driving]
    assert all(later <= sooner + 1e-9 for sooner, later in pairwise(braking)), braking


def moves(all_robots: Robots, robot: int) -> None:
    """Waits until `robot` drives with some speed: only then its braking shows."""
    all_robots.wait(
        lambda: (state := all_robots.plant(robot)) and state.driving and abs(state.speed) > 0.1,
        f"robot {robot} moves",
    )


def test_agent_killed_its_plant_brakes(tmp_path: Path) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        moves(all_robots, 2)
        killed_ns = all_robots.signal(2, "agent", signal.SIGKILL)
        took = brakes_after(all_robots, 2, killed_ns)
        measured("seconds", took)
        stands(all_robots, 2, killed_ns)
        assert "braking: no fresh wrench for 0." in all_robots.log(2, "plant").read_text()
        assert_only(all_robots, (2, "agent"))
    assert took < BRAKES_S


@pytest.mark.parametrize("frozen_s", [0.6, 1.6], ids=["link_kept", "lease_over"])
def test_agent_frozen_its_plant_brakes_and_all_goes_on(tmp_path: Path, frozen_s: float) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        moves(all_robots, 2)
        stopped_ns = all_robots.signal(2, "agent", signal.SIGSTOP)
        took = brakes_after(all_robots, 2, stopped_ns)
        measured("seconds", took)
        stands(all_robots, 2, stopped_ns)
        # Its neighbour predicts it meanwhile and drives on.
        all_robots.first(
            stopped_ns, PlantState, 1, lambda m: m.time_ns > stopped_ns + frozen_s * NS_PER_S, "time goes on"
        )
        assert all_robots.states()[1] == "running", all_robots.told()
        woken_ns = all_robots.signal(2, "agent", signal.SIGCONT)
        back, _ = all_robots.first(woken_ns, PlantState, 2, lambda m: m.driving, "robot 2 drives again")
        all_robots.wait_until_all("running")
        moves(all_robots, 2)
        assert_only(all_robots)
    assert took < BRAKES_S
    assert back < 0.5


def test_plant_killed_its_agent_says_fault(tmp_path: Path) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        killed_ns = all_robots.signal(2, "plant", signal.SIGKILL)
        took, status = all_robots.first(
            killed_ns, Status, 2, lambda m: m.state == "fault", "robot 2's agent says fault"
        )
        measured("seconds", took)
        assert status.reason.startswith("plant silent for 0."), status.reason
        wrench = all_robots.wrench(2)
        assert wrench is not None
        assert wrench.brake
        assert_only(all_robots, (2, "plant"))
        # A new body in its place is driven on from where it stands.
        all_robots.start(2, "plant")
        all_robots.wait_until_all("running")
        all_robots.wait(lambda: (state := all_robots.plant(2)) and state.driving, "the new plant drives")
    assert took < BRAKES_S


@pytest.mark.parametrize("frozen_s", [0.6, 1.6], ids=["link_kept", "lease_over"])
def test_plant_frozen_its_agent_says_fault_and_all_goes_on(tmp_path: Path, frozen_s: float) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        moves(all_robots, 2)
        stopped_ns = all_robots.signal(2, "plant", signal.SIGSTOP)
        took, status = all_robots.first(
            stopped_ns, Status, 2, lambda m: m.state == "fault", "robot 2's agent says fault"
        )
        measured("seconds", took)
        assert status.reason.startswith("plant silent for 0."), status.reason
        all_robots.first(
            stopped_ns, PlantState, 1, lambda m: m.time_ns > stopped_ns + frozen_s * NS_PER_S, "time goes on"
        )
        woken_ns = all_robots.signal(2, "plant", signal.SIGCONT)
        back, _ = all_robots.first(
            woken_ns, Status, 2, lambda m: m.state == "running", "robot 2's agent drives again"
        )
        all_robots.wait_until_all("running")
        moves(all_robots, 2)
        assert_only(all_robots)
    assert took < BRAKES_S
    assert back < 0.5


def test_neighbour_killed_then_started_again(tmp_path: Path) -> None:
    """Predicted up to the horizon, then waited for; the new agent gets the mission and all drive on."""
    with robots(tmp_path / "r", "pair", *MOVING, f"control.prediction_horizon_s={HORIZON_S}") as all_robots:
        all_robots.drive()
        moves(all_robots, 1)
        killed_ns = all_robots.signal(2, "agent", signal.SIGKILL)
        took, status = all_robots.first(killed_ns, Status, 1, lambda m: m.state == "holding", "robot 1 holds")
        measured("seconds", took)
        assert status.reason.startswith("silent neighbours: 2 (0."), status.reason
        stands(all_robots, 1, killed_ns)
        before = all_robots.counters(1)["received"]

        all_robots.start(2, "agent")
        started_ns = all_robots.heard[-1].at_ns
        all_robots.first(
            started_ns,
            Status,
            2,
            lambda m: m.state == "running",
            "the new agent has the mission and drives",
        )
        all_robots.first(started_ns, Status, 1, lambda m: m.state == "running", "robot 1 drives on")
        moves(all_robots, 1)
        moves(all_robots, 2)
        status_of_new = all_robots.status(2)
        assert status_of_new is not None
        assert all_robots.mission is not None
        assert status_of_new.mission_version == all_robots.mission.version
        all_robots.wait(lambda: all_robots.counters(1)["received"] > before + 10, "robot 1 hears it again")
        assert all_robots.counters(1)["rejected"] == 0, all_robots.counters(1)
        gone = [name for name, process in all_robots.processes.items() if process.poll() is not None]
        assert gone == [], all_robots.told()
        no_trouble_in_logs(all_robots.folder)
    assert HORIZON_S - 0.03 < took < HORIZON_S + 0.1
