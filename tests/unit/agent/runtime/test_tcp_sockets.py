"""agent.runtime.tcp_sockets: what is found, and that it is nobody else's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest

from agent.runtime.tcp_sockets import TcpSocket, TcpSockets, borrowed, held


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as found:
        yield found


def of(found: socket.socket) -> TcpSocket:
    return TcpSocket(found.fileno(), os.fstat(found.fileno()).st_ino)


def test_tcp_sockets_are_found_and_no_others(server: socket.socket) -> None:
    sockets = TcpSockets()
    first, second = socket.socketpair()
    with first, second, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        found = sockets.look()
        assert found is not None
        assert of(server) in found
        assert {of(first), of(second), of(datagrams)}.isdisjoint(found)
    with socket.socket() as later:
        assert of(later) in (sockets.look() or ())
        gone = of(later)
    assert gone not in (sockets.look() or ())


def test_one_that_is_borrowed_stays_open_and_as_it_was(server: socket.socket) -> None:
    server.setblocking(False)
    with borrowed(server.fileno()) as found:
        assert found.getsockname() == server.getsockname()
    with held(of(server)) as found:
        assert found.getsockname() == server.getsockname()
    assert os.get_blocking(server.fileno()) is False
    assert server.getsockname()


def test_one_that_has_become_another_is_not_held(server: socket.socket) -> None:
    was = TcpSocket(server.fileno(), of(server).inode + 1)
    opened = len(os.listdir("/dev/fd"))
    with pytest.raises(OSError), held(was):
        pass
    reader, writer = os.pipe()
    with pytest.raises(OSError), held(TcpSocket(reader, os.fstat(reader).st_ino)):
        pass
    os.close(reader)
    os.close(writer)
    assert len(os.listdir("/dev/fd")) == opened, "no descriptor is left behind"
