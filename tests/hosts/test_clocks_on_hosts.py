"""`stop` of operators whose clocks are hours or days off, with keys that were made minutes ago, by one way
alone or all, of robots that drive, stand or are down: the last one that somebody meant holds.

Each test goes on from the one before.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from handfast.agent.security.certificates import DAY_S
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, fetch_wheels
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import ANNA, Operated, drives, enroll, pair, stopped

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
CLOSED = """table inet closed {{
    chain input {{ type filter hook input priority 0; ip saddr {operator} tcp dport {ports} drop; }}
}}
"""
BUT_SSH = "!= 22"
SSH = "22"
HOUR_S = 3600.0
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
def closed(hosts: Hosts, ports: str) -> Iterator[None]:
    """Nothing of the operator's computer comes to these ports."""
    rules = CLOSED.format(operator=hosts.operator.address, ports=ports)
    for host in hosts:
        host.run(["nft", "-f", "-"], input=rules, check=True)
    try:
        yield
    finally:
        for host in hosts:
            host.run(["nft", "delete", "table", "inet", "closed"], check=True)


@pytest.mark.parametrize(
    ("ahead_s", "words"),
    [
        (25 * HOUR_S, "it is 25 h ahead of the robots'"),
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
    with closed(hosts, BUT_SSH):
        done = fleet.of(who, who, ahead_s).handfast("stop", "--reason", reason, status=None)
        told = done.stdout + done.stderr
        stopped(fleet, reason)
    assert done.returncode == 0, told
    assert "(2 over ssh)" in told, told
    assert f"set this machine's clock: {words}" in told


def test_who_cannot_renew_a_certificate_tries_the_links_with_it(fleet: Operated, hosts: Hosts) -> None:
    """Robots judge it by their clocks."""
    drives(fleet)
    with closed(hosts, SSH):
        done = fleet.of(ANNA, ANNA, -2 * HOUR_S).handfast("stop", "--reason", "no ssh")
        stopped(fleet, "no ssh")
    assert "2 of 2 robots brake" in done.stdout
    assert "(2 over a new link)" in done.stdout
    assert "anna is not valid yet: is this machine's clock right?" in done.stderr


def test_of_a_clock_that_was_ahead_and_is_behind_the_last_holds(fleet: Operated) -> None:
    drives(fleet)
    fleet.of(ANNA, ANNA, 25 * HOUR_S).handfast("stop", "--reason", "ahead")
    stopped(fleet, "ahead")
    fleet.of(ANNA, ANNA, -25 * HOUR_S).handfast("stop", "--reason", "behind")
    stopped(fleet, "behind")


@pytest.mark.parametrize("ahead_s", [-2 * HOUR_S, 400 * DAY_S])
def test_of_robots_that_stand_for_a_regular_stop_it_is_meant(
    fleet: Operated, hosts: Hosts, ahead_s: float
) -> None:
    """That one was given by a clock that is right; no drive is to lift this one without a word."""
    drives(fleet)
    fleet.handfast("stop", "--reason", "before")
    fleet.handfast("drive", "--resume", "--duration", "1", "--no-report")
    stopped(fleet, "the run is over")
    reason = f"meant, {ahead_s:.0f} s off"
    with closed(hosts, BUT_SSH):
        fleet.of(ANNA, ANNA, ahead_s).handfast("stop", "--reason", reason)
    stopped(fleet, reason)
    told = fleet.of("main", "main").handfast("drive", "--detach", status=2).stderr
    assert f"{reason}; drive with --resume" in told
    drives(fleet)
    fleet.handfast("stop", "--reason", "after")


def test_of_a_fleet_that_is_down_it_says_so_at_once_and_holds_when_it_comes_up(
    fleet: Operated, hosts: Hosts
) -> None:
    """Though a clock that was ahead has left a later order there, which this operator does not know of."""
    drives(fleet)
    fleet.of(ANNA, ANNA, HOUR_S).handfast("stop", "--reason", "the run is over")
    fleet.handfast("down")
    began_s = time.monotonic()
    told = fleet.of("main", "main").handfast("stop", "--each", "--reason", "a hole", status=1).stdout
    assert time.monotonic() - began_s < SOON_S
    assert told.count("is down; it finds the stop when it comes up (over ssh to host") == 2, told
    told = fleet.of(ANNA, ANNA).handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: a hole") == 2, told


def test_of_two_stops_of_a_fleet_that_is_down_the_last_holds(fleet: Operated) -> None:
    fleet.handfast("down")
    for who, ahead_s, reason in (("main", 0.0, "first"), (ANNA, -2 * HOUR_S, "then"), ("main", 0.0, "last")):
        fleet.of(who, who, ahead_s).handfast("stop", "--reason", reason, status=1)
    told = fleet.of(ANNA, ANNA).handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: last") == 2, told
    # Who gave one of those before, and knows of no later one, keeps to what the hosts say.
    fleet.handfast("down")
    fleet.of("main", "main").handfast("stop", "--reason", "main's", status=1)
    fleet.of(ANNA, ANNA, -2 * HOUR_S).handfast("stop", "--reason", "anna's, after it", status=1)
    told = fleet.of("main", "main").handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: anna's, after it") == 2, told
