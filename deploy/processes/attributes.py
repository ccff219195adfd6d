"""What the system shows and schedules of robots' processes: their command lines, and their shares of
processors.

A forked process has the command line of its parent. The kernel shows the memory in which the arguments
were handed over (proc(5)), so a process writes its own command line there; there is no more room than
they had.

All robots of a fleet do their rounds at about the same time and hear of each other through one router.
This is cheap if nobody is interrupted: a router that finds many messages instead of one passes on more
with less. With SCHED_BATCH (sched(7)) a process that wakes up waits for the end of what runs. Kernels
share processors out by sessions where they can (autogroup), which would leave a router of a hundred
robots one share of two hundred; so all are in the session of the command, and robots are nicer than the
router that serves them. Processes that are still starting are less nice than those that wait for them,
and so is the process of many bodies, all the time; that one interrupts robots as well.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from os import fsencode
from pathlib import Path
from typing import Final

ROOM: Final = 1 << 14
"""Bytes that the command line of a process is made long that forks others, for theirs."""
_ARG_START: Final = 48
"""Of the fields in /proc/PID/stat, as proc(5) counts them; the next one is the end."""


def words_of(module: str, arguments: Sequence[str]) -> list[str]:
    """The command line of a program of ours."""
    # -P: a folder called `agent` in the working directory must not be taken for the package.
    return [sys.executable, "-P", "-m", module, *arguments]


def area() -> tuple[int, int]:
    """Address and size (bytes) of the memory of this process's arguments, (0, 0) where that is not known."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()  # from the third on
        begin, end = (int(field) for field in fields[_ARG_START - 3 : _ARG_START - 1])
    except (OSError, ValueError):
        return 0, 0
    return (begin, end - begin) if 0 < begin < end else (0, 0)


def room(words: Sequence[str]) -> int:
    """How many bytes a command line takes."""
    return sum(len(fsencode(word)) + 1 for word in words)


def show(words: Sequence[str]) -> None:
    """Has this process seen under the command line `words`.

    Raises:
        ValueError: there is no room for it.
    """
    import ctypes  # here: who only looks need not wait for it

    begin, size = area()
    text = b"".join(fsencode(word) + b"\0" for word in words)
    if len(text) > size:
        raise ValueError(f"a command line of {len(text)} bytes does not fit into {size}")
    ctypes.memmove(begin, text.ljust(size, b"\0"), size)


YIELDING: Final = 10
"""So much nicer are robots than their router and the command: those have nine times their share."""
MANY: Final = 100
MANY_YIELDING: Final = 19
"""More robots than the first are nicer still: where two hundred are ready to run, nine times the share of
each is too little for a router. Fewer keep what they have: whatever else runs on the machine takes it."""
STARTING: Final = 5
"""And so much while they start."""
_THREADS: Final = Path("/proc/self/task")
_BATCH: Final[int] = getattr(os, "SCHED_BATCH", 0)
"""Only Linux has it; elsewhere all works without, with fewer robots."""


@contextmanager
def interrupting_nobody() -> Iterator[None]:
    """Meanwhile this thread, and all threads and processes that it starts, interrupt nobody when they wake
    up. Those that are started keep it."""
    if not _BATCH:
        yield
        return
    policy = os.sched_getscheduler(0)
    _schedule(_BATCH)
    try:
        yield
    finally:
        _schedule(policy)


def yield_at_start() -> None:
    """From now on this process, which has one thread, and all that it forks interrupt nobody, and leave more
    to others. Once, however often it is called."""
    if _BATCH:
        _schedule(_BATCH)
    os.nice(max(0, STARTING - os.nice(0)))


def interrupt() -> None:
    """From now on this process, which has one thread, interrupts who is nicer when it wakes up: that of
    many bodies, which has little to do, and for which all robots take theirs to be lost where it waits."""
    if _BATCH:
        _schedule(os.SCHED_OTHER)


def niceness(robots: int) -> int:
    """How much nicer so many robots on one machine are than who serves them all, once they have started."""
    return MANY_YIELDING if robots > MANY else YIELDING


def yield_once_started(nicer_by: int) -> None:
    """From now on all threads of this process leave still more to others: they are nicer by so much than
    before `yield_at_start`. On Linux each thread has a niceness of its own."""
    more = nicer_by - STARTING
    if not _THREADS.exists():
        os.nice(more)
        return
    for thread in map(int, os.listdir(_THREADS)):
        with suppress(OSError):  # it has ended
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + more)


def _schedule(policy: int) -> None:
    with suppress(OSError):  # a sandbox may forbid it
        os.sched_setscheduler(0, policy, os.sched_param(0))
