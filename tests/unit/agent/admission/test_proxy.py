"""The proxy with real sockets on the loopback, turn by turn; its clients and servers are in the test."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from agent.admission.budgets import BACKOFF_S, WAITING_OF_ONE_MAX, Budgets
from agent.admission.proxy import NO_HELLO, NOT_PROVEN, NOT_TLS, Door, Proxy, listener
from agent.admission.tls_records import APPLICATION_DATA, HANDSHAKE, PROVEN_RECORDS

LOCAL = "127.0.0.1"
DEADLINE_S = 2.0
HELLO = bytes((HANDSHAKE, 3, 1, 0, 40, 1)) + bytes(39)
RECORD = bytes((APPLICATION_DATA, 3, 3, 0, 3)) + b"abc"


class World:
    """A server, the proxy before it, a clock that stands still unless it is moved, and what was said."""

    def __init__(self) -> None:
        self.server = socket.create_server((LOCAL, 0))
        self.server.setblocking(False)
        self.now_s = 100.0
        self.said: list[str] = []
        self.budgets = Budgets()
        at = listener((LOCAL, 0))
        self.where = at.getsockname()
        door = Door(at, self.server.getsockname())
        self.proxy = Proxy([door], self.budgets, DEADLINE_S, self.said.append)
        self.sockets: list[socket.socket] = []

    def turns(self, until: Callable[[], object], most: int = 500) -> object:
        """Turns until something is true."""
        for _ in range(most):
            if found := until():
                return found
            self.proxy.turn(0.02, lambda: self.now_s)
        raise AssertionError(f"not in {most} turns: {self.said}")

    def client(self, says: bytes = b"") -> socket.socket:
        made = socket.create_connection(self.where)
        made.setblocking(False)
        self.sockets.append(made)
        if says:
            made.sendall(says)
        return made

    def accepted(self) -> socket.socket:
        """The server's end of a connection that was let through."""

        def look() -> socket.socket | None:
            try:
                return self.server.accept()[0]
            except BlockingIOError:
                return None

        made = self.turns(look)
        assert isinstance(made, socket.socket)
        made.setblocking(False)
        self.sockets.append(made)
        return made

    def hears(self, at: socket.socket, size: int) -> bytes:
        data = bytearray()

        def look() -> bool:
            with suppress(BlockingIOError):
                data.extend(at.recv(size - len(data)))
            return len(data) >= size

        self.turns(look)
        return bytes(data)

    def is_closed(self, at: socket.socket) -> bool:
        try:
            return at.recv(1) == b""
        except BlockingIOError:
            return False
        except ConnectionError:
            return True

    def link(self) -> tuple[socket.socket, socket.socket]:
        """Both ends of a connection that has proven itself."""
        client = self.client(HELLO)
        server = self.accepted()
        assert self.hears(server, len(HELLO)) == HELLO
        server.sendall(RECORD * PROVEN_RECORDS)
        assert self.hears(client, len(RECORD) * PROVEN_RECORDS) == RECORD * PROVEN_RECORDS
        return client, server


@pytest.fixture
def world() -> Iterator[World]:
    made = World()
    yield made
    made.proxy.close()
    for each in (*made.sockets, made.server):
        each.close()


def test_what_both_say_comes_through_unchanged_however_slowly_it_is_read(world: World):
    client, server = world.link()
    assert world.budgets.proven == (LOCAL,)
    for one, other in ((client, server), (server, client)):
        data = bytes(range(256)) * 20_000
        sent = 0

        def push(from_: socket.socket = one, data: bytes = data) -> bool:
            nonlocal sent
            try:
                sent += from_.send(data[sent : sent + 1_000_000])
            except BlockingIOError:
                return True
            return sent == len(data)

        world.turns(push)
        got = bytearray()
        while len(got) < len(data):
            push()
            got += world.hears(other, min(100_000, len(data) - len(got)))
        assert got == data
    assert world.said == []


def test_an_end_of_one_is_the_end_of_the_other(world: World):
    client, server = world.link()
    client.sendall(b"last words")
    client.close()
    assert world.hears(server, 10) == b"last words"
    world.turns(lambda: world.is_closed(server))
    client, server = world.link()
    server.close()
    world.turns(lambda: world.is_closed(client))
    assert len(world.proxy) == 0
    assert world.said == []


def test_who_says_nothing_is_closed_and_the_server_never_hears_of_it(world: World):
    client = world.client(HELLO[:20])
    world.turns(lambda: len(world.proxy))
    world.now_s += 0.9 * DEADLINE_S
    world.proxy.turn(0.0, lambda: world.now_s)
    assert not world.is_closed(client)
    world.now_s += 0.2 * DEADLINE_S
    world.turns(lambda: world.is_closed(client))
    assert world.said == [f"connections of {LOCAL}: {NO_HELLO}"]
    with pytest.raises(BlockingIOError):
        world.server.accept()


def test_who_speaks_something_else_is_closed_at_once(world: World):
    client = world.client(b"GET / HTTP/1.1\r\n\r\n")
    world.turns(lambda: world.is_closed(client))
    assert world.said == [f"connections of {LOCAL}: {NOT_TLS}"]


def test_who_does_not_complete_the_handshake_is_closed_at_both_ends(world: World):
    client = world.client(HELLO)
    server = world.accepted()
    assert world.hears(server, len(HELLO)) == HELLO
    server.sendall(RECORD * (PROVEN_RECORDS - 1))
    world.hears(client, len(RECORD) * (PROVEN_RECORDS - 1))
    world.now_s += 1.1 * DEADLINE_S
    world.turns(lambda: world.is_closed(client))
    world.turns(lambda: world.is_closed(server))
    assert world.said == [f"connections of {LOCAL}: {NOT_PROVEN}"]
    assert world.budgets.proven == ()


def test_who_failed_is_not_let_in_for_a_while(world: World):
    first = world.client(b"no TLS")
    world.turns(lambda: world.is_closed(first))
    second = world.client(HELLO)
    world.turns(lambda: world.is_closed(second))
    world.now_s += 1.1 * BACKOFF_S
    world.client(HELLO)
    world.accepted()


def test_a_server_that_is_not_there_costs_the_client_nothing(world: World):
    world.server.close()
    for _ in range(20):
        client = world.client(HELLO)
        world.turns(lambda at=client: world.is_closed(at))
    assert world.said == []


def test_one_that_floods_holds_few(world: World):
    clients = [world.client(HELLO[:9]) for _ in range(20)]
    world.turns(lambda: sum(map(world.is_closed, clients)) >= 0 and len(world.said) >= 16)
    assert len(world.proxy) == WAITING_OF_ONE_MAX


def test_the_end_of_the_proxy_ends_all(world: World):
    client, server = world.link()
    world.proxy.close()
    assert world.is_closed(client)
    assert world.is_closed(server)
