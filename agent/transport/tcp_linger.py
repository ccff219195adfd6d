"""Turns ``SO_LINGER`` off on Zenoh's sockets, so that closing one does not wait.

Zenoh sets ``SO_LINGER`` to 10 s on every TCP and TLS link. When a peer has gone without a word (its cable,
its radio, its power), the close of its link then blocks a thread of Zenoh's for so long, and with it every
other link of the process. Measured: two robots that hear each other well stopped to for as long as a third
was away, with one thread, and with Zenoh's own number of them as soon as as many peers were gone. Without
it, the kernel sees to what is left to be sent.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from contextlib import suppress
from struct import Struct
from typing import Final

from handfast.agent.transport.tcp_sockets import TcpSocket, TcpSockets, held

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
