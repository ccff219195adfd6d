"""How the processes of a local run share this machine's processors when there are many of them.

All robots of a fleet do their rounds at about the same time and hear of each other through one router. What
makes that cheap is that nobody is interrupted: a round that ends before others begin, and a router that finds
many messages where it would have found one, pass on more with less. With SCHED_BATCH (sched(7)) who wakes up
waits for the end of what runs. Kernels share processors out by sessions where they can (autogroup), which
leaves a router of a hundred robots with one share of two hundred; so all are in the session of the command,
as they would be in one control group of a desktop, and robots are nicer than who serves them all: where a
hundred of them have more to do than there is time for, a router with three times the share of each still has
3 % of a processor, and nobody hears anybody. Those that still start are less nice than those that wait for
them, and so is the process of many bodies, all the time; that one interrupts robots as well.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

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
