"""Serves a page and what it asks for over HTTP, to this machine alone."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from http import HTTPStatus
from typing import Final, NamedTuple

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK: Final = "127.0.0.1"
_NAMES: Final = frozenset({LOOPBACK, "localhost"})


class Content(NamedTuple):
    """What is given: the bytes and what they are."""

    body: bytes
    kind: str


Answer = Callable[[str], Content | None]
"""What there is at a path (without its "/"), None where there is nothing."""


class Server:
    """The server at `address`, once it is made; `serve` answers until it is stopped.

    Args:
        answer: what there is at a path. It is called one request at a time.
        policy: Content-Security-Policy of every answer.
        port: 0 for any that is free.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, answer: Answer, policy: str, port: int = 0) -> None:
        self._answer, self._policy = answer, policy
        self._socket = socket.create_server((LOOPBACK, port), reuse_port=False)
        self._port: Final[int] = self._socket.getsockname()[1]
        self._hosts = {f"{name}:{self._port}" for name in _NAMES}

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{LOOPBACK}:{self._port}/"

    async def serve(self) -> None:
        """Answers requests until this is cancelled."""
        async with serve(
            _no_socket, sock=self._socket, process_request=self._process, server_header=None, max_size=1024
        ):
            await asyncio.get_running_loop().create_future()

    def close(self) -> None:
        self._socket.close()

    def _process(self, _: ServerConnection, request: Request) -> Response:
        # A page of others could have its name lead to this machine, and read the recording by it.
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return self._response(HTTPStatus.FORBIDDEN, _text("another host name than this server's\n"))
        content = self._answer(request.path.partition("?")[0].removeprefix("/"))
        if content is None:
            return self._response(HTTPStatus.NOT_FOUND, _text("there is nothing here\n"))
        return self._response(HTTPStatus.OK, content)

    def _response(self, status: HTTPStatus, content: Content) -> Response:
        headers = Headers(
            {
                "Content-Type": content.kind,
                "Content-Length": str(len(content.body)),
                "Content-Security-Policy": self._policy,
                "Cache-Control": "no-store",
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cross-Origin-Resource-Policy": "same-origin",
                "Connection": "close",
            }
        )
        return Response(status.value, status.phrase, headers, content.body)


def _text(text: str) -> Content:
    return Content(text.encode(), "text/plain; charset=utf-8")


async def _no_socket(_: ServerConnection) -> None:
    """Never called: every request is answered before it could become a WebSocket."""
