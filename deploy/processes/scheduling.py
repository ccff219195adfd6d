"""How the processes of a local run share this machine's processors when there are many of them.

All robots of a fleet do their rounds at about the same time and hear of each other through one router. What
makes that cheap is that nobody is interrupted: a round that ends before others begin, and a router that finds
many messages where it would have found one, pass on more with less. With SCHED_BATCH (sched(7)) who wakes up
waits for the end of what runs. Kernels share processors out by sessions where they can (autogroup), which
leaves a router of a hundred robots with one share of two hundred; so all are in the session of the command,
as they would be in one control group of a desktop, and robots are a little nicer than who serves them all.
Much nicer would be worse: a router that always comes first passes on each message by itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

YIELDING: Final = 5
"""So much nicer are robots than their router and the command: those have three times their share."""
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


def yield_always() -> None:
    """From now on this process, which has one thread, and all that it forks interrupt nobody, and leave more
    to others. Once, however often it is called."""
    if _BATCH:
        _schedule(_BATCH)
    os.nice(max(0, YIELDING - os.nice(0)))


def _schedule(policy: int) -> None:
    with suppress(OSError):  # a sandbox may forbid it
        os.sched_setscheduler(0, policy, os.sched_param(0))
