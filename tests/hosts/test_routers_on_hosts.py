"""A routed fleet on three hosts, two of which have routers. Each test goes on from the one before."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import states
from tests.process.harness import measured, wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
CALM = {"rate_hz": 25.0}
"""On a busy machine the robots shall be judged, not the scheduler."""
PATIENT = {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
ROBOTS = range(1, 7)
ROUTER = "handfast-delta-router"
MODULE = "-m handfast.agent.runtime.router"


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(3)


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    fetch_wheels(hosts[0], cache)
    tables = delta(list(hosts), fleet=CALM, control=PATIENT, network={"topology": "routed"})
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables, cache)
    found.handfast("keys")
    begun = time.monotonic()
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    measured("up from nothing, s", time.monotonic() - begun)
    assert told.stdout.splitlines()[:2] == ["router 1 on host1: up", "router 2 on host2: up"]
    assert told.stdout.count("stopped: stop: the fleet came up") == len(ROBOTS), told.stdout
    return found


def router(host: Host) -> int:
    """Its process there, as this machine counts."""
    (pid,) = host.pids(MODULE)
    return pid


def starts_again(host: Host, before: int) -> None:
    wait_for(lambda: host.pids(MODULE).keys() - {before}, "the router starts again", 20.0)


def all_drive(fleet: FleetOnHosts) -> bool:
    return set(states(fleet).values()) == {"running"}


def back_s(recording: Recording, robot: int) -> float:
    """When a robot was heard again after its longest silence."""
    times = np.asarray(recording.robots[robot].status.t)
    return float(times[1 + int(np.argmax(np.diff(times)))])


def test_two_of_the_hosts_have_a_router_and_it_is_shown(fleet: FleetOnHosts) -> None:
    told = fleet.handfast("up")
    assert told.stderr.count("up, nothing to do") == 3
    assert not fleet.hosts[2].pids(MODULE)
    table = fleet.handfast("status").stdout
    assert sum(" router " in line and " active " in line for line in table.splitlines()) == 2, table
    assert "router 1 36" in table, "so long its certificate holds"
    logs = fleet.handfast("logs").stdout
    assert "host2: router 2: router of delta on tls/" in logs
    keys = fleet.hosts[0].home / ".local/share/handfast/fleets/delta/keys"
    assert {path.name for path in keys.glob("*.router.*")} == {"delta.router.1.crt", "delta.router.1.key"}


def test_routers_that_die_and_a_host_that_is_cut_off_cost_a_moment(
    fleet: FleetOnHosts, tmp_path: Path
) -> None:
    """A fleet that has formed: how long robots take to get round each other that were cut off on their ways
    into formation is another matter (`tests.simulation`)."""
    fleet.handfast("drive", "--duration", "15s", "--out", str(tmp_path / "forms"), "--no-report")
    out = tmp_path / "run"
    child = fleet.start("drive", "--resume", "--duration", "32s", "--out", str(out), "--no-report")
    wait_for(lambda: all_drive(fleet), "all drive", 40.0)
    for host in list(fleet.hosts)[:2]:
        before = router(host)
        os.kill(before, signal.SIGKILL)
        starts_again(host, before)
        wait_for(lambda: all_drive(fleet), "all drive", 20.0)
    away = fleet.hosts[0]  # with the router that all are linked to, and robots 1 and 4
    away.cut()
    time.sleep(6.0)  # this is how long it is to be cut off
    away.restore()
    said = "\n".join(child.communicate(timeout=90.0))
    recording = read_run(out)
    assert not any(
        each.startswith("fault") for robot in ROBOTS for each in recording.robots[robot].status.states
    )
    back = {robot: back_s(recording, robot) for robot in ROBOTS}
    measured("back after the host of their router was cut off, s", max(back[2], back[3], back[5], back[6]))
    assert max(back[2], back[3], back[5], back[6]) < min(back[1], back[4]), f"{back}\n{said}"
    for robot in ROBOTS:
        data = recording.robots[robot].status
        driven = [state for t, state in zip(data.t, data.states, strict=True) if t < 31.5]
        assert driven[-1] == "running", f"robot {robot}: {driven[-1]}\n{said}"
    places = recording.hand_positions(np.array([31.5]))[0]
    for i, j in recording.fleet.formation.edges:
        apart = float(np.linalg.norm(places[i - 1] - places[j - 1]))
        assert apart == pytest.approx(1.0, abs=0.05), f"{i}-{j}\n{said}"


def test_a_stop_needs_no_router_and_up_brings_them_back(fleet: FleetOnHosts) -> None:
    fleet.handfast("drive", "--detach", "--resume", "--duration", "300")
    wait_for(lambda: all_drive(fleet), "all drive", 20.0)
    for host in list(fleet.hosts)[:2]:
        host.run(f"systemctl --user stop {ROUTER}", check=True)
    told = fleet.handfast("stop", "--each", "--reason", "a person on the field")
    assert told.stdout.count("over ssh to host") == len(ROBOTS), told.stdout + told.stderr
    told = fleet.handfast("up")
    assert told.stdout.splitlines()[:2] == ["router 1 on host1: up", "router 2 on host2: up"]
    assert told.stdout.count("stopped: stop: a person on the field") == len(ROBOTS), told.stdout


def test_routers_start_again_one_at_a_time_while_the_fleet_drives(fleet: FleetOnHosts) -> None:
    fleet.handfast("drive", "--detach", "--resume", "--duration", "300")
    wait_for(lambda: all_drive(fleet), "all drive", 20.0)
    before = [router(host) for host in list(fleet.hosts)[:2]]
    for number, host in enumerate(list(fleet.hosts)[:2], 1):
        (host.home / f".local/share/handfast/fleets/delta/keys/delta.router.{number}.crt").touch()
    told = fleet.handfast("up")
    assert told.stderr.count("its router started") == 2, told.stderr
    assert not {router(host) for host in list(fleet.hosts)[:2]} & set(before)
    assert all_drive(fleet)


def test_down_leaves_nothing(fleet: FleetOnHosts) -> None:
    told = fleet.handfast("down")
    assert "all robots brake" in told.stderr
    assert fleet.processes() == set()
    for host in fleet.hosts:
        assert not list((host.home / ".config/systemd/user").glob("handfast*"))
