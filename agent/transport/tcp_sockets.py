"""The TCP sockets of this process that its libraries opened: found by their descriptors, and shut down.

Closing one shall not wait. Zenoh sets ``SO_LINGER`` to 10 s on every TCP and TLS link. When a peer has gone
without a word (its cable, its radio, its power), the close of its link then blocks a thread of Zenoh's for so
long, and with it every other link of the process. Measured: two robots that hear each other well stopped to
for as long as a third was away, with one thread, and with Zenoh's own number of them as soon as as many peers
were gone. Without ``SO_LINGER`` the kernel sees to what is left to be sent.
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import stat
import termios
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from struct import Struct
from typing import Final, NamedTuple

FOLDER: Final = "/dev/fd"
"""Lists the file descriptors of the process."""


_INFO: Final = Struct("=B7x4x4x4x4x4x4x4x4x4xI4x4x4x4x4x4x4x4x4x4x4x4x4x4x8x8xQQ")
"""Of struct tcp_info (linux/tcp.h): state, last_data_sent (ms), bytes_acked, bytes_received."""
_CALM: Final = select.EPOLLOUT, select.EPOLLOUT | select.EPOLLIN
"""Of a link that is open and takes what is sent: nothing, or something, waits to be read."""


class TcpSocket(NamedTuple):
    """One of them: its descriptor, and its inode, which no other socket has while it lives."""

    number: int
    inode: int


class TcpSockets:
    """Those that are open. What a socket is, is looked for once."""

    def __init__(self) -> None:
        self._tcp: dict[int, bool] = {}

    def look(self) -> list[TcpSocket] | None:
        """All that are open now; None where that cannot be told: no descriptor is left to look with."""
        try:
            names = os.listdir(FOLDER)
        except OSError:
            return None
        found: list[TcpSocket] = []
        there: dict[int, bool] = {}
        known = self._tcp
        for name in names:
            number = int(name)
            with suppress(OSError):  # closed meanwhile
                about = os.fstat(number)
                if not stat.S_ISSOCK(about.st_mode):
                    continue
                inode = about.st_ino
                is_tcp = known.get(inode)
                there[inode] = is_tcp = _is_tcp(number) if is_tcp is None else is_tcp
                if is_tcp:
                    found.append(TcpSocket(number, inode))
        self._tcp = there
        return found


class Calm:
    """Whether nothing has changed since all links were looked at and nothing waited on any: three system
    calls, whatever else is open, and however many links there are, and two more for each on which something
    waits. It mostly does so for less than a millisecond: where something has been read since, that is calm.

    Attributes:
        waits: whether something waited on a link when it was asked last.
    """

    def __init__(self) -> None:
        self._poll: select.epoll | None = None
        self._links = self._lowest = 0
        self._read: dict[int, int] = {}
        """By descriptor: how many bytes had been read of those on which something waited at the last look."""

    def begin(self, links: Collection[TcpSocket]) -> None:
        """Notes that these are all links, and that nothing waits on them."""
        self.end()
        try:
            self._poll = select.epoll(len(links) + 1)
            for each in links:
                self._poll.register(each.number, select.EPOLLIN | select.EPOLLOUT)
        except OSError:  # closed meanwhile, or no descriptor is left
            self.end()
            return
        self._links, self._lowest = len(links), lowest_free(self._poll.fileno())

    def end(self) -> None:
        """Notes that something may have changed."""
        self._read = {}
        if self._poll is not None:
            self._poll.close()
            self._poll = None

    @property
    def waits(self) -> bool:
        return bool(self._read)

    def lasts(self) -> bool:
        """Whether each link is there and open, something was read from it since the last look if something
        waited then and does now, and nothing else was opened."""
        if self._poll is None or lowest_free(self._poll.fileno()) != self._lowest:
            return False
        # One that is closed is not among them any more, though another may have its number.
        found = self._poll.poll(0)
        if len(found) != self._links:
            return False
        before, self._read = self._read, {}
        for number, event in found:
            if event == select.EPOLLOUT:
                continue
            read = _read_of(number) if event in _CALM else None
            if read is None or read == before.get(number):
                return False
            self._read[number] = read
        return True


def _read_of(number: int) -> int | None:
    """How many bytes have been read from a link on which some wait; None where it is closed."""
    try:
        with borrowed(number) as found:
            waiting, received = waiting_on(number), info_of(found)[3]
    except OSError:
        return None
    return received - waiting if waiting else None


def waiting_on(number: int) -> int:
    """How many bytes wait to be read."""
    return int.from_bytes(fcntl.ioctl(number, termios.FIONREAD, bytes(4)), "little")


def info_of(found: socket.socket) -> tuple[int, int, int, int]:
    """Of a TCP connection: its state, how long ago it sent data (ms), bytes acknowledged, bytes received."""
    return _INFO.unpack(found.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO.size))


def lowest_free(number: int) -> int:
    """The number that the next descriptor gets, -1 where there is none left; `number` is any that is open."""
    try:
        found = fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, 0)
    except OSError:
        return -1
    os.close(found)
    return found


@contextmanager
def borrowed(number: int) -> Iterator[socket.socket]:
    """A descriptor as a socket, which stays whoever's it is; raises OSError where it is none.

    Its owner may close it meanwhile: to be read from, and no more.
    """
    found = socket.socket(fileno=number)
    try:
        yield found
    finally:
        found.detach()


@contextmanager
def held(which: TcpSocket) -> Iterator[socket.socket]:
    """As `borrowed`, and it is no other's though its owner close it meanwhile; raises OSError where it is."""
    # Not `socket.dup`, which would have its owner's block.
    own = os.dup(which.number)
    try:
        found = socket.socket(fileno=own)
    except OSError:  # it has become something else
        os.close(own)
        raise
    with found:
        if os.fstat(own).st_ino != which.inode:
            raise OSError("it is another socket by now")
        yield found


def _is_tcp(number: int) -> bool:
    with borrowed(number) as found:
        return found.family in (socket.AF_INET, socket.AF_INET6) and found.type == socket.SOCK_STREAM


_LINGER: Final = Struct("ii")  # whether, and for how many seconds


class Lingering:
    """The sockets of this process. Each is looked at again until it was changed: Zenoh has a link linger only
    once it is open.

    Attributes:
        is_done: whether there is none left to be changed.
    """

    def __init__(self) -> None:
        self.is_done = False
        self._done: set[int] = set()
        self._sockets = TcpSockets()

    def end(self, found: Sequence[TcpSocket] | None = None) -> int:
        """Has no TCP socket wait when it is closed; how many were changed.

        Args:
            found: all of them, where they are known.
        """
        if found is None and (found := self._sockets.look()) is None:
            return 0  # no file handle is left for that: next time
        changed = 0
        for each in found:
            if each.inode not in self._done:
                with suppress(OSError):  # closed meanwhile
                    does = _without(each)
                    if does is not False:
                        self._done.add(each.inode)
                        changed += does is True
        inodes = {each.inode for each in found}
        self._done &= inodes
        self.is_done = self._done == inodes
        return changed


def _without(which: TcpSocket) -> bool | None:
    """Whether it lingered; it does no more. None for one that listens, which never will."""
    with held(which) as found:
        lingers, _ = _LINGER.unpack(found.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size))
        if lingers:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
            return True
        return None if found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) else False
