"""A secured fleet whose ports somebody floods who has no certificate, from a computer that is none of its.

First behind its proxies, then behind the firewall of `handfast firewall` as well. Each test goes on from the
one before.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.flood_on_hosts import flood
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.process.harness import wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
CALM = {"rate_hz": 25.0}
PATIENT = {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
ROBOTS = range(1, 7)
BASE_PORT = 7600
FLOOD_PER_S = 300
TRIES = 30
OPENS = """
import socket, sys
def opens():
    with socket.socket() as made:
        made.settimeout(0.2)
        return made.connect_ex((sys.argv[1], int(sys.argv[2]))) == 0
print(sum(opens() for _ in range(int(sys.argv[3]))))
"""


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(3)


@pytest.fixture(scope="module")
def stranger(hosts: Hosts) -> Host:
    return hosts[2]


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    fetch_wheels(hosts[0], cache)
    tables = delta(list(hosts)[:2], fleet=CALM, control=PATIENT, network={"admission": "proxy"})
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables, cache)
    found.handfast("keys")
    told = found.handfast("up", timeout=UP_TIMEOUT_S)
    for robot in ROBOTS:
        assert (
            f"robot {robot} on {found.host_of(robot).name}: stopped: stop: the fleet came up" in told.stdout
        )
    found.handfast("resume")
    return found


def test_each_robot_has_a_proxy(fleet: FleetOnHosts) -> None:
    rows = fleet.status()
    assert {role for _, role in rows} == {"agent", "plant", "recorder", "admission"}
    assert all(row["unit"] == "active" for row in rows.values())
    assert fleet.handfast("up").stderr.count("up, nothing to do") == 2


def test_a_robot_starts_again_and_is_stopped_in_a_flood(fleet: FleetOnHosts, stranger: Host) -> None:
    with flood(stranger, fleet, FLOOD_PER_S):
        told = f"admission: refused: connections of {stranger.address}: "
        wait_for(lambda: told in fleet.handfast("logs").stdout, "the flood has begun")
        before = fleet.process(6, "agent")  # which dials all others
        os.kill(before, signal.SIGKILL)
        fleet.started_again(6, "agent", before)
        wait_for(lambda: fleet.status()[6, "agent"]["state"] == "ready", "it has found all others")
        assert "robot 6: stop" in fleet.handfast("stop", "--each").stdout
    fleet.handfast("resume")


def test_a_proxy_that_was_killed_is_there_again(fleet: FleetOnHosts) -> None:
    host = fleet.host_of(1)
    (before,) = (pid for pid, words in host.pids("-m agent.admission ").items() if "--robot 1 " in words)
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: fleet.status()[1, "admission"]["restarts"] == 1, "it starts again")
    wait_for(lambda: fleet.status()[1, "agent"]["state"] == "ready", "its links are there again")


def test_a_firewall_lets_few_connections_of_strangers_through(fleet: FleetOnHosts, stranger: Host) -> None:
    if shutil.which("nft") is None:
        pytest.skip("nft is not installed: apt-get install nftables")
    host, other = fleet.host_of(1), fleet.host_of(2)
    rules = fleet.handfast("firewall", "--known", fleet.hosts.operator.address).stdout
    for _ in range(2):  # it takes its own place
        host.run(["nft", "-f", "-"], input=rules, check=True)

    def opened(by: Host, port: int) -> int:
        words = ["python3", "-c", OPENS, host.address, str(port), str(TRIES)]
        return int(by.run(words, check=True).stdout)

    assert opened(other, BASE_PORT) == TRIES
    assert 1 <= opened(stranger, BASE_PORT) <= TRIES // 2
    assert fleet.handfast("up").stderr.count("up, nothing to do") == 2
    rules = fleet.handfast("firewall", "--device", "wg0").stdout
    host.run(["nft", "-f", "-"], input=rules, check=True)
    assert opened(other, BASE_PORT) == 0  # it comes through eth0, whatever address it asks for
    assert opened(host, BASE_PORT) == TRIES
    host.run(["nft", "delete", "table", "inet", f"handfast_{fleet.name}"], check=True)
    wait_for(lambda: fleet.status()[1, "agent"]["state"] == "ready", "it is reached again")


def test_down(fleet: FleetOnHosts) -> None:
    fleet.handfast("down")
    assert fleet.processes() == set()
