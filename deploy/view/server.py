"""Serves a page and its files over HTTP, and a conversation over a WebSocket; to other machines with TLS."""

from __future__ import annotations

import asyncio
import os
import socket
import ssl
import sys
import tempfile
import time
import webbrowser
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from typing import Final, NamedTuple

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import CertificateError, new_key, new_request, pem_of_key
from handfast.agent.security.identity import IdentityError, addresses, of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.certificate_authority import Authority, AuthorityError
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, keys_folder, operator_name
from handfast.deploy.playback.page import asset, served

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


def open_browser(address: str) -> bool:
    """Opens `address` in a browser that has a window, and says whether there is one; never one in the
    terminal."""
    if sys.platform not in ("darwin", "win32") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False
    try:
        return webbrowser.open(address)
    except webbrowser.Error:
        return False


_KINDS: Final = {"js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8"}


def page_files(what: str) -> Callable[[str], Content | None]:
    """What there is at a path: the page, which shows `what` ("live" or "recorded"), and its files."""
    page = Content(served(what), "text/html; charset=utf-8")

    def answer(path: str) -> Content | None:
        if path == "":
            return page
        found = asset(path)
        return None if found is None else Content(found, _KINDS[path.rpartition(".")[2]])

    return answer


OPTION: Final = "--listen"


def address_of(text: str) -> str:
    """An address of this machine by which browsers reach it, as certificates have it.

    Raises:
        InputError: it is none, or stands for all of them.
    """
    try:
        (address,) = addresses((text,))
    except IdentityError as error:
        raise InputError(f"{OPTION} {error}") from None
    try:
        is_any = ip_address(address).is_unspecified
    except ValueError:
        is_any = False
    if is_any:
        raise InputError(f"{OPTION} {text}: give the one address by which browsers reach this machine")
    return address


def tls_of(fleet: Fleet, address: str, port: int) -> ssl.SSLContext:
    """TLS for a server at `address`, with a key that no file keeps.

    Raises:
        InputError: the fleet is not secured, or its authority is not on this machine.
    """
    name = fleet.fleet.name
    tunnel = f"ssh -L {port or 8080}:127.0.0.1:{port or 8080} to this machine shows the page there as well"
    if not fleet.is_secured:
        raise InputError(
            f"{OPTION} {address}: {name} is not secured: anybody who sees the page's address on the network "
            f"could drive it. Secure it (docs/security.md), or leave {OPTION} out: {tunnel}"
        )
    folder = keys_folder(name)
    if not (folder / AUTHORITY_FILE).exists():
        raise InputError(
            f"{OPTION} {address}: the authority of {name} is not on this machine, which has to sign the "
            f"page's certificate. Serve the page where it is, or leave {OPTION} out: {tunnel}"
        )
    try:
        identity, key, now_s = of_operator(name, operator_name()), new_key(), time.time()
        with Authority(folder, name, fleet.ids, now_s) as authority:
            chain = authority.sign(identity, new_request(key, identity), (address,), now_s)
    except (IdentityError, AuthorityError, CertificateError) as error:
        raise InputError(f"{OPTION} {address}: {error}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    with tempfile.TemporaryDirectory() as private:  # its mode is 0700, and it is gone in a moment
        path = Path(private) / "page.pem"
        path.write_bytes(pem_of_key(key) + chain)
        context.load_cert_chain(path)
    return context
