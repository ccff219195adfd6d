"""Who rules a fleet on hosts: one authority, replaced while some hosts are away, and no second one unseen.

Each test goes on from the one before.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.security.credentials import authority_of
from handfast.deploy.inventory.operator_credentials import earlier_folders, short
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, fetch_wheels
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import ANNA, NAME, Operated, drives, pair, states
from tests.process.harness import wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(2)


@pytest.fixture(scope="module")
def made(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Operated:
    """Up, by the main operator."""
    fetch_wheels(hosts[0], cache)
    found = Operated(hosts, tmp_path_factory.mktemp("fleet"), pair(hosts), cache).of("main", "main")
    found.handfast("keys")
    found.handfast("up", timeout=UP_TIMEOUT_S)
    return found


@pytest.fixture
def fleet(made: Operated) -> Operated:
    return made.of("main", "main")


def certificates(host: Host) -> dict[str, bytes]:
    keys = host.home / f".local/share/handfast/fleets/{NAME}/keys"
    return {path.name: path.read_bytes() for path in keys.glob("*.crt")}


def test_a_second_authority_takes_nothing_over_unseen(fleet: Operated) -> None:
    """`keys` on a second operator's computer makes an authority of the same name; its `up` is refused."""
    true = authority_of(fleet.keys)
    fleet.of("main", "second")
    fleet.handfast("keys")
    false = authority_of(fleet.keys)
    before, processes = [certificates(host) for host in fleet.hosts], fleet.processes()
    told = fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    assert told.stderr.count("FAILED: left as it was") == 2
    why = f"its robots have another authority, {short(true)}; this machine's is {short(false)}. Ask"
    assert why in told.stderr
    assert "--take-over" in told.stderr
    assert [certificates(host) for host in fleet.hosts] == before
    assert fleet.processes() == processes
    # Nor does it give its own to a host that has none yet: a fleet shall not have two.
    keys = fleet.hosts[1].home / f".local/share/handfast/fleets/{NAME}/keys"
    keys.rename(keys.with_name("away"))
    told = fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    assert "host2: FAILED: left as it was: another authority rules on host1" in told.stderr
    assert not keys.exists()
    keys.with_name("away").rename(keys)


def test_a_second_operator_is_given_a_certificate(fleet: Operated) -> None:
    asked, signed = str(fleet.folder / "anna.csr"), str(fleet.folder / "anna.crt")
    fleet.of(ANNA, ANNA).handfast("keys", "--request", "--out", asked)
    told = fleet.handfast("stop", status=2).stderr
    assert "operator anna of pair has no certificate" in told
    said = fleet.of("main", "main").handfast("keys", "--sign", asked, "--out", signed).stdout
    assert short(authority_of(fleet.keys)) in said
    said = fleet.of(ANNA, ANNA).handfast("keys", "--install", signed).stdout
    assert short(authority_of(fleet.folder / "main")) in said
    assert not (fleet.keys / "authority.pem").exists()
    assert "nothing to do" in fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    drives(fleet)
    assert "robot 2: stop" in fleet.handfast("stop", "--each").stdout
    told = fleet.handfast("keys", status=2).stderr
    assert "has certificates of the authority" in told
    assert "which is not here" in told


def test_the_authority_is_not_replaced_while_the_fleet_drives(fleet: Operated) -> None:
    drives(fleet)
    before = authority_of(fleet.keys)
    told = fleet.handfast("keys", "--replace-authority", status=2).stderr
    assert "the authority was not replaced: robots 1 and 2 are on a mission: `handfast stop` first" in told
    assert authority_of(fleet.keys) == before
    fleet.handfast("stop")


def test_what_cannot_be_asked_may_drive(fleet: Operated) -> None:
    fleet.hosts[1].cut()
    told = fleet.handfast("keys", "--replace-authority", status=2).stderr
    fleet.hosts[1].restore()
    assert "the authority was not replaced: robot 2 cannot be asked, neither on the bus nor over ssh" in told


def test_half_replaced_it_drives_and_stops_and_up_goes_on(fleet: Operated) -> None:
    fleet.handfast("stop", status=None)
    before = authority_of(fleet.keys)
    fleet.handfast("keys", "--replace-authority")
    assert authority_of(fleet.keys) != before
    # No robot has the new one: the operator is not locked out.
    drives(fleet)
    told = fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    assert told.stderr.count("left as it was: the fleet drives, and would fall apart") == 2
    fleet.handfast("stop")
    assert set(states(fleet).values()) == {"stopped"}
    # One robot gets the new one, the other is away.
    fleet.hosts[1].stop_sshd()
    try:
        fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S)
    finally:
        fleet.hosts[1].start_sshd()
    assert len(earlier_folders(fleet.keys)) == 1
    fleet.handfast("resume", status=None)
    wait_for(lambda: {None, "stopped"}.isdisjoint(states(fleet).values()), "no robot is stopped", 30.0)
    told = fleet.handfast("stop", "--each").stdout
    assert told.count(": stop") == 2, told
    assert set(states(fleet).values()) == {"stopped"}
    # And `up` goes on from where it was.
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    assert "host1: up, nothing to do" in told
    assert "host2: up, robot 2 started" in told
    assert earlier_folders(fleet.keys) == []
    drives(fleet)
    fleet.handfast("stop")


def test_restored_from_its_backup_nothing_is_given_anew(fleet: Operated) -> None:
    backup = str(fleet.folder / "backup")
    fleet.handfast("keys", "--backup", backup)
    assert os.stat(backup).st_mode & 0o777 == 0o600
    before = [certificates(host) for host in fleet.hosts]
    rules = authority_of(fleet.keys)
    shutil.rmtree(fleet.keys)
    fleet.handfast("keys", "--restore", backup)
    assert authority_of(fleet.keys) == rules
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    assert told.count("up, nothing to do") == 2
    assert [certificates(host) for host in fleet.hosts] == before
    fleet.handfast("stop")


def test_status_says_how_long_certificates_hold(fleet: Operated) -> None:
    told = fleet.handfast("status").stdout
    assert "certificates hold for: operator main 36" in told
    assert "robots 36" in told


def test_a_lost_authority_is_taken_over_deliberately(fleet: Operated) -> None:
    fleet.of("main", "second")
    told = fleet.handfast("up", "--take-over", timeout=UP_TIMEOUT_S).stderr
    assert told.count("started") == 2
    assert "nothing to do" in fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    fleet.of("main", "main")
    assert "another authority" in fleet.handfast("up", status=1, timeout=UP_TIMEOUT_S).stderr
    fleet.of("main", "second").handfast("down")
