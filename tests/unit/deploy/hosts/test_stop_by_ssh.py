"""A stop over ssh: with the host's own program, and a systemctl that says what it is told."""

from __future__ import annotations

import threading
import time
from base64 import b64encode
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import as_believed, decode, encode
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Stop
from handfast.agent.runtime.order_store import STOP_FILE, packed, unpacked
from handfast.deploy.console.arguments import InputError
from handfast.deploy.hosts import stop_by_ssh, systemd_units
from handfast.deploy.hosts.stop_by_ssh import SshWay
from handfast.deploy.orders.stop_outcome import Stopping
from tests.process.harness import wait_for
from tests.unit.deploy.hosts.test_remote_program import home  # noqa: F401
from tests.unit.deploy.inventory.test_own_orders import HOSTS

STATES = {"agent": "stopped: stop: lunch", "plant": "braking: stop: lunch"}


@pytest.fixture
def fleet() -> Fleet:
    return parse_fleet(HOSTS, source="here", overrides=['network.security="off"'])


@pytest.fixture
def folder(home: Path) -> Path:  # noqa: F811
    return home / ".local/share/handfast/fleets/two/orders"


def say(home: Path, fleet: Fleet, **states: str) -> None:  # noqa: F811
    """Has systemd say these states of all robots' processes."""
    blocks = [
        f"Id={systemd_units.unit_name('two', robot, role)}\nActiveState=active\nStatusText={states[role]}\n"
        for robot in fleet.ids
        for role in ROLES
    ]
    (home / "shown").write_text("\n".join(blocks))


def looked(way: SshWay, stopping: Stopping) -> bool:
    busy = way.busy  # before: what it says last is told, too
    way.collect(stopping)
    return stopping.done or not busy


def followed(way: SshWay, stopping: Stopping, sent: Stop) -> Stop:
    """Takes what has come back, and sends the stop again where it is another one now; what was sent last."""
    way.collect(stopping)
    if stopping.message is not sent:
        way.send(stopping.message)
    return stopping.message


def test_it_is_laid_there_and_who_takes_it_is_told(fleet: Fleet, home: Path, folder: Path) -> None:  # noqa: F811
    say(home, fleet, agent="running", plant="driving")
    stopping, way = Stopping(fleet, time.time_ns(), "lunch"), SshWay(fleet, fleet.hosts)
    way.send(stopping.message)
    wait_for((folder / STOP_FILE).exists, "the stop lies there")
    laid = unpacked((folder / STOP_FILE).read_bytes())
    assert [decode(order) for order in laid] == [stopping.message]
    assert folder.stat().st_mode & 0o077 == 0
    say(home, fleet, **STATES)
    for robot in fleet.ids:
        for role in ROLES:
            (folder / f"robot-{robot}-{role}.json").write_bytes(packed([encode(stopping.message)]))
    wait_for(lambda: looked(way, stopping), "all are known to brake")
    assert stopping.done
    assert stopping.outcome(1).endswith("(over ssh to h)")
    way.close()
    assert way.troubles == []


def test_who_takes_it_while_it_is_looked_at_is_looked_at_again(
    fleet: Fleet,
    home: Path,  # noqa: F811
    folder: Path,
) -> None:
    """What it says of itself is read before what it has kept: it may take the stop between the two."""
    say(home, fleet, agent="running", plant="driving")
    stopping, way = Stopping(fleet, time.time_ns(), "lunch"), SshWay(fleet, fleet.hosts)
    folder.mkdir(parents=True, mode=0o700)
    for robot in fleet.ids:
        for role in ROLES:
            (folder / f"robot-{robot}-{role}.json").write_bytes(packed([encode(stopping.message)]))
    way.send(stopping.message)
    wait_for(lambda: looked(way, stopping) or stopping.heard, "it was looked at")
    assert not stopping.done
    say(home, fleet, **STATES)
    wait_for(lambda: looked(way, stopping), "it was looked at again")
    assert stopping.done
    way.close()


