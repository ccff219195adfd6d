"""Who knocks at a process that has enough to look at."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from agent.common.time import NS_PER_S
from agent.transport.listening_gate import EACH, OPENED_MIN, WAITING, Gate

MOST = WAITING + 2 * EACH
PLENTY = 1000


@pytest.fixture
def listens() -> Iterator[socket.socket]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.create_server(("127.0.0.1", 0), backlog=1024) as made:
        yield made
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def knock(stack: ExitStack, listens: socket.socket) -> bool:
    """Whether somebody new is let in."""
    made = stack.enter_context(socket.socket())
    made.settimeout(0.2)
    try:
        made.connect(listens.getsockname())
    except OSError:
        return False
    return True


def is_shut(gate: Gate) -> bool:
    return gate.shut


def crowd(stack: ExitStack, listens: socket.socket, count: int) -> list[socket.socket]:
    """So many who are taken in, as Zenoh does at once: what was taken."""
    taken = []
    for _ in range(count):
        stack.enter_context(socket.create_connection(listens.getsockname()))
        taken.append(stack.enter_context(listens.accept()[0]))
    return taken


def test_while_many_wait_nobody_new_is_let_in(listens: socket.socket) -> None:
    with Gate(2) as gate, ExitStack() as stack:
        link = stack.enter_context(socket.create_connection(listens.getsockname()))
        here = stack.enter_context(listens.accept()[0])
        assert gate.look(NS_PER_S) == ""
        waiting = crowd(stack, listens, MOST - 1)
        assert gate.look(NS_PER_S) == ""
        waiting += crowd(stack, listens, 1)
        assert gate.look(NS_PER_S).startswith(f"more than {MOST} connections wait")
        assert is_shut(gate)
        assert not knock(stack, listens)
        link.sendall(b"a link that is there")
        assert here.recv(100) == b"a link that is there"
        # The first that were taken go first: what is free then is no sign that few wait.
        for each in waiting[: MOST // 2 - 1]:
            each.close()
        gate.look(100 * NS_PER_S)
        assert is_shut(gate)
        for each in waiting[MOST // 2 - 1 : MOST // 2 + 1]:
            each.close()
        assert gate.look(100 * NS_PER_S) == ""
        assert not is_shut(gate)
        assert knock(stack, listens)


def test_files_and_links_of_its_own_are_nobody_who_waits(listens: socket.socket) -> None:
    with Gate(2) as gate, ExitStack() as stack:
        own = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]
        with socket.create_server(("127.0.0.1", 0), backlog=1024) as another:
            crowd(stack, another, MOST + 1)
            assert gate.look(NS_PER_S) == ""
            assert not is_shut(gate)
        for number in own:
            os.close(number)


def test_where_nothing_more_can_be_opened_it_is_shut_and_opened_later(listens: socket.socket) -> None:
    with Gate(2) as gate:
        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 20, hard))
        own = []
        with suppress(OSError):
            for _ in range(PLENTY):
                own.append(os.open("/dev/null", os.O_RDONLY))
        assert "connections wait" in gate.look(NS_PER_S)
        assert is_shut(gate)
        for number in own:
            os.close(number)
        assert gate.look(2 * NS_PER_S) == ""
        assert not is_shut(gate)


def test_a_socket_stays_as_it_was(listens: socket.socket) -> None:
    listens.setblocking(False)
    with Gate(2) as gate, ExitStack() as stack:
        crowd(stack, listens, MOST + 1)
        gate.look(1)
        assert not os.get_blocking(listens.fileno()), "one that blocks would hold up Zenoh's only thread"


@pytest.mark.patches
def test_it_keeps_no_descriptors_but_of_what_listens(listens: socket.socket) -> None:
    own = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]
    before = len(os.listdir("/proc/self/fd"))
    with Gate(2) as gate:
        gate.look(1)
        assert len(os.listdir("/proc/self/fd")) == before + 1
    assert len(os.listdir("/proc/self/fd")) == before
    for number in own:
        os.close(number)


def test_a_low_limit_is_said(listens: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    with Gate(2) as gate:
        assert gate.trouble == ""
    monkeypatch.setattr(resource, "getrlimit", lambda _: (150, 150))
    with Gate(2) as gate:
        assert gate.trouble.startswith("this process may open 150 files")
        assert f"let it open {OPENED_MIN}" in gate.trouble


def test_it_is_said_once_a_minute(listens: socket.socket) -> None:
    with Gate(2) as gate:
        said = []
        for round_ in range(1, 80):
            with ExitStack() as stack:
                crowd(stack, listens, MOST + 1)
                said.append(gate.look(round_ * NS_PER_S))
            gate.look(round_ * NS_PER_S)
        assert sum(map(bool, said)) == 2


def test_the_queue_in_the_kernel_is_short(listens: socket.socket) -> None:
    with Gate(2), ExitStack() as stack:
        taken = next(count for count in range(1000) if not knock(stack, listens))
    assert MOST <= taken <= MOST + 1


def test_a_process_that_does_not_listen_has_none() -> None:
    with Gate(2) as gate:
        waiting = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]
        assert gate.look(1) == ""
        for number in waiting:
            os.close(number)


def test_there_are_places_for_more_than_come_between_two_looks(listens: socket.socket) -> None:
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    with Gate(2):
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > min(10_000, hard - 1)
