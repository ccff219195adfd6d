"""Keeps strangers who knock from filling a robot's process: when many wait, nobody new is let in.

Zenoh takes every connection at once and looks at them one after the other; one that fails costs 100 ms
(eclipse-zenoh #2685). So who knocks more than ten times a second makes a queue of what was taken, with a
descriptor and some 2 kB for each. It grows without end; and when the process may open nothing more
(getrlimit(2), RLIMIT_NOFILE), what waits is never looked at again, and no file of its own opens either.

The gate is a filter on the sockets that listen (socket(7), SO_ATTACH_FILTER), which drops what comes for
them: a caller's kernel says it again some times, and finds the gate open. Links that are there have sockets
of their own, and notice nothing.
"""

from __future__ import annotations

import ctypes
import os
import resource
import socket
import struct
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Final

from agent.common.time import NS_PER_S

WAITING: Final = 128
"""So many may wait, and for each robot of the fleet `EACH` more: all start together. Fewer would make it easy
to fill the places with connections that say nothing, which are given up after 10 s."""
EACH: Final = 4
OPENED_MAX: Final = 65_536
"""So many descriptors a process may have, where the system lets it: more than come between two looks."""
SHUT_NS: Final = 20 * NS_PER_S
"""After so long it is opened in any case: a process may have come to use many files of its own, and must not
stay without new links for that. A connection that says nothing is given up after half of it."""
SAY_PERIOD_NS: Final = 60 * NS_PER_S
_ATTACH, _DETACH = 26, 27
"""SO_ATTACH_FILTER and SO_DETACH_FILTER (asm-generic/socket.h)."""
_DROP: Final = struct.pack("=HBBI", 0x06, 0, 0, 0)
"""One instruction of a filter, BPF_RET: nothing of the packet is kept."""


class Gate:
    """The gate of one process, to be made when it listens. A context manager.

    Args:
        robots: how many the fleet has.

    Attributes:
        shut: whether nobody is let in now.
    """

    def __init__(self, robots: int) -> None:
        self.shut = False
        self._shut_ns = self._say_due_ns = 0
        self._stack = ExitStack()
        self._listening: list[socket.socket] = []
        self._waiting = waiting = WAITING + EACH * robots
        opened = _opened()
        for number in opened:
            self._take(number, waiting)
        self._most = max(opened, default=0) + len(self._listening) + waiting
        self._few = self._most - waiting // 2
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = OPENED_MAX if hard == resource.RLIM_INFINITY else min(hard, OPENED_MAX)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))

    def _take(self, number: int, waiting: int) -> None:
        """Looks after a descriptor, if it is a socket that listens: the kernel's queue is short as well."""
        with suppress(OSError):
            found = socket.socket(fileno=os.dup(number))
            if found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                self._listening.append(self._stack.enter_context(found))
                found.listen(waiting)
            else:
                found.close()

    def __enter__(self) -> Gate:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def look(self, now_ns: int) -> str:
        """Shuts or opens the gate, by how many wait; returns what is to be said of that, "" for nothing.

        Some microseconds; to be called several times a second.

        Args:
            now_ns: any clock.
        """
        if not self._listening:
            return ""
        if self.shut:
            if len(_opened()) < self._few or not 0 <= now_ns - self._shut_ns < SHUT_NS:
                self._set(_DETACH, bytes(4))
                self.shut = False
            return ""
        number = os.dup(self._listening[0].fileno())  # the lowest that is free
        os.close(number)
        if number < self._most:
            return ""
        program = ctypes.create_string_buffer(_DROP, len(_DROP))
        self._set(_ATTACH, struct.pack("HP", 1, ctypes.addressof(program)))
        self.shut, self._shut_ns = True, now_ns
        if 0 < self._say_due_ns - now_ns <= SAY_PERIOD_NS:
            return ""
        self._say_due_ns = now_ns + SAY_PERIOD_NS
        return (
            f"more than {self._waiting} connections wait to be looked at: nobody new is let in until fewer "
            "do; links that are there go on"
        )

    def _set(self, option: int, value: bytes) -> None:
        for each in self._listening:
            with suppress(OSError):  # no such filter in this kernel: it stays as it was
                each.setsockopt(socket.SOL_SOCKET, option, value)


def _opened() -> list[int]:
    """The descriptors that are open, none where that cannot be told."""
    with suppress(OSError):
        return [int(name) for name in os.listdir("/proc/self/fd")]
    return []
