"""Connections as the loop sees them: never waited for, opened again, one program at a time, said clearly."""

from __future__ import annotations

import errno
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport import transport as transport_module
from handfast.bridges.mavlink.transport.channels import PEER_NS, Tcp, UdpIn
from handfast.bridges.mavlink.transport.connection_string import parse_connection
from handfast.bridges.mavlink.transport.transport import (
    ConnectionLock,
    InUse,
    Timing,
    Transport,
    open_transport,
)

LOCALHOST = "127.0.0.1"
TIMING = Timing(retry_s=0.005, retry_max_s=0.02)


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def until(condition: Callable[[], object]) -> None:
    """Waits for what another thread does; a test that waits in vain is ended by pytest's timeout."""
    pause = threading.Event()
    while not condition():
        pause.wait(0.001)


class Noted(transport_module.ThreadedTransport):
    """Keeps its troubles: one that is over within milliseconds may be past when a test looks."""

    def __init__(self, *values: Any, **options: Any) -> None:
        self.troubles: list[str] = []
        super().__init__(*values, **options)

    def __setattr__(self, name: str, value: object) -> None:
        if name == "trouble" and value:
            self.troubles.append(str(value))
        super().__setattr__(name, value)


@pytest.fixture
def noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_module, "ThreadedTransport", Noted)


@pytest.fixture
def opened() -> Iterator[Callable[[str], Transport]]:
    transports = []

    def open_(connection: str) -> Transport:
        ticks = count(1)
        transports.append(open_transport(connection, 57600, lambda: next(ticks), timing=TIMING))
        return transports[-1]

    yield open_
    for transport in transports:
        transport.close()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server((LOCALHOST, 0)) as server:
        yield server


@pytest.fixture
def vehicle() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((LOCALHOST, 0))
        yield sock


def received(transport: Transport) -> bytes:
    out: list[tuple[int, bytes]] = []
    until(lambda: out.extend(transport.receive()) or out)
    return b"".join(data for _, data in out)


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind((LOCALHOST, 0))
        return int(sock.getsockname()[1])


def test_no_connection_string_is_an_error_at_once() -> None:
    with pytest.raises(ValueError, match="is not a connection"):
        open_transport("simulator", 57600, lambda: 0)


# TCP.


def test_tcp_carries_bytes_both_ways_each_with_its_time(
    opened: Callable[[str], Transport], listener: socket.socket
) -> None:
    transport = opened(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}")
    peer, _ = listener.accept()
    with peer:
        until(lambda: transport.epoch)
        assert transport.trouble == ""
        peer.sendall(b"one")
        first: list[tuple[int, bytes]] = []
        until(lambda: first.extend(transport.receive()) or first)
        assert first == [(1, b"one")]
        transport.send(b"two")
        assert peer.recv(10) == b"two"
        assert transport.dropped == 0
        transport.send(b"")
        assert transport.dropped == 0


def test_a_lost_tcp_connection_is_opened_again_and_counted(
    noted: None, opened: Callable[[str], Noted], listener: socket.socket
) -> None:
    transport = opened(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}")
    for epoch in (1, 2, 3):
        peer, _ = listener.accept()
        until(lambda epoch=epoch: transport.epoch == epoch)
        peer.sendall(b"hello %d" % epoch)
        assert received(transport) == b"hello %d" % epoch
        before = len(transport.troubles)
        peer.close()
        until(lambda before=before: len(transport.troubles) > before)
        assert "the vehicle closed the connection" in transport.troubles[-1]


def test_what_came_before_is_not_taken_for_the_new_session(
    opened: Callable[[str], Transport], listener: socket.socket
) -> None:
    transport = opened(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}")
    peer, _ = listener.accept()
    peer.sendall(b"old")
    peer.close()
    peer, _ = listener.accept()
    with peer:
        until(lambda: transport.epoch == 2)
        peer.sendall(b"new")
        assert received(transport) == b"new"


