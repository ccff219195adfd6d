"""Each host has something else wrong with it: it is said of that host, in one line, and the others run."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.hosts.computers import NOBODYS_ADDRESS
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, fetch_wheels
from tests.hosts.host import Setup
from tests.hosts.hosts import Hosts

pytestmark = pytest.mark.timeout(300)
GOOD = 2
WRONG = [
    (Setup(systemd=False), "no systemd answers root there: robots' processes are its user units."),
    (Setup(has_python=False), "there is no Python of 3.11 or later on its PATH"),
    (Setup(linger=False), "the processes of root would end with the last login: sudo loginctl enable-linger"),
    (Setup(home_mb=64), "the disk is full: "),
    (Setup(), "its host key is not the one that is known: another computer may pose as it."),
    (Setup(), "it does not let you in: put your public key there (ssh-copy-id "),
    (Setup(), "it is there, but no ssh server answers on that port"),
]
OTHER_KEY, LOCKED, WITHOUT_SSH = 6, 7, 8  # indices


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[Sequence[Setup]], Hosts]) -> Hosts:
    hosts = make_hosts([*(Setup() for _ in range(GOOD)), *(setup for setup, _ in WRONG)])
    hosts[OTHER_KEY].wrong_host_key()
    hosts[LOCKED].run("rm /etc/ssh/authorized_keys", check=True)
    hosts[WITHOUT_SSH].stop_sshd()
    return hosts


def tables(hosts: Hosts) -> dict[str, Any]:
    """Two robots on good hosts; all others, and one on a host that is not there, in reserve."""
    names = [*(host.name for host in hosts), "nobody"]
    addresses = [*(host.address for host in hosts), NOBODYS_ADDRESS]
    robots = [
        {"id": k + 1, "x_m": 1.0 * k, "y_m": 0.0, "host": name, "reserve": k >= GOOD}
        for k, name in enumerate(names)
    ]
    where = {name: {"address": address} for name, address in zip(names, addresses, strict=True)}
    return {
        "fleet": {"name": "many", "rate_hz": 25.0},
        "formation": {"edges": [[1, 2]], "distance_m": 1.0, "safe_distance_m": 0.2},
        "control": {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5},
        "trajectory": {"kind": "hold"},
        "host": where,
        "robot": robots,
    }


def test_each_failure_is_one_clear_line_and_the_others_run(hosts: Hosts, cache: Path, tmp_path: Path) -> None:
    fetch_wheels(hosts[0], cache)
    fleet = FleetOnHosts(hosts, tmp_path, tables(hosts), cache)
    fleet.handfast("keys")
    done = fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    lines = done.stderr.splitlines()
    failed = {line.partition(":")[0]: line for line in lines if ": FAILED: " in line}
    wanted = {hosts[GOOD + k].name: said for k, (_, said) in enumerate(WRONG)} | {"nobody": "it "}
    assert failed.keys() == wanted.keys(), done.stderr
    for name, said in wanted.items():
        assert failed[name].startswith(f"{name}: FAILED: {said}"), failed[name]
    for robot in (1, 2):
        assert f"robot {robot} on host{robot}: stopped: stop: the fleet came up" in done.stdout
    assert done.stdout.count("NOT UP") == len(wanted)

    told = fleet.handfast("status", status=1).stdout
    assert len(re.findall(r" active ", told)) == 3 * GOOD, told
    assert "host8: it does not let you in" in told
    assert "nobody: it " in told
    stopped = fleet.handfast("stop", "--each", status=1).stdout  # not all are there, but those that are stop
    assert "robot 1: stopped" in stopped or "robot 1: stopping" in stopped
    down = fleet.handfast("down", status=1)
    assert down.stderr.count("down, 6 units") + down.stderr.count("down, 3 units") == GOOD
    assert fleet.processes() == set()


@pytest.mark.long
def test_what_was_wrong_can_be_mended_and_up_goes_on(hosts: Hosts, cache: Path, tmp_path: Path) -> None:
    fleet = FleetOnHosts(hosts, tmp_path, tables(hosts), cache)
    fleet.handfast("keys")
    fleet.handfast("up", "--host", "host1", "--host", "host9", status=1, timeout=UP_TIMEOUT_S)
    hosts[WITHOUT_SSH].start_sshd()
    done = fleet.handfast("up", "--host", "host9", "--host", "host1", timeout=UP_TIMEOUT_S)
    assert "robot 9 on host9: stopped: stop" in done.stdout
    told = fleet.handfast("up", "--host", "nowhere", status=2).stderr
    assert "there is no host nowhere with robots in many; there are: host1, host2" in told
    fleet.handfast("down", "--host", "host1", "--host", "host9")
    assert fleet.processes() == set()
