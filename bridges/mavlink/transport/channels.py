"""UDP, TCP and serial channels behind one interface: read when poll says so, written without waiting.

A serial port is opened exclusively, and watched for bytes that are no MAVLink.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import termios
from typing import Any, Final, Protocol

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport import port_diagnosis
from handfast.bridges.mavlink.transport.connection_string import Connection, Unusable
from handfast.bridges.mavlink.transport.port_diagnosis import LineContents

READ_BYTES: Final = 8192
PEER_NS: Final = 3 * NS_PER_S
"""The sender a waiting UDP port listens to may be silent this long before another takes its place."""
TCP_QUEUE_BYTES: Final = 16384
TCP_SILENT_MS: Final = 3000
"""What was sent and not acknowledged for this long ends the connection, so that it is opened again."""
CONNECT_S: Final = 2.0


class Channel(Protocol):
    """An open connection.

    Attributes:
        note: something odd that does not keep it from working, "" when nothing is.
        trouble: why what comes is of no use, "" while nothing speaks against it.
    """

    @property
    def note(self) -> str: ...

    @property
    def trouble(self) -> str: ...

    def fileno(self) -> int:
        """To poll for reading."""
        ...

    def read(self, now_ns: int) -> bytes:
        """What is there, b"" for nothing of use. Raises OSError when the connection has ended."""
        ...

    def look(self, now_ns: int) -> None:
        """Nothing came for a while: `trouble` may be over."""
        ...

    def write(self, data: bytes) -> bool:
        """Takes all of it, or nothing (False); never waits. Raises OSError when the connection has ended."""
        ...

    def close(self) -> None: ...


def _addresses(connection: Connection, kind: socket.SocketKind, flags: int = 0) -> list[Any]:
    try:
        found = socket.getaddrinfo(connection.host, connection.port, type=kind, flags=flags)
    except socket.gaierror as error:
        raise OSError(f"cannot find the host {connection.host}: {(error.strerror or '').lower()}") from None
    except UnicodeError:
        raise Unusable(f"{connection.host} cannot be the name of a host") from None
    # `localhost` is two places: vehicles and routers are at that of IPv4, to which pymavlink keeps.
    return sorted(found, key=lambda entry: entry[0] != socket.AF_INET)


def would_wait(error: OSError) -> bool:
    """Whether there is only nothing to read, or no room to write, at the moment."""
    return error.errno in (errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS, errno.EINTR)


class _Packets:
    """What network channels have in common: checksums see to it that what comes was sent so."""

    trouble = ""

    def look(self, now_ns: int) -> None:
        """See `Channel`."""


class UdpIn(_Packets):
    """Waits for a vehicle that sends here. Answers go to the first that was heard, until that has been silent
    for 3 s; what others send is dropped.
    """

    def __init__(self, connection: Connection) -> None:
        family, kind, protocol, _, address = _addresses(connection, socket.SOCK_DGRAM, socket.AI_PASSIVE)[0]
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.setblocking(False)
            # Neither SO_REUSEADDR nor SO_REUSEPORT: a second program must not take half of what comes.
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise Unusable(f"port {connection.port} is in use by another program") from None
            raise
        self.note = ""
        self._peer: Any = None
        self._heard_ns = self._stranger_ns = 0

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self, now_ns: int) -> bytes:
        try:
            data, sender = self._socket.recvfrom(READ_BYTES)
        except OSError as error:
            if would_wait(error) or error.errno == errno.ECONNREFUSED:
                return b""  # ECONNREFUSED: an earlier answer found nobody
            raise
        if sender != self._peer:
            if self._peer is not None and 0 <= now_ns - self._heard_ns < PEER_NS:
                self.note = f"{sender[0]}:{sender[1]} sends here too: ignored"
                self._stranger_ns = now_ns
                return b""
            self._peer, self.note = sender, ""
        elif self.note and now_ns - self._stranger_ns >= PEER_NS:
            self.note = ""
        self._heard_ns = now_ns
        return data

    def write(self, data: bytes) -> bool:
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return False  # no way to it at the moment; the port stays open
        return True

    def close(self) -> None:
        self._socket.close()


class UdpOut(_Packets):
    """Sends to a vehicle, and hears only that one."""

    def __init__(self, connection: Connection) -> None:
        family, kind, protocol, _, address = _addresses(connection, socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.setblocking(False)
            self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise
        self._place = connection.text
        self.note = ""

    def fileno(self) -> int:
        return self._socket.fileno()

    def _refused(self, error: OSError) -> None:
        if error.errno == errno.ECONNREFUSED:
            self.note = f"nobody listens at {self._place} (connection refused)"

    def read(self, now_ns: int) -> bytes:
        try:
            data = self._socket.recv(READ_BYTES)
        except OSError as error:
            self._refused(error)
            return b""
        self.note = ""
        return data

    def write(self, data: bytes) -> bool:
        try:
            self._socket.send(data)
        except OSError as error:
            self._refused(error)
            return False
        return True

    def close(self) -> None:
        self._socket.close()


class Stream:
    """Bytes in a row: what was begun is sent to its end before anything else."""

    def __init__(self) -> None:
        self._rest = b""

    def _put(self, data: bytes) -> int:
        raise NotImplementedError

    def write(self, data: bytes) -> bool:
        if self._rest:
            self._rest = self._rest[self._put(self._rest) :]
            if self._rest:
                return False
        sent = self._put(data)
        if sent:
            self._rest = data[sent:]
        return bool(sent)


class Tcp(_Packets, Stream):
    """A connection to a vehicle's TCP port, as of ArduPilot's simulator."""

    note = ""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        _addresses(connection, socket.SOCK_STREAM)  # for its words about a wrong host: the next tries all
        self._socket = socket.create_connection((connection.host, connection.port), CONNECT_S)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A setpoint that has waited long is worth nothing: keep few, and notice a dead peer soon.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, TCP_QUEUE_BYTES)
            if hasattr(socket, "TCP_USER_TIMEOUT"):
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_SILENT_MS)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self, now_ns: int) -> bytes:
        try:
            data = self._socket.recv(READ_BYTES)
        except OSError as error:
            if would_wait(error):
                return b""
            raise
        if not data:
            raise OSError("the vehicle closed the connection")
        return data

    def _put(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except OSError as error:
            if would_wait(error):
                return 0
            raise

    def close(self) -> None:
        self._socket.close()


QUEUE_S: Final = 0.25
"""More than this waiting in a serial port's buffer: what is sent would come too late, and is dropped."""
GONE: Final = "the device is gone"
_BITS: Final = 10


