"""The TCP sockets of this process that its libraries opened: found by their descriptors, and shut down."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final, NamedTuple

FOLDER: Final = "/dev/fd"
"""Lists the file descriptors of the process."""


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
