"""The hosts of a fleet, as commands find them.

How a host is logged in to, and what it means when that fails.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory import hosts
from handfast.deploy.inventory.hosts import hosts_of, located, refuse_simulated, robots_on, robots_text
from tests.process.harness import ROOT
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
    there = fleet(HOSTS + '[host.more]\nuser = "secret"\n')
    text = robots_text(there)
    assert parse_fleet(text, source="robots").agent_endpoint(2) == there.agent_endpoint(2)
    assert parse_fleet(text, source="robots").agent_listens(2) == ("tls/0.0.0.0:7602",)
    for word in ("secret", "user"):
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

    monkeypatch.setattr(hosts, "address_of", address)
    pair = fleet("[host.left]\n[host.right]\n")
    assert [host.address for host in located(pair).hosts] == ["left.example", "right.example"]


def test_what_the_fleet_file_leaves_out_is_left_to_the_configuration():
    words = hosts.command(HostSection("rover1"), "true")
    assert words[0] == "ssh"
    assert words[-3:] == ["--", "rover1", "true"]
    assert "BatchMode=yes" in words, "nobody is there to answer a question"
    assert "StrictHostKeyChecking=yes" in words
    assert not {"-l", "-p", "-i"} & set(words)
    assert not any("HostName" in word for word in words)


def test_what_it_gives_is_given():
    host = HostSection("rover1", "10.0.0.1", None, "robot")
    words = hosts.command(host, "true", accept_new=True)
    assert "HostName=10.0.0.1" in words
    assert words[words.index("-l") + 1] == "robot"
    assert "StrictHostKeyChecking=accept-new" in words
    assert "HostName=fd00::1" in hosts.command(HostSection("a", "[fd00::1]"), "true"), "ssh wants no brackets"


@pytest.mark.parametrize(
    ("said", "meaning"),
    [
        ("ssh: connect to host 10.0.0.9 port 22: Connection timed out", "it does not answer"),
        ("ssh: connect to host a port 22: Connection refused", "no ssh server answers"),
        ("ssh: connect to host a port 22: No route to host", "cannot be reached"),
        ("ssh: Could not resolve hostname rover9: Name or service not known", "give its address"),
        ("robot@10.0.0.1: Permission denied (publickey).", "(ssh-copy-id -o HostName=10.0.0.1 rover1)"),
        ("Warning: Identity file /k not accessible: No such file or directory.\n"
         "robot@10.0.0.1: Permission denied (publickey).", "the key file does not exist"),
        ("@@@\n@   WARNING: UNPROTECTED PRIVATE KEY FILE!   @\nbad permissions\n"
         "robot@10.0.0.1: Permission denied (publickey).", "others may read the key"),
        ("Warning: Identity file /k not accessible: No such file or directory.\n"
         "ssh: connect to host a port 22: Connection timed out", "it does not answer"),
        ("@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key for [10.0.0.7]:2222 has changed "
         "and you have requested strict checking.", "(ssh-keygen -R '[10.0.0.7]:2222')"),
        ("Host key verification failed.", "--accept-new-host-keys, which `up` and `sweep` take"),
        ("No ED25519 host key is known for 10.0.0.1 and you have requested strict checking.\n"
         "Host key verification failed.", "not known yet"),
        ("@@@\n@  WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @\nHost key verification failed.",
         "another computer may pose as it"),
        ("Timeout, server 10.0.0.1 not responding.", "it does not answer"),
        ("client_loop: send disconnect: Broken pipe", "the connection to it was lost"),
        ("something else\nentirely", "ssh: entirely"),
        ("", "the connection to it was lost"),
    ],
)  # fmt: skip
def test_failures_are_told_in_one_line_with_what_to_do(said: str, meaning: str):
    told = hosts.reason(HostSection("rover1", "10.0.0.1"), said)
    assert meaning in told
    assert "\n" not in told


def test_what_is_to_be_typed_reaches_the_host():
    host = HostSection("rover1", "[fd00::1]", None, "robot")
    assert hosts.by_hand(host) == "ssh -o HostName=fd00::1 robot@rover1"
    assert hosts.by_hand(HostSection("rover1")) == "ssh rover1", "as its configuration says"
    assert "ssh-keygen -R fd00::1)" in hosts.reason(host, "REMOTE HOST IDENTIFICATION HAS CHANGED")


def test_only_ssh_is_read_as_ssh():
    host = HostSection("rover1")
    assert "let you in" in hosts.ended(host, 255, "Permission denied")
    assert hosts.ended(host, 1, "a\nPermission denied") == (
        "the program there ended (status 1): Permission denied"
    )
    assert hosts.ended(host, -9, "anything") == hosts.LOST


def test_a_terminal_is_safe_from_what_a_host_says():
    assert "\x1b" not in hosts.reason(HostSection("a"), "\x1b[31mred")


def test_as_many_files_may_be_open_as_the_user_may_have() -> None:
    """In a process of its own: it holds for all of it."""
    script = (
        "import resource\n"
        "from handfast.deploy.inventory import hosts\n"
        "_, most = resource.getrlimit(resource.RLIMIT_NOFILE)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, most))\n"
        "hosts.allow_many()\n"
        "assert resource.getrlimit(resource.RLIMIT_NOFILE) == (most, most)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)
