"""`stop` of an operator whose clock is hours or days off, with keys that were made minutes ago, while nothing
but ssh gets through to the robots' computers.

Each test goes on from the one before.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent.security.certificates import DAY_S
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, fetch_wheels
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import ANNA, Operated, drives, enroll, pair, stopped

pytestmark = pytest.mark.timeout(400)
ONLY_SSH = """table inet only_ssh {{
    chain input {{ type filter hook input priority 0; ip saddr {operator} tcp dport != 22 drop; }}
}}
"""
SOON_S = 5.0
"""A stop that waits for what does not come waits longer."""


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    if shutil.which("nft") is None:
        pytest.skip("nft is not installed: apt-get install nftables")
    return make_hosts(2)


@pytest.fixture(scope="module")
def made(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Operated:
    fetch_wheels(hosts[0], cache)
    found = Operated(hosts, tmp_path_factory.mktemp("fleet"), pair(hosts), cache)
    found.of("main", "main").handfast("keys")
    enroll(found, ANNA)
    found.of("main", "main").handfast("up", timeout=UP_TIMEOUT_S)
    return found


@pytest.fixture
def fleet(made: Operated) -> Operated:
    return made.of("main", "main")


@contextmanager
def only_ssh(hosts: Hosts) -> Iterator[None]:
    rules = ONLY_SSH.format(operator=hosts.operator.address)
    for host in hosts:
        host.run(["nft", "-f", "-"], input=rules, check=True)
    try:
        yield
    finally:
        for host in hosts:
            host.run(["nft", "delete", "table", "inet", "only_ssh"], check=True)


@pytest.mark.parametrize(
    ("ahead_s", "words"),
    [
        (400 * DAY_S, "it is 9600 h ahead of the robots'"),
        (-7200.0, "it is 2 h behind the robots'"),
        (-3 * DAY_S, "it is 72 h behind the robots'"),
    ],
)
@pytest.mark.parametrize("who", ["main", ANNA])
def test_all_stop_and_it_says_what_is_wrong(
    fleet: Operated, hosts: Hosts, who: str, ahead_s: float, words: str
) -> None:
    """The authority is with main; anna cannot renew her certificate."""
    drives(fleet)
    reason = f"{who}'s, {ahead_s:.0f} s off"
    with only_ssh(hosts):
        done = fleet.of(who, who, ahead_s).handfast("stop", "--reason", reason, status=None)
        told = done.stdout + done.stderr
        stopped(fleet, reason)
    assert done.returncode == 0, told
    assert told.count("over ssh") == 2, told
    assert f"set this machine's clock: {words}" in told


def test_of_a_fleet_that_is_down_it_says_so_at_once_and_holds_when_it_comes_up(
    fleet: Operated, hosts: Hosts
) -> None:
    """Though a clock that was ahead has left a later order there, which this operator does not know of."""
    drives(fleet)
    fleet.of(ANNA, ANNA, 3600.0).handfast("stop", "--reason", "the run is over")
    fleet.handfast("down")
    began_s = time.monotonic()
    told = fleet.of("main", "main").handfast("stop", "--reason", "a hole", status=1).stdout
    assert time.monotonic() - began_s < SOON_S
    assert told.count("is down; it finds the stop when it comes up (over ssh to host") == 2, told
    told = fleet.of(ANNA, ANNA).handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: a hole") == 2, told
