"""Doing independent things at once, in forks of this process: what is loaded and computed is there in all."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

NOT_BESIDE: Final = "zenoh"
"""Its threads are not Python's: a process in which it is loaded is not forked."""
_BLOCKED: Final = (signal.SIGINT, signal.SIGHUP)


def side_by_side(tasks: Sequence[Callable[[], object]], processes: int | None = None) -> None:
    """Does all tasks, the first ones first, in so many processes, at most one for each core.

    What a task changes in memory may be lost: its results are files. A task that a fork has not finished, for
    whatever reason, is done here, so that what it raises is raised here.
    """
    if processes is None:
        processes = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    processes = min(processes, len(tasks))
    if processes < 2 or len(tasks) > 255 or threading.active_count() > 1 or NOT_BESIDE in sys.modules:
        for task in tasks:
            task()
        return
    # Who is free takes the next number out of one pipe, and puts it into the other when that is done.
    waiting, given = os.pipe()
    finished, tell = os.pipe()
    os.write(given, bytes(range(len(tasks))))
    os.close(given)
    forks: list[int] = []
    done: set[int] = set()
    try:
        forks += [_fork(tasks, waiting, tell) for _ in range(processes - 1)]
        os.close(tell)
        tell = -1
        while taken := os.read(waiting, 1):
            tasks[taken[0]]()
            done |= set(taken)
        while told := os.read(finished, 1):  # until all forks have ended
            done |= set(told)
    finally:
        for fork in forks:
            with suppress(ProcessLookupError):
                os.kill(fork, signal.SIGKILL)
            os.waitpid(fork, 0)
        for end in (waiting, finished, tell):
            if end >= 0:
                os.close(end)
    for number, task in enumerate(tasks):
        if number not in done:
            task()


def _fork(tasks: Sequence[Callable[[], object]], waiting: int, tell: int) -> int:
    """A process that does tasks as long as some wait; its number. A Ctrl-C is its starter's to answer."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
    try:
        with warnings.catch_warnings():
            # Python warns of any second thread, as numpy's, which is made again in a fork.
            warnings.simplefilter("ignore", DeprecationWarning)
            fork = os.fork()
        if fork:
            return fork
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            while taken := os.read(waiting, 1):
                tasks[taken[0]]()
                os.write(tell, taken)
        finally:
            os._exit(0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
