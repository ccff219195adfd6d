"""Stops and what outlives them, of a secured fleet on three hosts. Each test goes on from the one before."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.flood_on_hosts import flood
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.process.harness import measured, wait_for

pytestmark = pytest.mark.timeout(400)
CALM = {"rate_hz": 25.0}
PATIENT = {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
ROBOTS = range(1, 7)
BASE_PORT = 7600
FLOOD_PER_S = 180
CAME_UP = "stopped: stop: the fleet came up"


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(4)


@pytest.fixture(scope="module")
def stranger(hosts: Hosts) -> Host:
    """A computer of the same network, and none of the fleet's."""
    return hosts[3]


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    fetch_wheels(hosts[0], cache)
    tables = delta(list(hosts)[:3], fleet=CALM, control=PATIENT)
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables, cache)
    found.handfast("keys")
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    assert told.stdout.count(CAME_UP) == len(ROBOTS)
    return found


def states(fleet: FleetOnHosts) -> dict[int, str]:
    """What systemd says that each robot's agent does, without the fleet's network."""
    found = {}
    for robot in ROBOTS:
        unit = f"handfast-{fleet.name}-robot-{robot}-agent"
        told = fleet.host_of(robot).run(["systemctl", "--user", "show", "-P", "StatusText", unit], check=True)
        found[robot] = told.stdout.strip()
    return found


def drive(fleet: FleetOnHosts, duration: str = "300") -> None:
    """Leaves the fleet driving. After a flood, ports take some time to get through what waits there."""

    def begins() -> bool:
        return (
            fleet.handfast("drive", "--detach", "--resume", "--duration", duration, status=None).returncode
            == 0
        )

    wait_for(begins, "a drive begins", 90.0)
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive", 20.0)


@pytest.mark.long
def test_a_stop_gets_through_a_flood_that_lets_no_link_open(fleet: FleetOnHosts, stranger: Host) -> None:
    drive(fleet)
    with flood(stranger, fleet, FLOOD_PER_S):
        begun = time.monotonic()
        told = fleet.handfast("stop", "--each", "--reason", "a person on the field")
        measured("stop under a flood, to the end of the command, s", time.monotonic() - begun)
        assert told.stdout.count("over ssh to host") == len(ROBOTS), told.stdout + told.stderr
        assert set(states(fleet).values()) == {"stopped: stop: a person on the field"}


def test_it_holds_through_down_and_up_though_a_host_was_out_of_reach(fleet: FleetOnHosts) -> None:
    """What drove off: host 3 is cut off from the stop and from down, and comes back with its mission."""
    drive(fleet)
    away = fleet.hosts[2]
    away.cut()
    told = fleet.handfast("stop", "--each", "--reason", "a person on the field", status=1)
    assert "nothing heard from its agent" in told.stdout
    fleet.handfast("down", status=1)
    away.restore()
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S)
    assert "running" not in told.stdout
    assert told.stdout.count("stopped: stop: a person on the field") == len(ROBOTS), told.stdout
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        found = states(fleet)
        assert all(state.startswith(("stop", "holding", "waiting")) for state in found.values()), found
        time.sleep(0.5)
    assert set(states(fleet).values()) == {"stopped: stop: a person on the field"}
    told = fleet.handfast("drive", "--detach", "--duration", "60", status=2)
    assert "were told to stop" in told.stderr
    assert "a person on the field" in told.stderr


def test_after_a_power_failure_nobody_drives_before_a_word(fleet: FleetOnHosts) -> None:
    drive(fleet)
    before = {robot: fleet.process(robot, "agent") for robot in ROBOTS}
    for host in list(fleet.hosts)[:3]:
        for pid in host.pids(f"/fleets/{fleet.name}/"):
            os.kill(pid, signal.SIGKILL)
    for robot in ROBOTS:
        fleet.started_again(robot, "agent", before[robot])
    wait_for(lambda: all(state.startswith("ready") for state in states(fleet).values()), "all are back", 30.0)
    time.sleep(3.0)
    assert all(state.startswith("ready: for an operator's word") for state in states(fleet).values())
    told = fleet.handfast("resume")
    assert "what goes on: a mission that was given at" in told.stdout
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive", 20.0)
