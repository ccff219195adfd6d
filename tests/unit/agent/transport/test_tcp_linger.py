"""Closing a link does not wait for a peer that is gone."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import pytest

from handfast.agent.transport.tcp_sockets import Lingering


def linger(of: socket.socket) -> tuple[int, int]:
    on, seconds = struct.unpack("ii", of.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))
    return on, seconds


@pytest.fixture
def link() -> Iterator[tuple[socket.socket, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
            near.setblocking(False)
            yield near, far


def test_a_socket_that_lingers_is_found_and_does_no_more(link: tuple[socket.socket, socket.socket]) -> None:
    near, far = link
    lingering = Lingering()
    assert lingering.end() == 1
    assert linger(near)[0] == linger(far)[0] == 0
    near.send(b"still whole")
    assert far.recv(99) == b"still whole"
    assert not near.getblocking(), "nothing else of it has changed"


def test_other_sockets_are_left_alone() -> None:
    first, second = socket.socketpair()
    with first, second, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        datagrams.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        Lingering().end()
        assert linger(first) == linger(datagrams) == (1, 10)


def test_it_is_done_when_each_was_changed_however_many_descriptors_it_has(
    link: tuple[socket.socket, socket.socket],
) -> None:
    near, far = link
    lingering = Lingering()
    assert not lingering.is_done
    lingering.end()
    assert not lingering.is_done, "one that does not linger yet may do so later"
    far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
    with near.dup():
        lingering.end()
        assert lingering.is_done
