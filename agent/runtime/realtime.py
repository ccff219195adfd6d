"""Asks the system for real time, for a process whose fleet file has ``[process] realtime`` (Linux).

Imported only then. Nothing that is refused is fatal: the process runs on as it would without.

Zenoh's threads get SCHED_FIFO as well, for they carry the messages and hold locks that the loop waits for;
but below it, so that a loop whose time has come does not wait for what came meanwhile. Threads take policy,
cores and priority from the one that starts them: so this is asked before the bus is opened, and the loop's
own priority once it is.

A thread that runs on end would keep a core from everybody. The kernel leaves others 5 % of it
(``sched_rt_runtime_us``, sched(7)); and one that has run for `OVERRUN_S` without waiting once has its process
go on with SCHED_OTHER, or be killed where even that does not work (RLIMIT_RTTIME).

``python -m handfast.agent.runtime.realtime --role ROLE --priority N [--cpus A,B]`` asks for itself, prints
what it has then (`agent.runtime.realtime_granted`) and ends: what a process would get that is started here.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from handfast.agent.fleet.hosts import LINKS_PRIORITY, PRIORITIES, ProcessSection
from handfast.agent.runtime.realtime_granted import (
    CAP_IPC_LOCK,
    KILLED_S,
    OVERRUN_S,
    is_capable,
    look,
    said,
    to_json,
)

_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2
_MCL_ONFAULT: Final = 4
_THREADS: Final = Path("/proc/self/task")
_IS_LINUX: Final = hasattr(os, "sched_setscheduler")


class RealTime:
    """Real time for this process: what can be had before its bus is opened.

    Args:
        role: whose loop it has, ``agent`` or ``plant``.
        log: writes a line of its log.
    """

    def __init__(self, section: ProcessSection, role: str, log: Callable[[str], None]) -> None:
        self._section, self._role, self._log = section, role, log
        if not _IS_LINUX:
            return
        raise_limit(resource.RLIMIT_RTPRIO)
        _lock_memory()
        for thread in _threads():
            if section.cpus:
                with suppress(OSError):  # there are no such cores
                    os.sched_setaffinity(thread, section.cpus)
            _schedule(thread, os.SCHED_FIFO, LINKS_PRIORITY)
        _limit_overruns()
        signal.signal(signal.SIGXCPU, self._give_up)

    def lead(self) -> None:
        """Puts this thread above those that carry messages, once they are there, and says what was granted.

        What it starts from now on, such as a thread that writes files or a program of a plugin, does not
        inherit it.
        """
        if _IS_LINUX:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            _schedule(0, policy, PRIORITIES[self._role])
        self._log(f"realtime: {said(self._section, self._role, look(os.getpid()), as_unit=_is_unit())}")

    def _give_up(self, _number: int, _frame: object) -> None:
        for thread in _threads():
            # Who may not have SCHED_FIFO cannot take the flag back either.
            _schedule(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)
        with suppress(RuntimeError):  # in the middle of another line
            self._log(
                f"realtime given up: a thread has run for {OVERRUN_S:g} s without waiting; it goes on with "
                "SCHED_OTHER until it starts again"
            )


def _threads() -> Iterator[int]:
    """All threads of this process."""
    yield from map(int, os.listdir(_THREADS))


def _schedule(thread: int, policy: int, priority: int) -> None:
    with suppress(OSError):  # it is refused, or has ended; what came of it is looked at
        os.sched_setscheduler(thread, policy, os.sched_param(priority))


def raise_limit(which: int) -> int:
    """Raises a limit of this process as far as it may; gives it."""
    _, hard = resource.getrlimit(which)
    with suppress(OSError, ValueError):
        resource.setrlimit(which, (hard, hard))
    return hard


def _lock_memory() -> None:
    """Keeps what this process has touched in memory, now and later. Pages that nobody has touched are not
    read for it, and those that forked processes share stay shared.

    Not where only so much may be locked: memory that it gets beyond that would then be refused to it.
    """
    unlimited = raise_limit(resource.RLIMIT_MEMLOCK) == resource.RLIM_INFINITY
    if unlimited or is_capable(CAP_IPC_LOCK):
        ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)


def _limit_overruns() -> None:
    wanted = [round(1e6 * each) for each in (OVERRUN_S, KILLED_S)]
    _, hard = resource.getrlimit(resource.RLIMIT_RTTIME)
    if hard != resource.RLIM_INFINITY:
        wanted = [min(hard, each) for each in wanted]
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_RTTIME, (wanted[0], wanted[1]))


def _is_unit() -> bool:
    """Whether systemd started this process (`agent.runtime.service`)."""
    return "NOTIFY_SOCKET" in os.environ


def main(argv: Sequence[str] | None = None) -> int:
    """Prints what a process would be granted that is started as this one was."""
    parser = argparse.ArgumentParser(prog="python -m handfast.agent.runtime.realtime", allow_abbrev=False)
    parser.add_argument("--role", required=True, choices=sorted(PRIORITIES))
    parser.add_argument("--cpus", default="")
    options = parser.parse_args(argv)
    cpus = tuple(int(each) for each in options.cpus.split(",") if each)
    section = ProcessSection(realtime=True, cpus=cpus)
    RealTime(section, options.role, lambda _: None).lead()
    print(to_json(look(os.getpid())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