def test_nobody_there_is_told_and_tried_again(opened: Callable[[str], Transport]) -> None:
    port = free_port(socket.SOCK_STREAM)
    transport = opened(f"tcp:{LOCALHOST}:{port}")
    until(lambda: "cannot open" in transport.trouble)
    assert transport.trouble == f"cannot open tcp:{LOCALHOST}:{port}: connection refused"
    assert transport.transient, "a simulator that is started later is found"
    transport.send(b"lost")
    assert transport.dropped == 1
    with socket.create_server((LOCALHOST, port)) as server:
        peer, _ = server.accept()
        peer.close()


def test_a_peer_that_does_not_read_holds_nobody_up_and_gets_whole_messages(listener: socket.socket) -> None:
    channel = Tcp(parse_connection(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}"))
    peer, _ = listener.accept()
    message = bytes(range(65)) * 15  # of an odd size, so that the last one is cut somewhere
    taken = 0
    while channel.write(message):
        taken += 1
    assert not channel.write(message)
    got = b""
    with peer:
        peer.settimeout(10.0)
        while len(got) < taken * len(message):
            got += peer.recv(65536)
            channel.write(message[:0])  # what was begun is finished first
        assert got == message * taken
    channel.close()


def test_a_send_that_fails_has_the_connection_opened_again_once(
    noted: None, opened: Callable[[str], Noted], listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = count()
    poll = select.poll
    monkeypatch.setattr(transport_module.select, "poll", lambda: _Counted(poll(), waits))
    transport = opened(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}")
    peer, _ = listener.accept()
    until(lambda: transport.epoch)

    def fail(*_: object) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    with monkeypatch.context() as broken:
        broken.setattr(Tcp, "_put", fail)
        before = len(transport.troubles)
        transport.send(b"lost")
    until(lambda: len(transport.troubles) > before)
    assert transport.troubles[before].endswith("broken pipe")
    assert peer.recv(10) == b""
    peer.close()
    peer, _ = listener.accept()
    with peer:
        until(lambda: transport.epoch == 2)
        for _ in range(20):
            peer.sendall(b"new")
            assert received(transport) == b"new"
    assert transport.dropped == 1
    assert next(waits) < 100  # it waits; it does not go round and round


class _Counted:
    """A `select.poll` that counts how often it returns."""

    def __init__(self, poller: select.poll, returns: count[int]) -> None:
        self._poller, self._returns = poller, returns
        self.register = poller.register

    def poll(self, timeout_ms: int | None) -> list[tuple[int, int]]:
        ready = self._poller.poll(timeout_ms)
        next(self._returns)
        return ready


def test_close_gives_the_connection_back(opened: Callable[[str], Transport], listener: socket.socket) -> None:
    transport = opened(f"tcp:{LOCALHOST}:{listener.getsockname()[1]}")
    peer, _ = listener.accept()
    until(lambda: transport.epoch)
    transport.close()
    transport.close()
    assert peer.recv(10) == b""
    peer.close()
    transport.send(b"x")
    assert transport.dropped == 1


# UDP.


def test_udpout_sends_first_and_hears_only_that_address(
    opened: Callable[[str], Transport], vehicle: socket.socket
) -> None:
    transport = opened(f"udpout:{LOCALHOST}:{vehicle.getsockname()[1]}")
    until(lambda: transport.epoch)
    transport.send(b"hello")
    data, address = vehicle.recvfrom(100)
    assert data == b"hello"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"not me", address)
    vehicle.sendto(b"me", address)
    assert received(transport) == b"me"


def test_udpin_answers_the_first_it_heard_until_that_is_silent() -> None:
    port = free_port(socket.SOCK_DGRAM)
    channel = UdpIn(parse_connection(f"udpin:{LOCALHOST}:{port}"))
    one, two = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    try:
        assert not channel.write(b"nobody was heard")
        one.sendto(b"one", (LOCALHOST, port))
        assert channel.read(0) == b"one"
        two.sendto(b"two", (LOCALHOST, port))
        assert channel.read(PEER_NS - 1) == b""
        assert "sends here too: ignored" in channel.note
        assert channel.write(b"command")
        assert one.recv(100) == b"command"
        two.sendto(b"two", (LOCALHOST, port))
        assert channel.read(PEER_NS) == b"two"
        assert channel.note == ""
        assert channel.write(b"command")
        assert two.recv(100) == b"command"
        one.setblocking(False)
        with pytest.raises(BlockingIOError):
            one.recv(100)
        assert channel.read(PEER_NS + NS_PER_S) == b""
        one.sendto(b"one", (LOCALHOST, port))
        assert channel.read(2 * PEER_NS - 1) == b""
        for now_ns, noted in ((2 * PEER_NS, True), (3 * PEER_NS - 1, False)):
            two.sendto(b"two", (LOCALHOST, port))
            assert channel.read(now_ns) == b"two"
            assert bool(channel.note) is noted, "it is told while it goes on"
    finally:
        one.close()
        two.close()
        channel.close()


def test_what_the_vehicle_says_is_heard_in_a_flood_though_nobody_asks_meanwhile(
    opened: Callable[[str], Transport], vehicle: socket.socket
) -> None:
    port = free_port(socket.SOCK_DGRAM)
    transport = opened(f"udpin:{LOCALHOST}:{port}")
    assert isinstance(transport, transport_module.ThreadedTransport)
    until(lambda: transport.epoch)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for number in range(50):
            vehicle.sendto(b"%d" % number, (LOCALHOST, port))
            until(lambda number=number: len(transport._queue) > number)
            for _ in range(100):
                stranger.sendto(b"flood", (LOCALHOST, port))
    assert received(transport) == b"".join(b"%d" % number for number in range(50))
    assert "sends here too: ignored" in transport.note


def test_a_udp_port_of_another_program_is_told(
    opened: Callable[[str], Transport], vehicle: socket.socket
) -> None:
    port = vehicle.getsockname()[1]
    transport = opened(f"udpin:{LOCALHOST}:{port}")
    until(lambda: "cannot open" in transport.trouble)
    assert transport.trouble.endswith(f"port {port} is in use by another program")
    assert not transport.transient
    vehicle.close()
    until(lambda: transport.epoch)
    assert transport.trouble == ""


# One program at a time.


def test_two_bridges_cannot_use_one_connection(
    opened: Callable[[str], Transport], listener: socket.socket
) -> None:
    port = listener.getsockname()[1]
    first = opened(f"tcp:{LOCALHOST}:{port}")
    until(lambda: first.epoch)
    second = opened(f"tcp:localhost:{port}")
    until(lambda: "cannot open" in second.trouble)
    assert second.trouble.endswith(f"another handfast program uses it (process {os.getpid()})")
    assert not second.transient
    first.close()
    until(lambda: second.epoch)
    assert second.trouble == ""


def test_a_router_serves_one_bridge_for_each_vehicle_behind_it() -> None:
    router = parse_connection("tcp:127.0.0.1:5790")
    first, second = ConnectionLock(router, 1), ConnectionLock(router, 2)
    with pytest.raises(InUse):
        ConnectionLock(router, 2)
    waiting = parse_connection("udpin:0.0.0.0:14550")
    port = ConnectionLock(waiting, 1)
    with pytest.raises(InUse):
        ConnectionLock(waiting, 2)
    for held in (first, second, port):
        held.close()


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    code = (
        "import os\n"
        "import tempfile\n"
        f"tempfile.tempdir = {str(tmp_path)!r}\n"
        "from handfast.bridges.mavlink.transport.connection_string import parse_connection\n"
        "from handfast.bridges.mavlink.transport.transport import ConnectionLock\n"
        "ConnectionLock(parse_connection('udpin:0.0.0.0:14550'))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[5], check=False)
    assert killed.returncode == -9
    ConnectionLock(parse_connection("udpin:0.0.0.0:14550")).close()
