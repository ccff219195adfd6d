"""Who rules a fleet on hosts: one authority, replaced with the fleet down, and no second one unseen.

Each test goes on from the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.security.credentials import authority_of
from handfast.deploy.inventory.operator_credentials import short
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, fetch_wheels
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import ANNA, NAME, Operated, drives, pair, states

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
    assert "`handfast down" in told.stderr
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


def test_status_says_how_long_certificates_hold(fleet: Operated) -> None:
    told = fleet.handfast("status").stdout
    assert "certificates hold for: operator main 36" in told
    assert "robots 36" in told


def test_an_authority_is_replaced_with_the_fleet_down(fleet: Operated) -> None:
    before = authority_of(fleet.keys)
    told = fleet.handfast("keys", "--new-authority", status=2).stderr
    assert "`handfast down` first" in told
    assert authority_of(fleet.keys) == before
    fleet.handfast("down")
    fleet.handfast("keys", "--new-authority")
    assert authority_of(fleet.keys) != before
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S).stderr
    assert told.count(f"its robots had another authority, {short(before)}") == 2
    assert told.count("started") == 2
    drives(fleet)
    # An operator of the previous authority is shut out.
    told = fleet.of(ANNA, ANNA).handfast("stop", status=None).stderr
    assert "its certificate is not from this fleet's authority" in told
    assert set(states(fleet.of("main", "main")).values()) == {"running"}
    fleet.handfast("stop")
    assert set(states(fleet).values()) == {"stopped"}
    fleet.handfast("down")
