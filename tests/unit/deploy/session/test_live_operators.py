"""A stop over the links of a command that lives: real sockets, a bus that only notes what is said."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Message, PlantState, Status, Stop
from handfast.agent.runtime import order_store
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.orders import stop_outcome
from handfast.deploy.orders.stop_outcome import Stopping
from handfast.deploy.session import live_operators
from handfast.deploy.session.live_operators import WAY, LiveWay, StopDoor
from tests.unit.deploy.orders.order_fleets import square

FLEET = square()
NAME = FLEET.fleet.name


class NotingBus:
    def __init__(self) -> None:
        self.said: list[tuple[str, Message]] = []

    def publish(self, key: str, payload: bytes) -> None:
        self.said.append((key, decode(payload)))


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """One of a short name: the path of a socket has some 100 bytes."""
    with tempfile.TemporaryDirectory(prefix="hf") as folder:
        monkeypatch.setattr(order_store.tempfile, "gettempdir", lambda: folder)
        yield


@pytest.fixture
def bus() -> NotingBus:
    return NotingBus()


@pytest.fixture
def door(bus: NotingBus) -> Iterator[StopDoor]:
    with StopDoor(FLEET, bus) as made:
        yield made


@pytest.fixture
def way() -> Iterator[LiveWay]:
    made = LiveWay(FLEET)
    yield made
    made.close()


def braked(robot: int, stop: Stop) -> list[tuple[str, Message]]:
    status = Status(robot, 1, stop.time_ns, "stopping", "", "", 1, stop.version, (), (), (), ())
    plant = PlantState(robot, 1, stop.time_ns, *[0.0] * 7, False, True, True, "")
    return [
        (key_expressions.status(NAME, robot), status),
        (key_expressions.plant_state(NAME, robot), plant),
    ]


def test_it_is_said_on_the_open_links_and_what_comes_back_is_told(
    door: StopDoor, bus: NotingBus, way: LiveWay
) -> None:
    stopping = Stopping(FLEET, time.time_ns(), "a person")
    way.send(stopping.message)
    assert door.step() == [stopping.message]
    assert bus.said == [(key_expressions.stop(NAME), stopping.message)]
    for robot in FLEET.ids:
        for key, message in braked(robot, stopping.message):
            door.heard(key, encode(message))
        door.heard(key_expressions.hand(NAME, robot), b"of no interest")
        way.collect(stopping)
    assert stopping.done
    assert all(f"({WAY})" in stopping.outcome(robot) for robot in FLEET.ids)


def test_it_is_said_again_for_a_while(
    door: StopDoor, bus: NotingBus, way: LiveWay, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = time.monotonic()
    monkeypatch.setattr(live_operators.time, "monotonic", lambda: now_s)
    way.send(Stop(5, 5, ""))
    assert door.step()
    assert door.step() == []
    assert len(bus.said) == 1
    now_s += stop_outcome.AGAIN_S
    door.step()
    assert len(bus.said) == 2
    now_s += live_operators.FOLLOW_S
    door.step()
    assert len(bus.said) == 2


def test_to_many_it_is_said_more_seldom(bus: NotingBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 robots and their plants had 50 of them to hear, while they were to brake."""
    fleet = resolved(parse_fleet(lattice("many", 100), source="here"))
    begun_s = now_s = time.monotonic()
    monkeypatch.setattr(live_operators.time, "monotonic", lambda: now_s)
    with StopDoor(fleet, bus) as door, closing(LiveWay(fleet)) as way:
        way.send(Stop(5, 5, ""))
        while now_s < begun_s + 1.0:
            door.step()
            now_s += 0.01
    assert len(bus.said) == 5


def test_nothing_but_a_stop_is_passed_on(door: StopDoor, bus: NotingBus) -> None:
    path = next(order_store.private_folder().glob("live-*.sock"))
    with live_operators._socket() as asks:
        for payload in (b"", b"nonsense", encode(braked(1, Stop(1, 1, ""))[0][1])):
            asks.sendto(payload, str(path))
    assert door.step() == []
    assert bus.said == []


def test_who_only_drives_pays_for_no_messages(door: StopDoor, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> bytes:
        raise AssertionError("packed for nobody")

    monkeypatch.setattr(live_operators.msgpack, "packb", fails)
    for key, message in braked(1, Stop(1, 1, "")):
        door.heard(key, encode(message))


def test_without_a_live_operator_nothing_happens() -> None:
    way, stopping = LiveWay(FLEET), Stopping(FLEET, 5, "")
    way.send(stopping.message)
    way.collect(stopping)
    assert not stopping.heard
    way.close()
    assert list(order_store.private_folder().iterdir()) == []


def test_one_that_was_killed_is_put_away(bus: NotingBus) -> None:
    door = StopDoor(FLEET, bus)
    door._socket.close()  # as by SIGKILL: its file stays
    way = LiveWay(FLEET)
    way.send(Stop(5, 5, ""))
    way.close()
    assert list(order_store.private_folder().iterdir()) == []


def test_of_two_fleets_of_one_name_the_one_that_is_meant(bus: NotingBus, way: LiveWay) -> None:
    other = replace(FLEET, network=replace(FLEET.network, base_port=FLEET.network.base_port + 100))
    with StopDoor(other, bus) as door:
        elsewhere = LiveWay(FLEET)
        elsewhere.send(Stop(5, 5, ""))
        elsewhere.close()
        assert door.step() == []


def test_a_flood_of_datagrams_keeps_no_drive(door: StopDoor, bus: NotingBus, way: LiveWay) -> None:
    for version in range(200):  # as many as the socket takes
        way.send(Stop(version, 5, ""))
    assert len(door.step()) <= live_operators.TAKEN_MAX


def test_who_comes_removes_what_killed_processes_left(bus: NotingBus) -> None:
    folder = order_store.private_folder()
    dead = subprocess.Popen(["true"])
    dead.wait()
    left = [folder / f"live-0123abcd-{dead.pid}.sock", folder / f"asks-{dead.pid}-7f00.sock"]
    kept = [folder / f"live-0123abcd-{os.getppid()}.sock", folder / "others.sock"]
    for path in (*left, *kept):
        path.touch()
    with StopDoor(FLEET, bus):
        assert not any(path.exists() for path in left)
        assert all(path.exists() for path in kept)
