"""Turns ``SO_LINGER`` off on Zenoh's sockets, so that closing one does not wait.

Zenoh sets ``SO_LINGER`` to 10 s on every TCP and TLS link. When a peer has gone without a word (its cable,
its radio, its power), the close of its link then blocks a thread of Zenoh's for so long, and with it every
other link of the process. Measured: two robots that hear each other well stopped to for as long as a third
was away, with one thread, and with Zenoh's own number of them as soon as as many peers were gone. Without
it, the kernel sees to what is left to be sent.
"""

from __future__ import annotations

import os
import socket
import stat
from struct import Struct
from typing import Final

FOLDER: Final = "/dev/fd"
"""Lists the file descriptors of the process."""
_LINGER: Final = Struct("ii")  # whether, and for how many seconds


class Lingering:
    """The sockets of this process. Each is looked at again until it was changed: Zenoh has a link linger only
    once it is open."""

    def __init__(self) -> None:
        self._done: set[int] = set()

    def end(self) -> int:
        """Has no TCP socket wait when it is closed; how many were changed."""
        try:
            names = os.listdir(FOLDER)
        except OSError:
            return 0  # no file handle is left for that: next time
        changed, there = 0, set()
        for name in names:
            try:
                about = os.fstat(int(name))
                if not stat.S_ISSOCK(about.st_mode):
                    continue
                there.add(about.st_ino)
                if about.st_ino not in self._done and _without(int(name)):
                    self._done.add(about.st_ino)
                    changed += 1
            except OSError:
                continue  # closed meanwhile
        self._done &= there
        return changed


def _without(handle: int) -> bool:
    """Whether it was a TCP socket that lingered; it does no more."""
    own = os.dup(handle)
    try:
        found = socket.socket(fileno=own)
    except OSError:  # it has become something else
        os.close(own)
        raise
    with found:
        if found.family not in (socket.AF_INET, socket.AF_INET6) or found.type != socket.SOCK_STREAM:
            return False
        lingers, _ = _LINGER.unpack(found.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size))
        if lingers:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
        return bool(lingers)
