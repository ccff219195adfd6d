"""What an operator's machine knows that a fleet on hosts was ordered last."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import own_orders
from handfast.deploy.inventory.own_orders import OwnOrders

HOSTS = """
robot = [{ id = 1, x_m = 0, y_m = 0, host = "h" }, { id = 2, x_m = 1.5, y_m = 0.2, host = "h" }]
fleet = { name = "two" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }
host = { h = { address = "10.0.0.1" } }
"""
STOP, RESUME, MISSION = Stop(5, 5, "lunch"), Resume(6, 6, ()), Mission(7, 7, 8, 9, "digest")


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture
def fleet() -> Fleet:
    return parse_fleet(HOSTS, source="here")


def test_the_newest_of_each_kind_outlive_the_command(fleet: Fleet) -> None:
    own = OwnOrders(fleet)
    assert own.orders == ()
    for order in (MISSION, RESUME, STOP, Stop(4, 4, "older"), Mission(6, 7, 8, 9, "older")):
        own.keep(order)
    assert OwnOrders(fleet).orders == (STOP, RESUME, MISSION)
    assert own.trouble == ""


def test_what_a_clock_that_was_ahead_gave_is_nothing_to_go_by_but_a_stop(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, ahead = OwnOrders(fleet), 3 * 86_400 * 10**6
    now_us = 1_790_000_000 * 10**6
    for order in (STOP, RESUME, MISSION):
        own.keep(order._replace(version=now_us + ahead))
    monkeypatch.setattr(own_orders.time, "time_ns", lambda: now_us * 1_000)
    taken = STOP._replace(version=now_us)
    assert OwnOrders(fleet).orders == (taken,)
    monkeypatch.setattr(own_orders.time, "time_ns", lambda: (now_us + 7) * 1_000)
    assert OwnOrders(fleet).orders == (taken,), "not anew each time: somebody may have lifted it"


def test_a_stop_of_robots_time_takes_the_place_of_one_of_a_wrong_clock(fleet: Fleet) -> None:
    own = OwnOrders(fleet)
    own.keep(STOP._replace(version=10**15))
    own.put(STOP)
    assert OwnOrders(fleet).orders == (STOP,)


def test_of_a_fleet_on_this_machine_nothing_is_kept(tmp_path: Path) -> None:
    pair = load_fleet(FLEETS / "pair.toml")
    OwnOrders(pair).keep(STOP)
    assert OwnOrders(pair).orders == ()
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_file_is_said_and_written_anew(fleet: Fleet, tmp_path: Path) -> None:
    OwnOrders(fleet).keep(STOP)
    path = next(tmp_path.rglob("orders/*.json"))
    path.write_bytes(path.read_bytes()[:-9])
    own = OwnOrders(fleet)
    assert own.orders == ()
    assert str(path) in own.trouble
    assert "damaged" in own.trouble
    own.keep(RESUME)
    assert (own.trouble, OwnOrders(fleet).orders) == ("", (RESUME,))


def test_a_disk_that_cannot_be_written_is_said(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    own = OwnOrders(fleet)
    own.keep(STOP)
    assert own.orders == (STOP,)
    assert own.trouble.startswith("this machine will not remember the order: cannot make the folder")


def test_what_cannot_be_kept_is_said(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = OwnOrders(fleet)
    own.warn()
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/nowhere")
    own = OwnOrders(fleet)
    own.keep(STOP)
    own.warn()
    assert capsys.readouterr().err.startswith(
        "warning: this machine will not remember the order: cannot make"
    )
