"""A stop by the file that robots of this machine look for."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.runtime.order_store import STOP_FILE, OrderStore, packed, unpacked
from handfast.agent.security.private_files import private_directory
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.check.network import sharing
from handfast.deploy.orders.stop_outcome import Stopping
from handfast.deploy.session.stop_by_file import WAY, FileWay, kept_versions
from tests.unit.deploy.orders.order_fleets import square

FLEET = square()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    private_directory(tmp_path / "orders")
    return tmp_path / "orders"


def keep(folder: Path, robot: int, role: str, *orders: bytes) -> None:
    with OrderStore(folder, robot, role, lambda _: None) as store:
        store.keep(orders, orders)
        while store.done() is None:
            threading.Event().wait(0.002)


def test_it_lies_there_for_every_process(folder: Path) -> None:
    way, stop = FileWay(FLEET, folder), Stop(7, 7, "a person")
    way.send(stop)
    assert way.troubles == []
    assert [decode(order) for order in unpacked((folder / STOP_FILE).read_bytes())] == [stop]
    assert (folder / STOP_FILE).stat().st_mode & 0o077 == 0


def test_who_has_kept_it_is_known_to_brake(folder: Path) -> None:
    way, stopping = FileWay(FLEET, folder), Stopping(FLEET, time.time_ns(), "")
    way.send(stopping.message)
    keep(folder, 1, "agent", encode(Stop(3, 3, "an older one")))
    way.collect(stopping)
    assert not stopping.heard
    for robot in FLEET.ids:
        for role in ROLES:
            keep(folder, robot, role, encode(stopping.message), encode(Resume(2, 2, ())))
    (folder / f"robot-{FLEET.ids[0]}-agent.json").write_bytes(b"nonsense")
    way.collect(stopping)
    assert [robot for robot in FLEET.ids if not stopping.stands_by(robot)] == [FLEET.ids[0]]
    assert WAY in stopping.outcome(FLEET.ids[1])


def test_bodies_that_share_a_process_keep_it_together(folder: Path) -> None:
    fleet = parse_fleet(lattice("many", 30, rate_hz=25.0), source="here")
    way, stopping = FileWay(fleet, folder), Stopping(fleet, time.time_ns(), "")
    way.send(stopping.message)
    (first, *_), (other, *_) = sharing(fleet)
    assert first == 1
    for robot in fleet.ids:
        keep(folder, robot, "agent", encode(stopping.message))
    keep(folder, first, "plant", encode(stopping.message))
    way.collect(stopping)
    assert [robot for robot in fleet.ids if stopping.stands_by(robot)] == list(range(1, other))
    keep(folder, other, "plant", encode(stopping.message))
    way.collect(stopping)
    assert stopping.done


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    way = FileWay(FLEET, tmp_path / "nowhere")
    way.send(Stop(7, 7, ""))
    assert len(way.troubles) == 1
    assert "no such file or directory" in way.troubles[0]


def test_the_kept_versions_among_orders() -> None:
    orders = [encode(Stop(3, 3, "")), encode(Stop(5, 3, "")), encode(Resume(9, 3, ())), b"nonsense"]
    assert kept_versions(orders, is_secured=False) == (5, 9)
    assert kept_versions(orders, is_secured=True) == (-1, -1)
    assert kept_versions([], is_secured=False) == (-1, -1)
    assert packed(orders)
