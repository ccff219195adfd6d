"""The ports of a simulated rover as sockets, and its loop in time."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.simulator.__main__ import main, serve
from handfast.bridges.mavlink.simulator.rover import Rover, Settings
from handfast.bridges.mavlink.simulator.settings import SettingsError
from handfast.bridges.mavlink.simulator.sockets import (
    Endpoint,
    TcpLine,
    UdpLine,
    parse_endpoint,
)

HOST = "127.0.0.1"
NOW_NS = 1_800_000_000 * NS_PER_S


def came(connection: socket.socket) -> None:
    """Waits until something is there to be read."""
    assert select.select([connection], [], [], 10.0)[0]


@pytest.mark.parametrize(
    ("text", "listens", "endpoint"),
    [
        ("tcp:127.0.0.1:5760", True, Endpoint("tcp", "127.0.0.1", 5760, True)),
        ("udp:rover.local:14550", False, Endpoint("udp", "rover.local", 14550, False)),
        ("udp:[::1]:14550", True, Endpoint("udp", "::1", 14550, True)),
    ],
)
def test_endpoints(text: str, listens: bool, endpoint: Endpoint) -> None:
    assert parse_endpoint(text, listens=listens) == endpoint
    assert str(endpoint) == text


@pytest.mark.parametrize(
    ("text", "listens"),
    [
        ("tcp:127.0.0.1:5760", False),
        ("tcp:127.0.0.1", True),
        ("udp::14550", True),
        ("udp:host:-1", True),
        ("udp:host:70000", False),
        ("/dev/ttyUSB0", True),
        ("", True),
    ],
)
def test_texts_that_are_no_endpoint(text: str, listens: bool) -> None:
    with pytest.raises(SettingsError, match="HOST:PORT"):
        parse_endpoint(text, listens=listens)


@pytest.fixture
def listening() -> Iterator[UdpLine]:
    line = UdpLine(Endpoint("udp", HOST, 0, True))
    yield line
    line.close()


@pytest.fixture
def peers(listening: UdpLine) -> Iterator[list[socket.socket]]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for each in sockets:
        each.connect((HOST, listening.endpoint.port))
    yield sockets
    for each in sockets:
        each.close()


def test_udp_talks_to_whom_it_heard_first_until_that_is_silent(
    listening: UdpLine, peers: list[socket.socket]
) -> None:
    first, second = peers
    assert not listening.is_open
    for sender, seconds, taken in (
        (first, 0.0, b"x"),
        (second, 1.0, b""),
        (first, 2.0, b"x"),
        (second, 6.9, b""),
        (second, 7.1, b"x"),
        (first, 8.0, b""),
    ):
        now_ns = NOW_NS + round(seconds * NS_PER_S)
        sender.send(b"x")
        came(listening.watched())
        assert listening.receive(now_ns) == taken, seconds
    listening.send([b"hello"])
    came(second)
    assert second.recv(100) == b"hello"
    assert not select.select([first], [], [], 0)[0]
    listening.restart()
    assert not listening.is_open


def test_tcp_loses_whole_messages_when_nobody_reads() -> None:
    line = TcpLine(Endpoint("tcp", HOST, 0, True))
    with socket.create_connection((HOST, line.endpoint.port)) as client:
        came(line.watched())
        assert line.receive(NOW_NS) == b""
        assert line.is_open
        block = [bytes(range(200)) * 50]
        for _ in range(2_000):
            line.send(block)
        client.settimeout(10.0)
        got = b""
        while len(got) % len(block[0]) or not got:
            while select.select([client], [], [], 0.0)[0]:
                got += client.recv(1 << 20)
            line.send(block)
        assert len(got) < 2_000 * len(block[0])
        assert got == block[0] * (len(got) // len(block[0]))
    came(line.watched())
    assert line.receive(NOW_NS) == b""
    assert not line.is_open
    line.close()


class JumpingClock:
    """Sleeps take no time; the one that is number `jumps` takes 10 s more than it should."""

    def __init__(self, jumps: int) -> None:
        self.now, self.count, self.jumps = NOW_NS, 0, jumps

    def now_ns(self) -> int:
        return self.now

    def sleep_until(self, time_ns: int) -> None:
        self.count += 1
        self.now = max(self.now, time_ns) + (10 * NS_PER_S if self.count == self.jumps else 0)

    def begin(self, epoch_ns: int) -> None:
        raise AssertionError("a vehicle knows of no mission")


def test_time_in_which_the_process_was_held_up_is_lost_not_made_up_for(listening: UdpLine) -> None:
    rover = Rover(Settings(boot="warm"), NOW_NS)
    rover.set_open(0, listening.is_open)
    clock = JumpingClock(20)
    log: list[str] = []

    class Shutdown(SimpleNamespace):
        @property
        def asked(self) -> bool:
            return clock.count >= 50

        def look_for_parent(self) -> None:
            pass

    shutdown: Any = Shutdown(why="the test ends")
    assert serve(rover, [listening], clock, shutdown, log.append) == 0
    assert [line for line in log if "held up" in line] == ["was held up for 10.0 s"]
    assert rover.next_ns - NOW_NS == pytest.approx(51 * NS_PER_S // 50, abs=NS_PER_S // 50)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--listen=tcp:5760"], "tcp:HOST:PORT"),
        (["--listen=/dev/ttyS0"], "'/dev/ttyS0'"),
        (["--connect=tcp:127.0.0.1:5760"], "udp:HOST:PORT"),
        (["--listen=udp:127.0.0.1:99999"], "99999"),
        (["--listen=udp:192.0.2.1:14550"], "cannot listen on udp:192.0.2.1:14550"),
        (["--home=1,2"], "LAT,LON,ALT,YAW"),
        (["--param=NO_SUCH=1"], "NO_SUCH"),
        (["--system=0"], "from 1 to 254"),
        (["--boot=-1"], "more than 0 s"),
    ],
)
def test_bad_options_are_named_in_one_line(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line
