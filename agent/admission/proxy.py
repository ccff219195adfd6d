"""Takes connections in a process's place, and passes on those that are let through, byte by byte.

TLS goes through untouched, from end to end: this has no key, and counts records to see who was let in. One
thread that never waits: of each connection at most `BUFFER_BYTES` are held each way, and nothing more is read
until they are taken.
"""

from __future__ import annotations

import errno
import selectors
import socket
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Final, NamedTuple

from agent.admission.budgets import Budgets, Outcome, Refused, Ticket
from agent.admission.tls_records import PROVEN_RECORDS, NotTlsError, RecordCounter, has_client_hello

BUFFER_BYTES: Final = 65_536
CONNECTIONS_MAX: Final = 1024
"""Held at once; each takes two file handles."""
ACCEPTS_MAX: Final = 64
"""Connections that are taken in one turn: those that are let through already shall not wait long."""
BACKLOG: Final = 1024
"""Connections that the kernel holds until they are taken."""
DEFER_S: Final = 2
"""A connection that says nothing does not come out of the kernel for about so long."""
NO_HELLO: Final = "it said nothing, or not all of it in time"
NOT_TLS: Final = "it does not speak TLS"
NOT_PROVEN: Final = "it has shown no certificate of this fleet"
_CLOSE_AT_ONCE: Final = struct.pack("ii", 1, 0)
_FULL: Final = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Door(NamedTuple):
    """Where connections come in, and where those go that are let through: (address, port)."""

    listener: socket.socket
    target: tuple[str, int]


def listener(address: tuple[str, int]) -> socket.socket:
    """A socket that listens there. `OSError` when that cannot be."""
    family, kind, protocol, _, where = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0]
    made = socket.socket(family, kind, protocol)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_DEFER_ACCEPT"):  # Linux
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, DEFER_S)
        made.bind(where)
        made.listen(BACKLOG)
        made.setblocking(False)
    except OSError:
        made.close()
        raise
    return made


class _End:
    """One socket of a connection, and what still waits to be sent on it."""

    __slots__ = ("events", "other", "socket", "unsent")

    def __init__(self, made: socket.socket) -> None:
        self.socket = made
        self.unsent = b""
        self.other: _End | None = None
        self.events = 0


class _Connection:
    """A connection on its way through: the client's end, and the server's once it was let through."""

    __slots__ = ("client", "hello", "is_proven", "records", "server", "since_s", "target", "ticket")

    def __init__(self, client: _End, ticket: Ticket, target: tuple[str, int], since_s: float) -> None:
        self.client, self.ticket, self.target, self.since_s = client, ticket, target, since_s
        self.server: _End | None = None
        self.hello = b""
        self.records = RecordCounter()
        self.is_proven = False