class Serial(Stream):
    """A serial device, opened so that no other program can.

    Raises:
        OSError: it cannot be opened; the text says why, and what to do.
    """

    def __init__(self, connection: Connection, baud: int) -> None:
        super().__init__()
        try:
            import serial
        except ModuleNotFoundError:
            raise Unusable("serial devices need pyserial: pip install 'handfast[rover]'") from None
        self._baud = baud
        device = connection.device
        found = port_diagnosis.before_opening(device)
        if found is not None:
            raise found.error
        try:
            self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except serial.SerialException as error:
            raise port_diagnosis.refused(device, _number(error)).error from None
        except ValueError:
            raise Unusable(f"it cannot be set to {baud} baud") from None
        self._handle = self._port.fileno()
        with contextlib.suppress(OSError):  # pyserial's lock keeps only those out who ask for it
            fcntl.ioctl(self._handle, termios.TIOCEXCL)
        self._console = port_diagnosis.console_note(device)
        self._contents = LineContents(baud)

    @property
    def note(self) -> str:
        """See `Channel`."""
        return self._contents.note or self._console

    @property
    def trouble(self) -> str:
        """See `Channel`."""
        return self._contents.trouble

    def fileno(self) -> int:
        return int(self._handle)

    def read(self, now_ns: int) -> bytes:
        try:
            data = os.read(self._handle, READ_BYTES)
        except OSError as error:
            if would_wait(error):
                return b""
            raise OSError(GONE) from None
        if not data:  # readable, and yet nothing: that is how an unplugged one looks
            raise OSError(GONE)
        self._contents.take(now_ns, data)
        return data

    def look(self, now_ns: int) -> None:
        """See `Channel`."""
        self._contents.look(now_ns)

    def _put(self, data: bytes) -> int:
        try:
            if self._port.out_waiting * _BITS > self._baud * QUEUE_S:
                return 0
            return os.write(self._handle, data)
        except OSError as error:
            if would_wait(error):
                return 0
            raise OSError(GONE) from None

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


def _number(error: OSError) -> int:
    """The `errno` behind what pyserial raises."""
    cause = error.__context__
    if error.errno is None and isinstance(cause, termios.error):
        return int(cause.args[0])
    return error.errno or errno.EINVAL
