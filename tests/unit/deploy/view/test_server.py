"""The server answers what there is, to this machine, and refuses the rest without harm."""

from __future__ import annotations

import asyncio
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection, HTTPResponse
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from handfast.deploy.view.server import CONNECTIONS_MAX, LOOPBACK, TALK_PATH, Content, Server, Talk, keep

POLICY = "default-src 'none'"


def answer(path: str) -> Content | None:
    return {"": Content(b"page", "text/html"), "rows": Content(bytes(300_000), "application/x")}.get(path)


@contextmanager
def serving(talk: Talk | None = None) -> Iterator[Server]:
    made = Server(answer, POLICY, talk=talk)
    loop = asyncio.new_event_loop()
    task = loop.create_task(made.serve())
    thread = threading.Thread(target=lambda: loop.run_until_complete(asyncio.wait([task])))
    thread.start()
    try:
        yield made
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()
        made.close()


@pytest.fixture
def server() -> Iterator[Server]:
    with serving() as made:
        yield made


@pytest.fixture
def talking() -> Iterator[Server]:
    """A server that says again what it is told, to everybody whom it knows by a first word."""

    async def talk(connection: ServerConnection) -> None:
        if await connection.recv() != "hello":
            return
        keep(connection)
        async for said in connection:
            await connection.send(said)

    with serving(talk) as made:
        yield made


def talk_to(server: Server, path: str = TALK_PATH, **options: Any) -> ClientConnection:
    options.setdefault("origin", server.address.rstrip("/"))
    address = f"ws://{LOOPBACK}:{port(server)}/{path}"
    made: ClientConnection = connect(address, compression=None, open_timeout=10, **options)
    return made


def port(server: Server) -> int:
    return int(server.address.rstrip("/").rpartition(":")[2])


def get(server: Server, path: str, host: str | None = None) -> tuple[HTTPResponse, bytes]:
    connection = HTTPConnection(LOOPBACK, port(server), timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response, body


def raw(server: Server, data: bytes) -> bytes:
    with socket.create_connection((LOOPBACK, port(server)), 10) as connection:
        connection.sendall(data)
        found = b""
        while more := connection.recv(65_536):
            found += more
    return found


def test_it_gives_what_there_is(server: Server) -> None:
    response, body = get(server, "/")
    assert (response.status, body) == (200, b"page")
    assert response.headers["Content-Type"] == "text/html"
    assert response.headers["Content-Security-Policy"] == POLICY
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert get(server, "/rows?x=1")[1] == bytes(300_000)


def test_what_there_is_not_is_not_found(server: Server) -> None:
    for path in ("/nothing", "/../rows", "//rows", "/%72ows"):
        assert get(server, path)[0].status == 404


def test_a_page_of_others_that_leads_its_name_here_gets_nothing(server: Server) -> None:
    for host in (
        "evil.example",
        f"evil.example:{port(server)}",
        f"127.0.0.1:{port(server) + 1}",
        "127.0.0.1",
    ):
        response, body = get(server, "/rows", host)
        assert response.status == 403
        assert len(body) < 100
    assert get(server, "/", f"localhost:{port(server)}")[0].status == 200


def test_a_web_socket_is_refused_where_there_is_none(server: Server) -> None:
    with pytest.raises(InvalidStatus, match="404"):
        talk_to(server)
    request = (
        f"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1:{port(server)}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        "Sec-WebSocket-Version: 13\r\n\r\n"
    )
    assert raw(server, request.encode()).startswith(b"HTTP/1.1 404 ")


def test_it_listens_on_the_loopback_interface_alone(server: Server) -> None:
    assert server.address == f"http://127.0.0.1:{port(server)}/"
    with pytest.raises(OSError, match="in use"):
        Server(answer, POLICY, port(server))


def test_connections_that_say_nothing_keep_nobody_waiting(server: Server) -> None:
    silent = [socket.create_connection((LOOPBACK, port(server)), 10) for _ in range(100)]
    try:
        assert get(server, "/")[1] == b"page"
    finally:
        for each in silent:
            each.close()


# ---------------------------------------------------------------------- WebSockets


def test_a_page_of_this_server_may_talk(talking: Server) -> None:
    with talk_to(talking) as connection:
        connection.send("hello")
        connection.send("so it is")
        assert connection.recv(10) == "so it is"
    with talk_to(talking, f"{TALK_PATH}?x=1") as connection:
        connection.send("something else")
        with pytest.raises(ConnectionClosed):
            connection.recv(10)


@pytest.mark.parametrize(
    "origin",
    [
        None,
        "null",
        "",
        "http://127.0.0.1",
        "http://127.0.0.1:1",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:{port}/",
        "http://localhost:{port}",
        "http://evil.example:{port}",
        "http://127.0.0.1:{port}.evil.example",
        "HTTP://127.0.0.1:{port}",
    ],
)
def test_a_page_of_another_server_may_not_talk(talking: Server, origin: str | None) -> None:
    given = None if origin is None else origin.format(port=port(talking))
    with pytest.raises(InvalidStatus, match="403"):
        talk_to(talking, origin=given)


def handshake(server: Server, *origins: str, host: str | None = None) -> bytes:
    lines = [
        f"GET /{TALK_PATH} HTTP/1.1",
        f"Host: {host or f'127.0.0.1:{port(server)}'}",
        *(f"Origin: {origin}" for origin in origins),
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def test_a_name_that_leads_here_may_not_talk(talking: Server) -> None:
    """Also where the page says that it is of that name."""
    name = f"evil.example:{port(talking)}"
    assert raw(talking, handshake(talking, f"http://{name}", host=name)).startswith(b"HTTP/1.1 403 ")


# ---------------------------------------------------------------------- many connections

MANY = 1000


@pytest.fixture
def many_files() -> Iterator[None]:
    """The test itself has both ends of all connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, 4 * MANY), hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def files() -> int:
    return len(os.listdir("/proc/self/fd"))


def until(look: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not look():
        assert time.monotonic() < deadline
        time.sleep(0.01)


SILENT: bytes = b""
HALF = b"GET /live HTTP/1.1\r\nHost: "
WHOLE = b"GET /rows HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"


@pytest.mark.parametrize(
    "said", [SILENT, HALF, WHOLE, None], ids=["silent", "half", "reads nothing", "unknown"]
)
def test_many_connections_keep_no_page_waiting(talking: Server, many_files: None, said: bytes | None) -> None:
    """They say nothing, half a request, read nothing of a large answer, or talk and are unknown."""
    before = files()
    text = handshake(talking, talking.address.rstrip("/")) if said is None else said
    text = text.replace(b"{port}", str(port(talking)).encode())
    with talk_to(talking) as known:
        known.send("hello")
        with ExitStack() as stack:
            for number in range(MANY):
                made = socket.socket()
                made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                stack.enter_context(closing(made))
                made.connect((LOOPBACK, port(talking)))
                made.sendall(text)
                if number % 100 == 99:
                    known.send(str(number))
                    assert known.recv(10) == str(number)
                    of_server = files() - before - number  # besides those that are being closed
                    assert of_server <= 3 * CONNECTIONS_MAX
            assert get(talking, "/")[1] == b"page"
            assert get(talking, "/rows")[1] == bytes(300_000)
            with talk_to(talking) as other:
                other.send("hello")
                other.send("and I")
                assert other.recv(10) == "and I"
            known.send("at last")
            assert known.recv(10) == "at last"
    until(lambda: files() <= before)
