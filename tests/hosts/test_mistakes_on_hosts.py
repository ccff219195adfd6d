"""What operators do wrong with a fleet on two hosts, such as a clock that is ahead: `stop` still works.

Each test goes on from the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.security.certificates import DAY_S
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, fetch_wheels
from tests.hosts.hosts import Hosts
from tests.hosts.operated_fleet import ANNA, Operated, drives, enroll, pair, states, stopped
from tests.process.harness import wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(2)


@pytest.fixture(scope="module")
def made(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Operated:
    """Up; anna has a certificate, too."""
    fetch_wheels(hosts[0], cache)
    found = Operated(hosts, tmp_path_factory.mktemp("fleet"), pair(hosts), cache)
    found.of("main", "main").handfast("keys")
    enroll(found, ANNA)
    found.of("main", "main").handfast("up", timeout=UP_TIMEOUT_S)
    return found


@pytest.fixture
def fleet(made: Operated) -> Operated:
    return made.of("main", "main")


@pytest.mark.parametrize("ahead_s", [60.0, 3600.0])
def test_a_resume_of_a_clock_that_is_ahead_outlives_no_stop(fleet: Operated, ahead_s: float) -> None:
    drives(fleet)
    fleet.of(ANNA, ANNA, ahead_s)
    fleet.handfast("stop", "--reason", "anna's", status=None)
    fleet.handfast("resume", status=None)
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive again", 30.0)
    reason = f"main's, {ahead_s:.0f} s behind"
    told = fleet.of("main", "main").handfast("stop", "--each", "--reason", reason).stdout
    assert told.count(": stop") == 2
    stopped(fleet, reason)
    fleet.handfast("down")
    told = fleet.handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count(f"stopped: stop: {reason}") == 2, told
    stopped(fleet, reason)


def test_orders_of_a_clock_days_ahead_are_refused_but_stops(fleet: Operated) -> None:
    drives(fleet)
    fleet.of(ANNA, ANNA, 3 * DAY_S)
    fleet.handfast("stop", "--reason", "anna's, of a wrong clock")
    stopped(fleet, "anna's, of a wrong clock")
    for words in (("resume",), ("drive", "--detach", "--resume")):
        done = fleet.handfast(*words, status=None)
        assert done.returncode in (1, 2)
        told = done.stderr
        assert "set this machine's clock: it is 72 h ahead of the robots'" in told
    stopped(fleet, "anna's, of a wrong clock")
    # What is right goes on, and nothing is left of hers.
    fleet.of("main", "main").handfast("resume")
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive again", 30.0)
    told = fleet.of(ANNA, ANNA).handfast("status")
    assert "did not know" not in told.stderr
    fleet.handfast("stop", "--reason", "anna's, of a clock that was set")
    stopped(fleet, "anna's, of a clock that was set")
    drives(fleet.of("main", "main"))
    fleet.handfast("stop", "--reason", "main's")
    stopped(fleet, "main's")


def test_what_one_operator_stopped_and_took_down_is_lifted_by_no_other_unseen(
    fleet: Operated,
) -> None:
    """Their computers remember nothing of each other's orders: robots do."""
    drives(fleet)
    fleet.of(ANNA, ANNA).handfast("stop", "--reason", "a person on the field")
    fleet.handfast("down")
    told = fleet.of("main", "main").handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: a person on the field") == 2, told
    told = fleet.handfast("drive", "--detach", status=2).stderr
    assert "a person on the field; drive with --resume" in told


def test_a_stop_of_a_fleet_that_is_down_is_later_than_what_a_clock_that_was_ahead_has_left(
    fleet: Operated,
) -> None:
    drives(fleet)
    fleet.of(ANNA, ANNA, 3600.0).handfast("stop", "--reason", "of a clock that is ahead")
    fleet.of("main", "main").handfast("drive", "--detach", "--resume")
    fleet.of(ANNA, ANNA).handfast("down")
    fleet.of("main", "main").handfast("stop", "--reason", "a hole in the ground", status=1)
    told = fleet.of(ANNA, ANNA).handfast("up", timeout=UP_TIMEOUT_S).stdout
    assert told.count("stopped: stop: a hole in the ground") == 2, told
    told = fleet.handfast("drive", "--detach", status=2).stderr
    assert "a hole in the ground; drive with --resume" in told
