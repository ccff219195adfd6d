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
from agent.transport.tcp_sockets import borrowed, lowest_free

WAITING: Final = 96
"""So many may wait, and for each robot of the fleet `EACH` more: all start together. Fewer would make it easy
to fill the places with connections that say nothing, which are given up after 10 s; more take longer to be
looked at when a flood is over, 100 ms each."""
EACH: Final = 4
OPENED_MAX: Final = 65_536
"""So many descriptors a process may have, where the system lets it: more than come between two looks."""
OPENED_MIN: Final = 2_048
"""With fewer, what comes between two looks of a flood may leave none."""
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
        trouble: why it may not be enough here, "" when it is.
    """

    def __init__(self, robots: int) -> None:
        self.shut = False
        self.trouble = ""
        self._say_due_ns = 0
        self._stack = ExitStack()
        self._listening: list[socket.socket] = []
        self._ports: set[int] = set()
        opened = _opened()
        # Half of what it may still open is left to its own files, and to those who come between two looks.
        self._waiting = max(1, min(WAITING + EACH * robots, (_limit() - len(opened)) // 2))
        for number in [number for number in opened if _listens(number)]:
            self._take(number)
        self._few = len(opened) + self._waiting // 2
        if self._listening and _limit() < OPENED_MIN:
            self.trouble = (
                f"this process may open {_limit()} files: in a flood of connections it may open none of its "
                f"own, nor a link again; let it open {OPENED_MIN} (ulimit -Hn)"
            )

    def _take(self, number: int) -> None:
        """Looks after a socket that listens: the kernel's queue is short as well."""
        with suppress(OSError), borrowed(number) as found:
            found.listen(self._waiting)
            # Not `found.dup()`, which would have the socket block: it is Zenoh's.
            self._listening.append(self._stack.enter_context(socket.socket(fileno=os.dup(number))))
            self._ports.add(_port(found))

    def __enter__(self) -> Gate:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def look(self, now_ns: int) -> str:
        """Shuts or opens the gate, by how many wait; returns what is to be said of that, "" for nothing.

        Some microseconds, in a flood a millisecond; to be called five times a second.

        Args:
            now_ns: any clock.
        """
        # A flood takes every number that is free, from the lowest on.
        if not self._listening or not (self.shut or self._are_many()):
            return ""
        opened = _opened()
        if opened and len(opened) <= self._few:  # which is so but in a flood: nothing is looked at
            waiting = 0
        else:  # where it cannot be told nothing more can be opened
            waiting = self._count(opened) if opened else self._waiting + 1
        if self.shut:
            if waiting <= self._waiting // 2:
                self._set(_DETACH, bytes(4))
                self.shut = False
            return ""
        if waiting <= self._waiting:
            return ""
        program = ctypes.create_string_buffer(_DROP, len(_DROP))
        self._set(_ATTACH, struct.pack("HP", 1, ctypes.addressof(program)))
        self.shut = True
        if 0 < self._say_due_ns - now_ns <= SAY_PERIOD_NS:
            return ""
        self._say_due_ns = now_ns + SAY_PERIOD_NS
        return (
            f"more than {self._waiting} connections wait to be looked at: nobody new is let in until fewer "
            "do; links that are there go on"
        )

    def _are_many(self) -> bool:
        lowest = lowest_free(self._listening[0].fileno())
        return lowest > self._few or lowest < 0

    def _count(self, opened: list[int]) -> int:
        """How many of these are connections to what listens here: those that wait, and links."""
        found = 0
        for number in opened:
            with suppress(OSError), borrowed(number) as each:
                listens = each.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
                found += not listens and _port(each) in self._ports
        return found

    def _set(self, option: int, value: bytes) -> None:
        for each in self._listening:
            with suppress(OSError):  # no such filter in this kernel: it stays as it was
                each.setsockopt(socket.SOL_SOCKET, option, value)


def _listens(number: int) -> bool:
    """Whether a descriptor is a socket that listens."""
    with suppress(OSError), borrowed(number) as found:
        return bool(found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))
    return False


def _port(found: socket.socket) -> int:
    """The own port of a socket, -1 where it has none."""
    name = found.getsockname()
    return name[1] if found.family in (socket.AF_INET, socket.AF_INET6) else -1


def _limit() -> int:
    """How many files the process may open, once it may open as many as the system lets it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = OPENED_MAX if hard == resource.RLIM_INFINITY else min(hard, OPENED_MAX)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    return most


def _opened() -> list[int]:
    """The descriptors that are open, none where that cannot be told: there is none left to look with."""
    with suppress(OSError):
        return [int(name) for name in os.listdir("/proc/self/fd")]
    return []
