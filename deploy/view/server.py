"""Serves a page, what it asks for over HTTP, and, where there is one, a conversation over a WebSocket."""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Final, NamedTuple

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK: Final = "127.0.0.1"
TALK_PATH: Final = "live"
"""Where the WebSocket is."""
MESSAGE_BYTES_MAX: Final = 16_384
"""A longer message of a page ends its connection."""
CONNECTIONS_MAX: Final = 100
"""Of more that are not kept the oldest is closed: each takes a file, of which a process has not many."""
PING_S: Final = 5.0
"""A page that does not answer for twice as long is gone."""
SEND_BYTES: Final = 65_536
"""So much may wait in the system to be sent to one page: a frozen one is not sent what is long past."""
_NAMES: Final = frozenset({LOOPBACK, "localhost"})


class Content(NamedTuple):
    """What is given: the bytes and what they are."""

    body: bytes
    kind: str


Answer = Callable[[str], Content | None]
"""What there is at a path (without its "/"), None where there is nothing."""
Talk = Callable[[ServerConnection], Awaitable[None]]
"""Holds one conversation until it returns, or its connection ends; `keep` is for those that are known."""


class _Connection(ServerConnection):
    """A connection that makes room for new ones, unless it is to be kept (`keep`)."""

    brief: dict[_Connection, None]
    """Those that are not, the oldest first; of the class that a `Server` makes of this one."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.brief[self] = None
        if len(self.brief) > CONNECTIONS_MAX:
            oldest = next(iter(self.brief))
            del self.brief[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self.brief.pop(self, None)
        super().connection_lost(exc)


def keep(connection: ServerConnection) -> None:
    """This one is known: from now on it makes no room for others."""
    if isinstance(connection, _Connection):
        connection.brief.pop(connection, None)


class Server:
    """The server at `address`, once it is made; `serve` answers until it is stopped.

    Args:
        answer: what there is at a path. It is called one request at a time.
        policy: Content-Security-Policy of every answer.
        port: 0 for any that is free.
        talk: with a page that asks for a WebSocket at `TALK_PATH`; None refuses it.
        host: address to listen on.
        names: by which pages may call this server, besides `host`.
        tls: with which it proves who it is; None talks in the clear.

    Raises:
        OSError: the address cannot be had, or the port is taken.
    """

    def __init__(
        self,
        answer: Answer,
        policy: str,
        port: int = 0,
        talk: Talk | None = None,
        *,
        host: str = LOOPBACK,
        names: frozenset[str] = frozenset(),
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self.answer = answer
        self._policy, self._talk, self._tls = policy, talk, tls
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family, reuse_port=False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
        # Else a frame after a text waits until the browser acknowledges that, some 40 ms. Connections get it
        # from here; asyncio sets it only for sockets that say of which protocol they are.
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        shown = f"[{host}]" if ":" in host else host
        self._port: Final[int] = self._socket.getsockname()[1]
        known = {shown, *names, *(_NAMES if host == LOOPBACK else ())}
        self._hosts = {f"{name}:{self._port}" for name in known}
        self._scheme = "http" if tls is None else "https"
        self.address: Final = f"{self._scheme}://{shown}:{self._port}/"
        """What to open in a browser."""

    async def serve(self) -> None:
        """Answers requests until this is cancelled."""
        counted = type("Counted", (_Connection,), {"brief": {}})
        async with serve(
            self._hold,
            sock=self._socket,
            process_request=self._process,
            server_header=None,
            max_size=MESSAGE_BYTES_MAX,
            max_queue=4,
            write_limit=SEND_BYTES,
            compression=None,  # it would cost more than the bytes that it spares
            ping_interval=PING_S,
            ping_timeout=PING_S,
            close_timeout=1.0,
            create_connection=counted,
            ssl=self._tls,
        ):
            await asyncio.get_running_loop().create_future()

    def close(self) -> None:
        self._socket.close()

    async def _hold(self, connection: ServerConnection) -> None:
        assert self._talk is not None  # else every request was answered before it became a WebSocket
        await self._talk(connection)

    def _process(self, _: ServerConnection, request: Request) -> Response | None:
        # A page of others could have its name lead to this machine, and read what is here by it.
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return self._response(HTTPStatus.FORBIDDEN, _text("another host name than this server's\n"))
        path = request.path.partition("?")[0].removeprefix("/")
        if path == TALK_PATH and self._talk is not None:
            # Browsers let any page open a WebSocket to anybody, but say whose page it is.
            origins = request.headers.get_all("Origin")
            if origins != [f"{self._scheme}://{hosts[0]}"]:
                return self._response(HTTPStatus.FORBIDDEN, _text("a page of another server\n"))
            return None
        content = self.answer(path)
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
