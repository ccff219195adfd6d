"""The hosts of a fleet, as commands find them."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory import ssh
from handfast.deploy.inventory.hosts import hosts_of, located, refuse_simulated, robots_on, robots_text
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, RIGHT, fleet

NAMED = '[host.left]\n[host.right]\naddress = "10.0.0.2"\n[host.spare]\n'


@pytest.fixture
def configured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ssh that knows where `left` is."""
    ssh = tmp_path / "ssh"
    ssh.write_text("#!/bin/sh\nfor last; do :; done\necho user me\necho hostname $last.lan\n")
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")


def test_an_address_that_is_left_out_is_that_of_the_ssh_configuration(configured: None) -> None:
    there = located(fleet(NAMED))
    assert there.agent_endpoint(1) == "tls/left.lan:7600"
    assert there.agent_endpoint(2) == "tls/10.0.0.2:7602"
    assert [host.address for host in there.hosts] == ["left.lan", "10.0.0.2", None], (
        "nobody is on the spare one"
    )


def test_two_names_for_one_computer_are_found_where_only_ssh_knows(configured: None) -> None:
    both = NAMED.replace("10.0.0.2", "LEFT.lan")
    with pytest.raises(InputError, match=r"^hosts left and right both have the address LEFT.lan: robots may"):
        located(fleet(both))
    assert located(fleet(both, second=LEFT)).hosts[0].address == "left.lan", "nobody is on the other one"


def test_without_ssh_it_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert located(fleet(HOSTS)) == fleet(HOSTS), "nobody has to be asked"
    with pytest.raises(InputError, match="host left: there is no ssh on this machine"):
        located(fleet(NAMED))


def test_only_hosts_with_robots_count() -> None:
    there = fleet(NAMED)
    assert [host.name for host in hosts_of(there, "f")] == ["left", "right"]
    assert [host.name for host in hosts_of(there, "f", ["right"])] == ["right"]
    with pytest.raises(InputError, match="there is no host spare with robots in two; there are: left, right"):
        hosts_of(there, "f", ["spare"])
    with pytest.raises(FleetError, match=r"no robot has a host: write \[host.NAME\]"):
        hosts_of(fleet("", "", ""), "f")


def test_robots_read_nothing_of_how_the_operator_logs_in() -> None:
    there = fleet(HOSTS + '[host.more]\nkey = "~/.ssh/secret"\nport = 2222\nuser = "root"\n')
    text = robots_text(there)
    assert parse_fleet(text, source="robots").agent_endpoint(2) == there.agent_endpoint(2)
    assert parse_fleet(text, source="robots").agent_listens(2) == ("tls/0.0.0.0:7602",)
    for word in ("secret", "2222", "user"):
        assert word not in text


def test_who_is_where() -> None:
    there: Fleet = fleet(HOSTS, LEFT, LEFT)
    assert robots_on(there, there.hosts[0]) == (1, 2)
    assert robots_on(there, there.hosts[1]) == ()


def test_a_simulated_rover_cannot_be_on_a_host() -> None:
    rover = RIGHT + '\nplant = "mavlink"\nmavlink = { connection = "simulator" }'
    there = fleet(HOSTS + "[datum]\nlatitude_deg = 1\nlongitude_deg = 1", LEFT, rover)
    with pytest.raises(FleetError, match=r'robot\[2\].mavlink.connection: "simulator" is for `run`'):
        refuse_simulated(there, "f")
    refuse_simulated(fleet(HOSTS), "f")


def test_where_hosts_are_is_asked_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop waits for it."""
    together = threading.Barrier(2, timeout=10.0)

    def address(host: HostSection) -> str:
        together.wait()
        return f"{host.name}.example"

    monkeypatch.setattr(ssh, "address_of", address)
    pair = fleet("[host.left]\n[host.right]\n")
    assert [host.address for host in located(pair).hosts] == ["left.example", "right.example"]
