"""Ports of a simulated rover: TCP as ArduPilot's simulator has it, and UDP. None ever blocks."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, Final, Literal, NamedTuple, Protocol

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.simulator.settings import SettingsError

RECEIVE_BYTES: Final = 65_536
DATAGRAM_BYTES: Final = 1_200
PEER_SILENT_NS: Final = 5 * NS_PER_S
"""A UDP port talks to whom it heard first, until that has been silent for so long."""
Transport = Literal["tcp", "udp"]


class Endpoint(NamedTuple):
    """One port: `listens` there, or sends to there."""

    transport: Transport
    host: str
    port: int
    listens: bool

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.transport}:{host}:{self.port}"


def parse_endpoint(text: str, *, listens: bool) -> Endpoint:
    """Return the endpoint of ``udp:HOST:PORT`` or, to listen on only, of ``tcp:HOST:PORT``.

    Raises:
        SettingsError: the text is neither.
    """
    transport, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    good = host and port.isascii() and port.isdigit() and int(port) <= 65_535
    if transport == "tcp" and listens and good:
        return Endpoint("tcp", host, int(port), listens)
    if transport == "udp" and good:
        return Endpoint("udp", host, int(port), listens)
    wanted = "tcp:HOST:PORT or udp:HOST:PORT" if listens else "udp:HOST:PORT"
    raise SettingsError(f"{text!r} is not {wanted}")


def _address(endpoint: Endpoint) -> tuple[int, tuple[object, ...]]:
    kind = socket.SOCK_STREAM if endpoint.transport == "tcp" else socket.SOCK_DGRAM
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)[0]
    except OSError as error:
        raise SettingsError(f"no host {endpoint.host!r}: {error.strerror}") from None
    return found[0], found[4]


class Line(Protocol):
    """One port."""

    @property
    def is_open(self) -> bool:
        """Whether anybody is there."""
        ...

    @property
    def endpoint(self) -> Endpoint:
        """Where it is, with the number that the system chose where it was 0."""
        ...

    def watched(self) -> socket.socket:
        """The socket on which something may come."""
        ...

    def receive(self, now_ns: int) -> bytes:
        """What came, when there is something on `watched`."""
        ...

    def send(self, messages: Sequence[bytes]) -> None:
        """Sends, or loses what does not fit, as a serial port does."""
        ...

    def restart(self) -> None:
        """The vehicle was off and on: connections are gone."""
        ...

    def close(self) -> None:
        """For good."""
        ...


class TcpLine:
    """Listens, for one client at a time; a second one waits until the first is gone."""

    def __init__(self, endpoint: Endpoint) -> None:
        family, address = _address(endpoint)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind(address)
            self._listener.listen(1)
        except OSError as error:
            self._listener.close()
            raise SettingsError(f"cannot listen on {endpoint}: {error.strerror}") from None
        self._listener.setblocking(False)
        self.endpoint = endpoint._replace(port=self._listener.getsockname()[1])
        self._client: socket.socket | None = None
        self._unsent = b""

    @property
    def is_open(self) -> bool:
        """See `Line`."""
        return self._client is not None

    def watched(self) -> socket.socket:
        """See `Line`."""
        return self._listener if self._client is None else self._client

    def receive(self, now_ns: int) -> bytes:
        """See `Line`; takes a client while it has none."""
        if self._client is None:
            with suppress(OSError):
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(RECEIVE_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.restart()
        return data

    def send(self, messages: Sequence[bytes]) -> None:
        """See `Line`."""
        if self._client is None:
            return
        # What was begun is ended first: half a message would spoil the next.
        data = self._unsent or b"".join(messages)
        try:
            self._unsent = data[self._client.send(data) :]
        except BlockingIOError:
            return
        except OSError:
            self.restart()

    def restart(self) -> None:
        """See `Line`."""
        self._unsent = b""
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """See `Line`."""
        self.restart()
        self._listener.close()


class UdpLine:
    """Sends to its endpoint, or listens there and answers to whom it hears."""

    def __init__(self, endpoint: Endpoint) -> None:
        family, address = _address(endpoint)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._peer: Any = None
        self._heard_ns = 0
        try:
            if endpoint.listens:
                self._socket.bind(address)
                endpoint = endpoint._replace(port=self._socket.getsockname()[1])
            else:
                self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            verb = "listen on" if endpoint.listens else "send to"
            raise SettingsError(f"cannot {verb} {endpoint}: {error.strerror}") from None
        self._socket.setblocking(False)
        self.endpoint = endpoint

    @property
    def is_open(self) -> bool:
        """See `Line`."""
        return self._peer is not None or not self.endpoint.listens

    def watched(self) -> socket.socket:
        """See `Line`."""
        return self._socket

    def receive(self, now_ns: int) -> bytes:
        """See `Line`."""
        came: list[bytes] = []
        while True:
            try:
                data, peer = self._socket.recvfrom(RECEIVE_BYTES)
            except OSError:
                # There is no more, or a datagram of before was refused, which is told here.
                return b"".join(came)
            if self.endpoint.listens and peer != self._peer:
                if self._peer is not None and now_ns - self._heard_ns < PEER_SILENT_NS:
                    continue
                self._peer = peer
            self._heard_ns = now_ns
            came.append(data)

    def send(self, messages: Sequence[bytes]) -> None:
        """See `Line`."""
        datagram = b""
        for message in (*messages, b""):
            if datagram and (not message or len(datagram) + len(message) > DATAGRAM_BYTES):
                # Nobody there (yet), or no room: lost, as on the air.
                with suppress(OSError):
                    if self.endpoint.listens:
                        self._socket.sendto(datagram, self._peer)
                    else:
                        self._socket.send(datagram)
                datagram = b""
            datagram += message

    def restart(self) -> None:
        """See `Line`."""
        self._peer = None

    def close(self) -> None:
        """See `Line`."""
        self._socket.close()


def open_lines(endpoints: Iterable[Endpoint]) -> list[Line]:
    """All of them or none: raises `SettingsError` for the first that cannot be opened."""
    lines: list[Line] = []
    try:
        for endpoint in endpoints:
            lines.append(TcpLine(endpoint) if endpoint.transport == "tcp" else UdpLine(endpoint))
    except SettingsError:
        for line in lines:
            line.close()
        raise
    return lines


def readable(lines: Sequence[Line]) -> list[tuple[int, Line]]:
    """The lines on which something came, with their numbers."""
    ready = set(select.select([line.watched() for line in lines], [], [], 0)[0])
    return [(number, line) for number, line in enumerate(lines) if line.watched() in ready]