class Proxy:
    """Passes connections on, from their doors to their targets. A context manager; it owns the listeners.

    Args:
        doors: where connections come in and go to.
        budgets: who is let through.
        deadline_s: a connection that has proven nothing by then is closed.
        refused: called with a few words for each connection that is refused.
        proven: called when another source has proven itself.

    Attributes:
        passed, turned_away: connections so far that have proven themselves, and that were refused.
    """

    def __init__(
        self,
        doors: Sequence[Door],
        budgets: Budgets,
        deadline_s: float,
        refused: Callable[[str], None],
        proven: Callable[[], None] = lambda: None,
    ) -> None:
        self._budgets, self._deadline_s = budgets, deadline_s
        self._refused, self._proven = refused, proven
        self._doors = doors
        self._selector = selectors.DefaultSelector()
        self._connections: set[_Connection] = set()
        self._unproven: OrderedDict[_Connection, None] = OrderedDict()
        """Oldest first."""
        self.passed = self.turned_away = 0
        for door in doors:
            self._selector.register(door.listener, selectors.EVENT_READ, door)

    def __enter__(self) -> Proxy:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """Connections that are held."""
        return len(self._connections)

    def close(self) -> None:
        """Ends all connections, and listens no more."""
        for connection in list(self._connections):
            self._end(connection, Outcome.NOBODY, 0.0)
        for door in self._doors:
            door.listener.close()
        self._selector.close()

    def turn(self, timeout_s: float, clock_s: Callable[[], float]) -> None:
        """Waits for something to do, for `timeout_s` at most, and does all there is.

        Args:
            clock_s: a clock that never goes back, s.
        """
        events = self._selector.select(timeout_s)
        now_s = clock_s()
        doors = []
        for key, mask in events:
            if isinstance(key.data, Door):
                doors.append(key.data)
                continue
            connection, end = key.data
            if connection in self._connections:  # else it ended in this turn
                self._serve(connection, end, mask, now_s)
        for door in doors:
            for client, address in self._accepted(door):
                self._open(client, address, door, now_s)
        while self._unproven:
            oldest = next(iter(self._unproven))
            if now_s - oldest.since_s < self._deadline_s:
                break
            self._fail(oldest, NO_HELLO if oldest.server is None else NOT_PROVEN, now_s)

    # ------------------------------------------------------------------ in

    def _accepted(self, door: Door) -> Iterator[tuple[socket.socket, str]]:
        for _ in range(ACCEPTS_MAX):
            try:
                client, address = door.listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _FULL:
                    return  # the next turn tries again, when others may have ended
                continue  # it has gone already
            yield client, address[0]

    def _open(self, client: socket.socket, address: str, door: Door, now_s: float) -> None:
        if len(self._connections) >= CONNECTIONS_MAX:
            self._turn_away(client, address, f"{CONNECTIONS_MAX} are held already")
            return
        ticket = self._budgets.opened(address, now_s)
        if isinstance(ticket, Refused):
            self._turn_away(client, address, ticket.value)
            return
        client.setblocking(False)
        connection = _Connection(_End(client), ticket, door.target, now_s)
        self._connections.add(connection)
        self._unproven[connection] = None
        self._listen(connection, connection.client, selectors.EVENT_READ)
        self._hear_hello(connection, now_s)  # mostly it is there: the kernel has waited for it

    def _turn_away(self, client: socket.socket, address: str, why: str) -> None:
        self.turned_away += 1
        self._refused(f"connections of {address}: {why}")
        _abort(client)

    def _serve(self, connection: _Connection, end: _End, mask: int, now_s: float) -> None:
        if connection.server is None:
            self._hear_hello(connection, now_s)
            return
        if mask & selectors.EVENT_WRITE and not self._flush(connection, end, now_s):
            return
        if mask & selectors.EVENT_READ and connection in self._connections:
            self._pass_on(connection, end, now_s)

    # ------------------------------------------------------------------ until it is let through

    def _hear_hello(self, connection: _Connection, now_s: float) -> None:
        try:
            data = connection.client.socket.recv(BUFFER_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._fail(connection, NO_HELLO, now_s)
            return
        connection.hello += data
        try:
            if not has_client_hello(connection.hello):
                return
        except NotTlsError:
            self._fail(connection, NOT_TLS, now_s)
            return
        why = self._budgets.begun(connection.ticket, now_s)
        if why is None:
            self._dial(connection, now_s)
            return
        self.turned_away += 1
        self._refused(f"connections of {connection.ticket.address}: {why.value}")
        self._end(connection, Outcome.NOBODY, now_s, at_once=True)

    def _dial(self, connection: _Connection, now_s: float) -> None:
        """Connects to the target, and has what the client said so far wait until it answers."""
        made = None
        try:
            made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            made.setblocking(False)
            error = made.connect_ex(connection.target)
            if error not in (0, errno.EINPROGRESS):
                raise OSError(error, "cannot connect")
            for each in (made, connection.client.socket):
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError:
            if made is not None:
                made.close()
            self._end(connection, Outcome.NOBODY, now_s, at_once=True)
            return
        server = connection.server = _End(made)
        server.other, connection.client.other = connection.client, server
        server.unsent, connection.hello = connection.hello, b""
        self._listen(connection, connection.client, 0)
        self._listen(connection, server, selectors.EVENT_READ | selectors.EVENT_WRITE)

    # ------------------------------------------------------------------ through

    def _pass_on(self, connection: _Connection, end: _End, now_s: float) -> None:
        other = end.other
        assert other is not None
        try:
            data = end.socket.recv(BUFFER_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._over(connection, now_s)
            return
        if not connection.is_proven and end is connection.server:
            self._look(connection, data, now_s)
        try:
            sent = other.socket.send(data)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._over(connection, now_s)
            return
        if sent < len(data):  # until the rest is sent nothing more is read for it
            other.unsent = data[sent:]
            self._listen(connection, other, other.events | selectors.EVENT_WRITE)
            self._listen(connection, end, end.events & ~selectors.EVENT_READ)

    def _flush(self, connection: _Connection, end: _End, now_s: float) -> bool:
        """Sends what waits for `end`; False when the connection has ended over it."""
        try:
            sent = end.socket.send(end.unsent)
        except BlockingIOError:
            return True
        except OSError as error:
            if error.errno == errno.ECONNREFUSED:  # the target is not there now
                self._end(connection, Outcome.NOBODY, now_s, at_once=True)
            else:
                self._over(connection, now_s)
            return False
        end.unsent = end.unsent[sent:]
        if not end.unsent:
            assert end.other is not None
            self._listen(connection, end, end.events & ~selectors.EVENT_WRITE)
            self._listen(connection, end.other, end.other.events | selectors.EVENT_READ)
        return True

    def _look(self, connection: _Connection, data: bytes, now_s: float) -> None:
        """Looks in what the server says whether it has let the client in."""
        try:
            connection.records.take(data)
        except NotTlsError:
            return  # then it does not prove anything: the deadline ends it
        if connection.records.count < PROVEN_RECORDS:
            return
        connection.is_proven = True
        del self._unproven[connection]
        self.passed += 1
        if self._budgets.ended(connection.ticket, Outcome.PROVEN, now_s):
            self._proven()

    # ------------------------------------------------------------------ out

    def _over(self, connection: _Connection, now_s: float) -> None:
        """One end has closed the connection."""
        if connection.is_proven:
            self._end(connection, Outcome.PROVEN, now_s)
        else:
            self._fail(connection, NOT_PROVEN, now_s)

    def _fail(self, connection: _Connection, why: str, now_s: float) -> None:
        self.turned_away += 1
        self._refused(f"connections of {connection.ticket.address}: {why}")
        self._end(connection, Outcome.FAILED, now_s)

    def _end(self, connection: _Connection, outcome: Outcome, now_s: float, *, at_once: bool = False) -> None:
        """Closes both ends; what the kernel has of it is sent still, unless `at_once`."""
        self._connections.discard(connection)
        if not connection.is_proven:
            self._unproven.pop(connection, None)
            self._budgets.ended(connection.ticket, outcome, now_s)
        for end in (connection.client, connection.server):
            if end is None:
                continue
            self._listen(connection, end, 0)
            if end.unsent:
                with suppress(OSError):
                    end.socket.send(end.unsent)
            if at_once:
                _abort(end.socket)
            else:
                end.socket.close()

    def _listen(self, connection: _Connection, end: _End, events: int) -> None:
        """Has the selector wait for these events of an end, and no others."""
        if events == end.events:
            return
        if not events:
            self._selector.unregister(end.socket)
        elif not end.events:
            self._selector.register(end.socket, events, (connection, end))
        else:
            self._selector.modify(end.socket, events, (connection, end))
        end.events = events


def _abort(made: socket.socket) -> None:
    """Closes a socket, and leaves nothing of it in the kernel."""
    with suppress(OSError):
        made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _CLOSE_AT_ONCE)
    made.close()
