"""Who knocks at a process that has enough to look at."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from agent.common.time import NS_PER_S
from agent.runtime.listening_gate import EACH, SHUT_NS, WAITING, Gate

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


def test_while_many_wait_nobody_new_is_let_in(listens: socket.socket) -> None:
    with Gate(2) as gate, ExitStack() as stack:
        link = stack.enter_context(socket.create_connection(listens.getsockname()))
        here = stack.enter_context(listens.accept()[0])
        assert gate.look(NS_PER_S) == ""
        waiting = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]  # as what was taken
        assert gate.look(NS_PER_S).startswith(f"more than {MOST} connections wait")
        assert gate.shut
        assert not knock(stack, listens)
        link.sendall(b"a link that is there")
        assert here.recv(100) == b"a link that is there"
        gate.look(2 * NS_PER_S)
        assert gate.shut
        for number in waiting:
            os.close(number)
        assert gate.look(2 * NS_PER_S) == ""
        assert not gate.shut
        assert knock(stack, listens)


def test_a_process_that_uses_many_files_itself_is_not_shut_for_good(listens: socket.socket) -> None:
    with Gate(2) as gate, ExitStack() as stack:
        own = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]
        gate.look(NS_PER_S)
        gate.look(NS_PER_S + SHUT_NS - 1)
        assert gate.shut
        gate.look(NS_PER_S + SHUT_NS)
        assert not gate.shut
        assert knock(stack, listens)
        for number in own:
            os.close(number)


def test_it_is_said_once_a_minute(listens: socket.socket) -> None:
    with Gate(2) as gate:
        said = []
        for round_ in range(1, 80):
            waiting = [os.open("/dev/null", os.O_RDONLY) for _ in range(PLENTY)]
            said.append(gate.look(round_ * NS_PER_S))
            for number in waiting:
                os.close(number)
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
