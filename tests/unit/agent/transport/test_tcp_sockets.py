"""handfast.agent.transport.tcp_sockets: what is found, and that it is nobody else's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest

from handfast.agent.transport.tcp_sockets import Calm, TcpSocket, TcpSockets, borrowed, held


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


@pytest.fixture
def link(server: socket.socket) -> Iterator[tuple[socket.socket, socket.socket]]:
    near = socket.create_connection(server.getsockname())
    far, _ = server.accept()
    with near, far:
        yield near, far


def calm_of(*links: socket.socket) -> Calm:
    calm = Calm()
    calm.begin([of(each) for each in links])
    return calm


def test_it_is_calm_while_nothing_comes_goes_or_is_opened(link: tuple[socket.socket, socket.socket]) -> None:
    near, far = link
    calm = calm_of(near, far)
    assert calm.lasts()
    assert calm.lasts()
    assert not calm.waits
    far.send(b"waits")
    assert calm.lasts()
    assert calm.waits
    assert not calm.lasts()
    near.recv(9)
    assert calm.lasts()
    assert not calm.waits
    with socket.socket():
        assert not calm.lasts()
    assert calm.lasts()
    calm.end()
    assert not calm.lasts()