def test_a_later_stop_is_outdone(fleet: Fleet, home: Path, folder: Path) -> None:  # noqa: F811
    """As one of a run's end, from an operator whose clock is ahead of this one: it is not to be the last."""
    say(home, fleet, **STATES)
    stopping, way = Stopping(fleet, time.time_ns(), "dinner"), SshWay(fleet, fleet.hosts)
    sent = stopping.message
    later = sent._replace(version=sent.version + 60_000_000, reason="the run is over")
    folder.mkdir(parents=True, mode=0o700)
    (folder / STOP_FILE).write_bytes(packed([encode(later._replace(version=later.version + 5))]))
    for robot in fleet.ids:
        for role in ROLES:
            (folder / f"robot-{robot}-{role}.json").write_bytes(packed([encode(later)]))
    way.send(sent)

    def taken() -> bool:
        nonlocal sent
        before, sent = sent, followed(way, stopping, sent)
        if sent is before and (laid := unpacked((folder / STOP_FILE).read_bytes())) == (encode(sent),):
            for robot in fleet.ids:
                for role in ROLES:
                    (folder / f"robot-{robot}-{role}.json").write_bytes(packed(laid))
        return stopping.done

    wait_for(taken, "all brake by this one", 5.0)
    assert stopping.message == later._replace(version=later.version + 6, reason="dinner")
    way.close()


def test_an_older_stop_there_is_not_this_one(fleet: Fleet, home: Path, folder: Path) -> None:  # noqa: F811
    say(home, fleet, **STATES)
    folder.mkdir(parents=True, mode=0o700)
    for role in ROLES:
        (folder / f"robot-1-{role}.json").write_bytes(packed([encode(Stop(5, 5, "before"))]))
    (folder / "robot-2-agent.json").write_bytes(b"\xff\x00 nonsense")
    stopping, way = Stopping(fleet, time.time_ns(), "lunch"), SshWay(fleet, fleet.hosts)
    way.send(stopping.message)
    wait_for((folder / STOP_FILE).exists, "the stop lies there")
    wait_for(lambda: looked(way, stopping) or stopping.heard, "it was looked at")
    assert not any(map(stopping.stands_by, fleet.ids))
    way.close()


def test_who_is_down_finds_it_when_it_comes_up(fleet: Fleet, home: Path, folder: Path) -> None:  # noqa: F811
    """Also where it has kept a later order, of an operator whose clock was ahead."""
    (home / "shown").write_text("")
    stopping, way = Stopping(fleet, time.time_ns(), "a hole"), SshWay(fleet, fleet.hosts)
    later = stopping.message._replace(version=stopping.message.version + 60_000_000, reason="the run is over")
    folder.mkdir(parents=True, mode=0o700)
    (folder / "robot-2-plant.json").write_bytes(packed([encode(later)]))
    sent = stopping.message
    way.send(sent)

    def settled() -> bool:
        nonlocal sent
        sent = followed(way, stopping, sent)
        return stopping.settled

    wait_for(settled, "all are down", 5.0)
    (laid,) = unpacked((folder / STOP_FILE).read_bytes())
    assert decode(laid) == later._replace(version=later.version + 1, reason="a hole")
    assert stopping.outcome(2) == "robot 2: is down; it finds the stop when it comes up (over ssh to h)"
    way.close()


@pytest.mark.parametrize("ahead_s", [400 * 86_400, -3 * 86_400])
def test_it_is_sealed_and_judged_by_the_clock_of_each_host(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, ahead_s: int
) -> None:
    """This machine's may be days off, and certificates not valid yet, or no more, by it."""
    way, by = SshWay(fleet, []), []
    stopping = Stopping(fleet, time.time_ns(), "lunch")

    def sealed(_: Fleet, order: bytes, ahead_ns: int = 0) -> bytes:
        if not ahead_ns:
            raise InputError("its certificate is not valid yet")
        by.append(ahead_ns)
        return order

    class There:
        host = fleet.hosts[0]

        def exchange(self, *_: object, **__: object) -> tuple[list[str], bytes]:
            return [], b""

        def ask(self, _: str, processes: list[str], **__: object) -> dict[str, object]:
            there_ns = time.time_ns() + ahead_s * 10**9
            kept = [b64encode(encode(as_believed(stopping.message, there_ns))).decode()]  # type: ignore[arg-type]
            says = {name: STATES[name.rpartition("-")[2]] for name in processes}
            found = {name: {"says": says[name], "orders": kept if by else []} for name in processes}
            return {"processes": found, "time_ns": there_ns}

    monkeypatch.setattr(stop_by_ssh, "sealed", sealed)
    way.send(stopping.message)
    follows = threading.Thread(target=way._follow, args=(There(),), daemon=True)
    follows.start()
    wait_for(lambda: way._content == {fleet.hosts[0].name}, "all there brake")
    way.close()
    follows.join(20.0)
    way.collect(stopping)
    assert [round(each / 1e9) for each in by] == [ahead_s]
    assert way.troubles == []
    if ahead_s < 0:
        assert "72 h ahead of the robots'" in stopping.outcomes(each=True)[-1]
    else:
        assert stopping.done, stopping.outcomes(each=True)
        assert "9600 h behind the robots'" in stopping.outcomes(each=True)[-1]


