"""The two watchdogs: by killing and by freezing real processes.

How long it takes is measured over the bus (`python -m tests.benchmarks reactions` has the figures); what
must hold is held against the messages' stamps, which no busy machine makes later.
"""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import PlantState, Status
from handfast.agent.transport.bus import LEASE_MS
from tests.process.fleet_harness import Robots, robots
from tests.process.harness import measured, no_trouble_in_logs

AT_REST = 0.02
MOVING = ('trajectory.kind="line"', "trajectory.velocity_mps=[0.3,0.2]")
"""A formation that goes on moving, so that a robot that does not brake shows."""
FROZEN_S = [pytest.param(0.6, id="link_kept"), pytest.param(1.6, id="lease_over", marks=pytest.mark.long)]


def assert_only(all_robots: Robots, *killed: tuple[int, str]) -> None:
    """Nobody died but those that the test killed, and nobody complained."""
    gone = {each for each, process in all_robots.processes.items() if process.poll() is not None}
    assert gone == set(killed), all_robots.told()
    no_trouble_in_logs(all_robots.folder)


def brakes(all_robots: Robots, robot: int, from_ns: int) -> None:
    """Waits until the plant of `robot` says that it brakes, not on old wrenches."""
    took, _ = all_robots.first(
        from_ns, PlantState, robot, lambda m: not m.driving, f"robot {robot}'s plant brakes"
    )
    measured("seconds", took)


def faults(all_robots: Robots, robot: int, from_ns: int) -> None:
    """Waits until the agent of `robot` says that its plant is silent, and asks for nothing but to brake."""
    took, status = all_robots.first(
        from_ns, Status, robot, lambda m: m.state == "fault", f"robot {robot}'s agent says fault"
    )
    measured("seconds", took)
    assert status.reason.startswith("plant silent for 0."), status.reason
    assert status.transition == "plant_lost"
    all_robots.asked_no_longer(robot, from_ns)
    all_robots.wait(
        lambda: (wrench := all_robots.wrench(robot)) and wrench.time_ns >= status.time_ns and wrench.brake,
        "it asks for a brake",
    )


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
        brakes(all_robots, 2, killed_ns)
        stands(all_robots, 2, killed_ns)
        all_robots.drove_no_longer(2, killed_ns)
        assert "braking: no fresh wrench for 0." in all_robots.log(2, "plant").read_text()
        assert_only(all_robots, (2, "agent"))


@pytest.mark.parametrize("frozen_s", FROZEN_S)
def test_agent_frozen_its_plant_brakes_and_all_goes_on(tmp_path: Path, frozen_s: float) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        moves(all_robots, 2)
        stopped_ns = all_robots.signal(2, "agent", signal.SIGSTOP)
        brakes(all_robots, 2, stopped_ns)
        stands(all_robots, 2, stopped_ns)
        all_robots.drove_no_longer(2, stopped_ns)
        # Its neighbour predicts it meanwhile and drives on; when its link is given up, nobody is left.
        all_robots.first(
            stopped_ns, PlantState, 1, lambda m: m.time_ns > stopped_ns + frozen_s * NS_PER_S, "time goes on"
        )
        if frozen_s < LEASE_MS / 1000:
            assert all_robots.states()[1] == "running", all_robots.told()
        else:
            _, status = all_robots.first(stopped_ns, Status, 1, lambda m: m.state == "holding", "1 holds")
            assert "robot 2 (no connection to its agent)" in status.reason
        woken_ns = all_robots.signal(2, "agent", signal.SIGCONT)
        back, _ = all_robots.first(woken_ns, PlantState, 2, lambda m: m.driving, "robot 2 drives again")
        measured("back, s", back)
        all_robots.wait_until_all("running")
        moves(all_robots, 2)
        assert_only(all_robots)


def test_plant_killed_its_agent_says_fault(tmp_path: Path) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        killed_ns = all_robots.signal(2, "plant", signal.SIGKILL)
        faults(all_robots, 2, killed_ns)
        assert_only(all_robots, (2, "plant"))
        # A new body in its place is driven on from where it stands.
        all_robots.start(2, "plant")
        all_robots.wait_until_all("running")
        all_robots.wait(lambda: (state := all_robots.plant(2)) and state.driving, "the new plant drives")


@pytest.mark.parametrize("frozen_s", FROZEN_S)
def test_plant_frozen_its_agent_says_fault_and_all_goes_on(tmp_path: Path, frozen_s: float) -> None:
    with robots(tmp_path / "r", "pair", *MOVING) as all_robots:
        all_robots.drive()
        moves(all_robots, 2)
        stopped_ns = all_robots.signal(2, "plant", signal.SIGSTOP)
        faults(all_robots, 2, stopped_ns)
        all_robots.first(
            stopped_ns, PlantState, 1, lambda m: m.time_ns > stopped_ns + frozen_s * NS_PER_S, "time goes on"
        )
        woken_ns = all_robots.signal(2, "plant", signal.SIGCONT)
        back, _ = all_robots.first(
            woken_ns, Status, 2, lambda m: m.state == "running", "robot 2's agent drives again"
        )
        measured("back, s", back)
        all_robots.wait_until_all("running")
        moves(all_robots, 2)
        assert_only(all_robots)
