"""The rules and the WireGuard configuration of docs/firewall.md, on test hosts with a stranger among them."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.flood_on_hosts import flood
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.process.harness import ROOT, wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
CALM = {"rate_hz": 25.0}
PATIENT = {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
BASE_PORT = 7600
FLOOD_PER_S = 300
TRIES = 10
OPENS = """
import socket, sys
def opens():
    with socket.socket() as made:
        made.settimeout(0.2)
        return made.connect_ex((sys.argv[1], int(sys.argv[2]))) == 0
print(sum(opens() for _ in range(int(sys.argv[3]))))
"""


def block(kind: str) -> str:
    """The page's block of code of that kind."""
    (found,) = re.findall(
        rf"^```{kind}\n(.*?)^```$", (ROOT / "docs/firewall.md").read_text(), re.MULTILINE | re.DOTALL
    )
    return str(found)


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    for program, package in (("nft", "nftables"), ("wg-quick", "wireguard-tools")):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed: apt-get install {package}")
    return make_hosts(3)


@pytest.fixture(scope="module")
def stranger(hosts: Hosts) -> Host:
    return hosts[2]


def opened(by: Host, address: str) -> int:
    """How many of several connections to the first robot's agent open."""
    words = ["python3", "-c", OPENS, address, str(BASE_PORT), str(TRIES)]
    return int(by.run(words, check=True).stdout)


def load(hosts: list[Host], rules: str) -> None:
    for host in hosts:
        for _ in range(2):  # the second replaces the first
            host.run(["nft", "-f", "-"], input=rules, check=True)


def drives_and_stops_in_a_flood(fleet: FleetOnHosts, stranger: Host) -> None:
    """Has an agent find all others while a stranger floods every port, and an operator stop the fleet."""
    fleet.handfast("resume")
    with flood(stranger, fleet, FLOOD_PER_S):
        before = fleet.process(6, "agent")  # it dials all others
        os.kill(before, signal.SIGKILL)
        fleet.started_again(6, "agent", before)
        wait_for(lambda: fleet.status()[6, "agent"]["state"] == "ready", "it has found all others")
        assert "robot 6: stop" in fleet.handfast("stop", "--each").stdout


def test_the_rules_let_the_fleet_through_and_no_stranger(
    hosts: Hosts, stranger: Host, cache: Path, tmp_path: Path
) -> None:
    own = list(hosts)[:2]
    fetch_wheels(own[0], cache)
    known = ", ".join([hosts.operator.address, *(host.address for host in own)])
    rules, count = re.subn(r"(?m)^define known = .*$", f"define known = {{ {known} }}", block("nft"))
    assert count == 1
    fleet = FleetOnHosts(hosts, tmp_path, delta(own, fleet=CALM, control=PATIENT), cache)
    fleet.handfast("keys")
    fleet.handfast("up", timeout=UP_TIMEOUT_S)
    try:
        assert opened(stranger, own[0].address) == TRIES
        load(own, rules)
        assert opened(own[1], own[0].address) == TRIES
        assert opened(stranger, own[0].address) == 0
        drives_and_stops_in_a_flood(fleet, stranger)
    finally:
        fleet.handfast("down")
        for host in own:
            host.run(["nft", "delete", "table", "inet", "handfast"])


@pytest.fixture
def tunnels(hosts: Hosts, tmp_path: Path) -> Iterator[Mapping[str, str]]:
    """WireGuard on two hosts and the operator's computer, as the page says; the hosts' addresses in it."""
    own = list(hosts)[:2]
    outside = {host.name: host.address for host in own} | {"operator": hosts.operator.address}
    inside = {name: f"10.77.0.{11 + index}" for index, name in enumerate(outside)}
    interface, peer = block("ini").split("\n[Peer]\n")
    folder = tmp_path / "wireguard"
    folder.mkdir()

    def operator(words: str, text: str | None = None) -> str:
        # The operator's computer shares /etc with this machine: its files lie elsewhere.
        done = hosts.operator.run(["sh", "-c", words.replace("/etc/wireguard", str(folder))], input=text)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run = {
        host.name: lambda words, text=None, host=host: host.run(words, input=text, check=True).stdout
        for host in own
    } | {"operator": operator}
    public = {}
    for name, at in run.items():
        at("mkdir -p /etc/wireguard; umask 077; wg genkey > /etc/wireguard/key")
        public[name] = at("wg pubkey < /etc/wireguard/key").strip()
    for name, at in run.items():
        peers = [
            peer.replace("PUBLIC-KEY-OF-ROVER2", public[other])
            .replace("10.77.0.12", inside[other])
            .replace("192.168.1.12", outside[other])
            for other in run
            if other != name
        ]
        text = "\n[Peer]\n".join([interface.replace("10.77.0.11", inside[name]), *peers])
        where = "/etc/wireguard/wg0.conf"
        at(f"cat > {where}", text if name != "operator" else text.replace("/etc/wireguard", str(folder)))
        at(f"wg-quick up {where}")
    yield inside
    for at in run.values():
        at("wg-quick down /etc/wireguard/wg0.conf")


def test_through_wireguard_the_fleet_drives_and_a_neighbour_has_no_way_in(
    hosts: Hosts, stranger: Host, tunnels: Mapping[str, str], cache: Path, tmp_path: Path
) -> None:
    own = list(hosts)[:2]
    fetch_wheels(own[0], cache)
    tables = delta(own, fleet=CALM, control=PATIENT)
    tables["host"] = {host.name: {"address": tunnels[host.name]} for host in own}
    first = tunnels[own[0].name]
    fleet = FleetOnHosts(hosts, tmp_path, tables, cache)
    fleet.handfast("keys")
    fleet.handfast("up", "--accept-new-host-keys", timeout=UP_TIMEOUT_S)
    try:
        for host in own:  # a neighbour's own route to the fleet's addresses
            route = ["ip", "route", "replace", tunnels[host.name], "via", host.address]
            stranger.run(route, check=True)
        assert opened(own[1], first) == TRIES
        assert opened(stranger, first) == TRIES, "the address alone does not keep it out"
        load(own, "".join(line for line in block("nft").splitlines(True) if "$known" not in line))
        assert opened(own[1], first) == TRIES
        assert opened(stranger, first) == 0
        drives_and_stops_in_a_flood(fleet, stranger)
    finally:
        fleet.handfast("down")
        for host in own:
            host.run(["nft", "delete", "table", "inet", "handfast"])