def test_it_is_said_that_no_clock_makes_the_certificate_valid(
    fleet: Fleet,
    home: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def expired(*_: object) -> tuple[bytes, ...]:
        raise InputError("its certificate has expired")

    monkeypatch.setattr(stop_by_ssh, "sealed", expired)
    way = SshWay(fleet, fleet.hosts)
    way.send(Stopping(fleet, time.time_ns(), "lunch").message)
    wait_for(lambda: not way.busy, "it has given up", 5.0)
    assert way.troubles == ["not over ssh: its certificate has expired"]
    way.close()


def test_a_host_that_cannot_be_reached_is_said(
    fleet: Fleet,
    home: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (home.parent / "tools" / "ssh").write_text("#!/bin/sh\necho 'no route to host' >&2; exit 255\n")
    stopping, way = Stopping(fleet, time.time_ns(), "lunch"), SshWay(fleet, fleet.hosts)
    way.send(stopping.message)
    wait_for(lambda: not way.busy, "it has given up")
    assert len(way.troubles) == 1
    assert way.troubles[0].startswith("not over ssh to h: ")
    way.close()


def test_hosts_are_asked_less_and_less_often(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds that are asked ten times a second hold up those that have not got the stop yet."""
    now_s, slept = 0.0, []

    class Clock:
        @staticmethod
        def monotonic() -> float:
            return now_s

        @staticmethod
        def time_ns() -> int:
            return 5

    class Silent:
        host = fleet.hosts[0]

        def exchange(self, *_: object, **__: object) -> tuple[list[str], bytes]:
            return [], b""

        def ask(self, *_: object, **__: object) -> dict[str, object]:
            return {}

    def rest(_: object, seconds: float, __: object, *, content: bool) -> None:
        nonlocal now_s
        now_s += seconds
        slept.append(seconds)

    monkeypatch.setattr(stop_by_ssh, "time", Clock)
    way = SshWay(fleet, [])
    monkeypatch.setattr(way, "_rest", rest)
    way.send(Stopping(fleet, 0, "lunch").message)
    way._follow(Silent())  # type: ignore[arg-type]
    assert slept[0] == stop_by_ssh.LOOK_S, "at first at once"
    assert len(slept) < 20
    assert sum(slept) >= stop_by_ssh.FOLLOW_S


def test_another_stop_is_not_waited_for(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a robot has had a later order, the stop gets a greater version: it goes there at once."""
    way, laid = SshWay(fleet, []), []
    first, second = Stop(5, 5, "lunch"), Stop(9, 9, "lunch")

    class There:
        host = fleet.hosts[0]

        def exchange(self, what: str, blob: bytes, **__: object) -> tuple[list[str], bytes]:
            laid.extend(unpacked(blob))
            if len(laid) == 1:
                threading.Timer(0.05, way.send, (second,)).start()
            else:
                way.close()
            return [], b""

        def ask(self, *_: object, **__: object) -> dict[str, object]:
            return {}

    monkeypatch.setattr(stop_by_ssh, "LOOK_S", 60.0)
    monkeypatch.setattr(stop_by_ssh, "LOOK_S_MAX", 60.0)
    way.send(first)
    follows = threading.Thread(target=way._follow, args=(There(),), daemon=True)
    follows.start()
    follows.join(20.0)
    assert not follows.is_alive()
    assert [decode(order) for order in laid] == [first, second]


def test_a_host_for_which_there_is_no_thread_is_said(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", full)
    way = SshWay(fleet, fleet.hosts)
    way.send(Stop(5, 5, "lunch"))
    assert way.troubles == ["not over ssh to h: can't start new thread"]
    assert not way.busy
