"""What an operator's machine knows that a fleet on hosts was ordered last.

handfast.deploy.inventory.own_orders: names of new folders, and folders that are in the way.
"""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import own_orders
from handfast.deploy.inventory.own_orders import (
    OwnOrders,
    cache_folder,
    out_folder,
    refuse_full,
)

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


def test_a_folder_is_the_one_that_is_named_or_has_the_name_and_the_time() -> None:
    assert out_folder("there", "delta") == out_folder(Path("there"), "delta") == Path("there")
    assert re.fullmatch(r"runs/delta-\d{8}-\d{6}", out_folder(None, "delta").as_posix())
    assert re.fullmatch(r"sweeps/delta-\d{8}-\d{6}", out_folder("", "delta", "sweeps").as_posix())


def test_drives_that_begin_within_a_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20261126-120000")
    names = []
    for _ in range(3):
        folder = out_folder(None, "delta", str(tmp_path))
        folder.mkdir()
        names.append(folder.name)
    first = "delta-20261126-120000"
    assert names == [first, f"{first}-2", f"{first}-3"]


def test_what_is_there_and_not_an_empty_folder_is_refused(tmp_path: Path) -> None:
    refuse_full(tmp_path)
    refuse_full(tmp_path / "new")
    (tmp_path / "file").write_text("x")
    for full in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match=f"^{full} is not an empty folder: name another one with --out"):
            refuse_full(full)


def test_caches_are_where_the_user_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert cache_folder("wheels") == Path("/elsewhere/handfast/wheels")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder("wheels") == Path.home() / ".cache/handfast/wheels"
