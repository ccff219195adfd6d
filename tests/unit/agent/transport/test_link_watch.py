"""handfast.agent.transport.link_watch: which links it shuts down, of sockets that nobody else knows of.

handfast.agent.transport.link_watch: what the kernel says, and where it says nothing.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.transport.link_watch import (
    DEAF_NS,
    PATIENCE_MAX,
    PERIOD_NS,
    SOON_NS,
    LinkWatch,
    run_delay_ns,
)
from handfast.agent.transport.tcp_sockets import TcpSockets

TIMEOUT_S = 0.4
T0 = 1000 * NS_PER_S


class Bench:
    """A process that listens, and one that connects to it; each with a watch, on a clock of its own."""

    def __init__(self, stack: ExitStack, address: str = "127.0.0.1") -> None:
        self._stack = stack
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self.server = stack.enter_context(socket.create_server((address, 0), family=family))
        port = self.server.getsockname()[1]
        self.endpoint = f"tcp/[{address}]:{port}" if ":" in address else f"tcp/{address}:{port}"
        self.opened: set[str] = set()
        self.waited_ns = 0
        """For how long the process has waited for a processor."""
        self.opener = LinkWatch(
            [],
            ["tcp/127.0.0.1:9", self.endpoint],
            TIMEOUT_S,
            lambda: self.opened,
            waited_ns=lambda: self.waited_ns,
        )
        self.listener = LinkWatch([self.endpoint], [], TIMEOUT_S, set)
        self.sockets = TcpSockets()
        self.now_ns = T0

    def connect(self, *, opened: bool = True, like_zenoh: bool = True) -> tuple[socket.socket, socket.socket]:
        """A link: the end that connects, the end that accepts."""
        near = self._stack.enter_context(socket.create_connection(self.server.getsockname()[:2]))
        far = self._stack.enter_context(self.server.accept()[0])
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, like_zenoh)
        host, port = near.getsockname()[:2]
        if opened:
            self.opened.add(f"[{host}]:{port}" if ":" in host else f"{host}:{port}")
        return near, far

    def look(self, watch: LinkWatch, after_ns: int = NS_PER_S // 4) -> list[str]:
        self.now_ns += after_ns
        return watch.look(self.sockets.look() or (), self.now_ns)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


@pytest.fixture
def bench(stack: ExitStack) -> Bench:
    return Bench(stack)


def ended(far: socket.socket) -> bool:
    """Whether the other end was shut down; what came before it is read."""
    far.settimeout(0.0)
    try:
        while far.recv(4096):
            pass
    except BlockingIOError:
        return False
    except ConnectionResetError:
        pass
    return True


def test_a_link_that_is_sent_on_and_never_read_from_is_deaf(bench: Bench) -> None:
    near, far = bench.connect()
    begun_ns = bench.now_ns
    while not (found := bench.look(bench.opener)):
        near.send(b"keep-alive")
        far.send(b"keep-alive")  # it acknowledges what has come
    assert found == [bench.endpoint]
    assert DEAF_NS < bench.now_ns - begun_ns <= 2 * DEAF_NS
    assert ended(far)


def test_that_goes_for_one_that_was_accepted_too(bench: Bench) -> None:
    near, far = bench.connect()
    while not (found := bench.look(bench.listener)):
        far.send(b"keep-alive")
        near.send(b"keep-alive")
    assert found == [""]
    assert ended(near)


@pytest.mark.parametrize(("starved", "times"), [(0.02, 1.2), (0.5, 5.0), (3.0, 9.0)])
def test_a_process_that_waits_for_a_processor_gives_it_longer(
    bench: Bench, starved: float, times: float
) -> None:
    near, far = bench.connect()
    begun_ns, step_ns = bench.now_ns, NS_PER_S // 10
    while not bench.look(bench.opener, step_ns):
        bench.waited_ns += round(starved * step_ns)
        near.send(b"keep-alive")
        far.send(b"keep-alive")
    passed_ns = bench.now_ns - begun_ns
    assert abs(passed_ns - times * DEAF_NS) <= 2 * step_ns
    assert ended(far)


def test_a_link_from_which_something_is_read_is_not(bench: Bench) -> None:
    near, far = bench.connect()
    for _ in range(20):
        near.send(b"keep-alive")
        far.send(b"keep-alive")
        assert bench.look(bench.opener) == []
        assert near.recv(5)  # not all: there is always more
    assert not ended(far)


def test_one_that_says_nothing_itself_is_not(bench: Bench) -> None:
    """What knocks, and waits to be looked at, is answered with nothing."""
    near, far = bench.connect()
    near.send(b"let me in")
    far.send(b"once")
    near.recv(99)
    for _ in range(20):
        near.send(b"let me in")
        assert bench.look(bench.listener) == []
    assert not ended(near)


def test_a_process_that_did_not_run_finds_nobody_deaf(bench: Bench) -> None:
    near, far = bench.connect()
    for _ in range(20):
        near.send(b"keep-alive")
        far.send(b"keep-alive")
        assert bench.look(bench.opener, 2 * NS_PER_S) == []
    assert not ended(far)


def test_a_link_that_is_not_answered_is_shut_down_and_the_next_has_more_time(bench: Bench) -> None:
    lasted = []
    for _ in range(4):
        near, far = bench.connect(opened=False)
        begun_ns = bench.now_ns
        near.send(b"may I?")
        while not ended(far):
            assert bench.look(bench.opener, NS_PER_S // 10) == []
        lasted.append(round((bench.now_ns - begun_ns) / NS_PER_S / TIMEOUT_S))
        near.close()
    assert lasted == [1, 2, 4, PATIENCE_MAX]


def test_what_comes_gives_it_more_time_and_once_open_it_has_all(bench: Bench) -> None:
    near, far = bench.connect(opened=False)
    for _ in range(10):
        far.send(b"in a moment")
        bench.look(bench.opener)
        assert near.recv(99)
    host, port = near.getsockname()
    bench.opened.add(f"{host}:{port}")
    for _ in range(10):
        bench.look(bench.opener)
    bench.opened.clear()  # it is not asked again
    for _ in range(10):
        bench.look(bench.opener)
    assert not ended(far)


def test_who_is_out_of_reach_is_dialled_again(bench: Bench) -> None:
    """No answer to the first packet: here because a queue is full."""
    bench.server.listen(0)
    with ExitStack() as stack:
        dialled = [stack.enter_context(socket.socket()) for _ in range(8)]
        for each in dialled:
            each.setblocking(False)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            each.connect_ex(bench.server.getsockname())
        for _ in range(10):
            bench.look(bench.opener, NS_PER_S // 10)
        errors = [each.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) for each in dialled]
    assert errno.ECONNRESET in errors


def test_ipv6(stack: ExitStack) -> None:
    try:
        bench = Bench(stack, "::1")
    except OSError:
        pytest.skip("no IPv6 here")
    _, far = bench.connect(opened=False)
    for _ in range(10):
        bench.look(bench.opener, NS_PER_S // 10)
    assert ended(far)
    _, far = bench.connect()
    for _ in range(10):
        bench.look(bench.opener, NS_PER_S // 10)
    assert not ended(far)


def test_one_that_is_met_before_zenoh_has_set_it_up_is_a_link_all_the_same(bench: Bench) -> None:
    """Between connect(2) and TCP_NODELAY, where a process that is short of time may be looked at."""
    near, far = bench.connect(like_zenoh=False)
    bench.look(bench.opener)
    assert (bench.opener.calm, bench.opener.period_ns) == (None, SOON_NS)
    near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    bench.look(bench.opener)
    assert bench.opener.reopen(bench.endpoint, bench.sockets.look() or ())
    assert ended(far)


def test_a_link_is_opened_anew_where_there_is_one(bench: Bench) -> None:
    _, far = bench.connect()
    bench.look(bench.opener)
    found = bench.sockets.look() or ()
    assert not bench.opener.reopen("tcp/127.0.0.1:9", found)
    assert not ended(far)
    assert bench.opener.reopen(bench.endpoint, found)
    assert ended(far)


def test_it_is_calm_when_nothing_waits_for_long_on_any_link_and_all_are_open(bench: Bench) -> None:
    near, far = bench.connect()
    bench.look(bench.opener)
    bench.look(bench.opener)
    found = bench.opener.calm
    assert found is not None
    assert [each.number for each in found] == [near.fileno()]
    bench.opener.still_calm(bench.now_ns)
    far.send(b"a message")
    bench.look(bench.opener)
    assert bench.opener.calm is not None
    bench.look(bench.opener)
    assert bench.opener.calm is None
    near.recv(99)
    bench.look(bench.opener)
    assert bench.opener.calm is not None
    bench.connect(opened=False)
    bench.look(bench.opener)
    assert bench.opener.calm is None


def test_a_deaf_link_is_found_as_soon_after_a_long_calm(bench: Bench) -> None:
    near, far = bench.connect()
    bench.look(bench.opener)
    bench.look(bench.opener)
    for _ in range(20):
        bench.now_ns += PERIOD_NS
        bench.opener.still_calm(bench.now_ns)
    begun_ns = bench.now_ns
    far.send(b"nobody reads this")
    while not bench.look(bench.opener, SOON_NS):
        near.send(b"keep-alive")
        assert bench.now_ns - begun_ns <= 2 * DEAF_NS
    assert bench.now_ns - begun_ns > DEAF_NS


HERE = "handfast.agent.transport.link_watch._TASKS"


def test_a_system_that_does_not_say_is_one_without_delay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(HERE, tmp_path / "none")
    assert run_delay_ns() == 0
