"""Fleets whose robots are linked to routers instead of to each other."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import numpy as np

from tests.process.harness import (
    BUSY,
    Command,
    assert_same_way,
    children,
    hands,
    last_lines,
    running,
    wait_for,
)
from tests.process.test_run import AGREE_M, assert_complete

NETWORK = ("--set", "network.base_port=21700")
DRIVE_S = 16.0


def routed(folder: Path, fleet: str, *more: str) -> Command:
    arguments = ("run", fleet, "--out", str(folder / "out"), "--no-report", *NETWORK, *BUSY, *more)
    return Command(folder, *arguments)


def routers_of(command: Command) -> list[int]:
    return [pid for pid, text in children(command.process.pid).items() if "agent.runtime.router" in text]


def test_a_fleet_behind_two_routers_drives_as_it_does_in_virtual_time(tmp_path: Path) -> None:
    two = ("--set", 'network.routers=["10.0.0.1:7447", "10.0.0.2:7447"]', "--duration", f"{DRIVE_S:g}")
    with routed(tmp_path, "delta", *two) as command:
        told = command.wait_for_line(r"(?m)^starting 6 agents and 6 plants on ports .*, through (.*)$")
        assert re.fullmatch(r"2 routers on 127\.0\.0\.1:\d+", told[1]), told[1]
        command.wait_for_line("alive after")
        routers = routers_of(command)
        assert len(routers) == 2
        assert command.wait(DRIVE_S + 30.0) == 0, command.told()
    assert not [pid for pid in routers if running(pid)]
    assert "did not end" not in command.err, "it ends when asked"
    metrics = assert_complete(tmp_path / "out", report=False)
    messages = metrics["messages"]
    assert messages["received"] >= 0.98 * messages["sent"], messages
    log = last_lines(tmp_path / "out" / "logs" / "router-2.log")
    assert log[-1] == "router 2: ending (SIGTERM)", log
    arguments = ("simulate", "delta", "--duration", f"{DRIVE_S:g}", "--out", "out", "--no-report", *BUSY)
    with Command(tmp_path / "simulated", *arguments) as simulated:
        assert simulated.wait() == 0, simulated.told()
    grid = np.arange(0.0, DRIVE_S, 0.02)
    assert_same_way(hands(tmp_path / "out", grid), hands(tmp_path / "simulated" / "out", grid), grid, AGREE_M)


def test_a_router_that_dies_ends_the_run_and_no_robot_drives_on(tmp_path: Path) -> None:
    with routed(tmp_path, "pair", "--set", 'network.topology="routed"', "--duration", "60") as command:
        command.wait_until_driving()
        (router,) = routers_of(command)
        pids = list(command.children())
        assert len(pids) == 4
        os.kill(router, signal.SIGKILL)
        assert command.wait() == 1, command.told()
        wait_for(lambda: not any(map(running, pids)), "the end of all processes")
    assert re.search(r"Router 1 ended at \d+\.\d s \(killed by SIGKILL\)\.", command.err), command.told()
