"""The server answers what there is, to this machine, and refuses the rest without harm."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse

import pytest

from deploy.view.server import LOOPBACK, Content, Server

POLICY = "default-src 'none'"


def answer(path: str) -> Content | None:
    return {"": Content(b"page", "text/html"), "rows": Content(bytes(300_000), "application/x")}.get(path)


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server(answer, POLICY)
    loop = asyncio.new_event_loop()
    task = loop.create_task(made.serve())
    thread = threading.Thread(target=lambda: loop.run_until_complete(asyncio.wait([task])))
    thread.start()
    yield made
    loop.call_soon_threadsafe(task.cancel)
    thread.join()
    loop.close()
    made.close()


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


def test_a_request_without_a_host_gets_nothing(server: Server) -> None:
    assert b"page" not in raw(server, b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n")


def test_only_get_is_answered(server: Server) -> None:
    host = f"Host: 127.0.0.1:{port(server)}\r\n".encode()
    for request in (
        b"POST / HTTP/1.1\r\n" + host + b"Content-Length: 0\r\n\r\n",
        b"nonsense\r\n\r\n",
        b"\0" * 4000,
    ):
        assert b" 200 " not in raw(server, request + b"\r\n" * 3)
    assert get(server, "/")[0].status == 200


def test_a_web_socket_is_refused(server: Server) -> None:
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
