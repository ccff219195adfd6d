"""Worker processes for many runs: one run at a time each, ended when a run takes too long.

An `Engine` drives runs: `Pool` on this machine, `deploy.sweep.cluster` on the workers of a Dask scheduler.

A run that kills its process twice, or never ends, costs that run and nothing else: the process is replaced.
The workers end with the process that started them, and everything that their runs started ends with them.

`SameProgram` makes sure that one program drives all runs of a campaign, from start to end.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, Final, Generic, Protocol, TypeVar

from handfast.agent.common.errors import Error
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.console.data_files import ROOT
from handfast.deploy.console.sources import files_of_plugins, sources_digest
from handfast.deploy.processes.child import ONE_THREAD

POLL_S: Final = 0.2
"""How often the pool asks whether it is to go on."""
READY_TIMEOUT_S: Final = 60.0
START_ATTEMPTS: Final = 3
"""So many starts that fail one after the other end it all: it is not for a run that they do."""
END_TIMEOUT_S: Final = 2.0
IDLE_S: Final = 60.0
"""Time without a run after which a worker ends. It is replaced when it is needed again."""
_READY: Final = "ready"
DEATHS_MAX: Final = 2
"""A run whose process died so often is not driven again. The first death may have been another's doing, such
as the kernel's where memory is short."""
_BLOCKED: Final = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
"""What is sent to the processes of a terminal, a unit or a job, and is for their starter to answer."""


T = TypeVar("T")
Result = TypeVar("Result", covariant=True)
GoOn = Callable[[], bool]


class PoolError(Error, RuntimeError):
    """Workers cannot be started; the text is one line."""


class EngineLost(Error):
    """What runs are driven on is gone before all were; the text is one line, without an end."""


class Abandoned(Exception):
    """A run that was asked to end before its time."""


class Refused(Error):
    """A process that is not to drive any run of this work; the text is one line."""


class Work(Protocol[Result]):
    """Runs that have numbers. Each worker gets a copy."""

    def execute(self, number: int, go_on: GoOn) -> Result:
        """Drives one run; raises `Abandoned` when `go_on`, asked now and then, says no, `Refused` when none
        is to be driven here, and nothing else."""
        ...

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> Result:
        """The result of a run whose process died (`DEATHS_MAX`), or was ended because it took too long."""
        ...


class Engine(Protocol[Result]):
    """Drives runs of a `Work`. A context manager: leaving it ends what is still under way."""

    def __enter__(self) -> Engine[Result]: ...

    def __exit__(self, *_: object) -> None: ...

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[Result]:
        """What came of `runs`, in whatever order they end, until all are done or `go_on` says no.

        Raises:
            PoolError: no run can be driven.
            EngineLost: no further run can be.
        """
        ...


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _work(connection: Connection, work: Work[Any]) -> None:
    """A worker: takes numbers of runs until there are no more, gives what came of them."""
    os.setpgid(0, 0)  # with what its runs start: `_Worker.end` and `end_with_parent` end it all
    parent = multiprocessing.parent_process()

    def go_on() -> bool:
        return parent is None or parent.is_alive()

    def end_with_parent() -> None:
        assert parent is not None
        parent.join()
        time.sleep(END_TIMEOUT_S)  # a run that asks `go_on` has ended in order by then
        os.killpg(0, signal.SIGKILL)

    if parent is not None:
        threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError, ConnectionResetError, Abandoned):
        connection.send(_READY)
        while connection.poll(IDLE_S):
            try:
                connection.send(work.execute(connection.recv(), go_on))
            except Refused as refused:
                connection.send(refused)
    os.killpg(0, signal.SIGKILL)


_starting: Final = threading.Lock()
"""Of one start at a time: what a start changes of this process, for a moment, is every thread's."""


class _Worker:
    """One process, and the run that it is at."""

    def __init__(self, work: Work[Any]) -> None:
        # spawn: a fork of a process with threads (the progress display has one) may hang.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, work), daemon=True)
        with _starting:
            # A mask, unlike a handler, holds from the new process's first instruction on. The tracker, which
            # `start` would start first, undoes it: so it has to run already.
            resource_tracker.ensure_running()
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
            # The new process would run the program's main module once more, which a script may have no guard
            # against, and which no run needs: it sees an empty one.
            main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
            try:
                self.process.start()
            finally:
                sys.modules["__main__"] = main
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        self.run: int | None = None
        self.ready = False
        self.begun_s = time.monotonic()

    def give(self, run: int) -> None:
        self.run, self.begun_s = run, time.monotonic()
        with suppress(BrokenPipeError, ConnectionResetError):  # it is gone: its end is seen when read
            self.connection.send(run)

    def take(self) -> tuple[Any, ...]:
        """What the process sent, in a tuple; empty when it is gone."""
        try:
            return (self.connection.recv(),)
        except (EOFError, ConnectionResetError):
            return ()

    def death(self) -> str:
        """How the process ended, in words."""
        self.process.join(END_TIMEOUT_S)
        code = self.process.exitcode
        if code is None:
            return "its process closed its connection"
        if code < 0:
            return f"its process was killed by {signal.Signals(-code).name}"
        return f"its process ended with exit status {code}"

    def end(self) -> None:
        """Ends the process and all that its runs have started, now."""
        self.connection.close()
        assert self.process.pid is not None
        with suppress(ProcessLookupError):  # it has ended and nothing is left, or has not come so far
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.join()
        self.process.close()


class Pool(Generic[T]):
    """Drives runs of `work` in `jobs` processes, each run in at most `timeout_s`. A context manager."""

    def __init__(self, work: Work[T], jobs: int, timeout_s: float) -> None:
        self._runs_of, self._jobs, self._timeout_s = work, jobs, timeout_s
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._deaths: Counter[int] = Counter()
        for name, value in ONE_THREAD.items():
            os.environ.setdefault(name, value)

    def __enter__(self) -> Pool[T]:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in list(self._workers):
            self._end(worker)

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[T]:
        """What came of `runs`, in whatever order they end, until all are done or `go_on` says no.

        Raises:
            PoolError: a worker does not come up, or has to refuse its run.
        """
        queue = deque(runs)
        while go_on():
            busy = sum(worker.run is not None for worker in self._workers)
            if not queue and not busy:
                return
            while len(self._workers) < min(self._jobs, busy + len(queue)):
                self._workers.append(_Worker(self._runs_of))
            for worker in self._workers:
                if queue and worker.ready and worker.run is None:
                    worker.give(queue.popleft())
            readable = wait([worker.connection for worker in self._workers], POLL_S)
            for worker in list(self._workers):
                is_readable = worker.connection in readable
                yield from self._take(worker, queue) if is_readable else self._look(worker)

    def _take(self, worker: _Worker, queue: deque[int]) -> tuple[T, ...]:
        """What it has sent came of its run, if it is that. A run that died for the first time is to be driven
        next."""
        received = worker.take()
        if received == (_READY,):
            worker.ready, self._failed_starts = True, 0
            return ()
        if received:
            worker.run = None
            if isinstance(received[0], Refused):
                raise PoolError(str(received[0]))
            return received
        death, run, took_s = worker.death(), worker.run, time.monotonic() - worker.begun_s
        self._end(worker)
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts == START_ATTEMPTS:
                raise PoolError(f"the workers cannot start: {death}")
        if run is None:
            return ()
        self._deaths[run] += 1
        if self._deaths[run] < DEATHS_MAX:
            queue.appendleft(run)
            return ()
        del self._deaths[run]
        return (self._runs_of.unfinished(run, death, took_s, timed_out=False),)

    def _look(self, worker: _Worker) -> tuple[T, ...]:
        """Ends it if it takes too long."""
        took_s = time.monotonic() - worker.begun_s
        if not worker.ready and took_s > READY_TIMEOUT_S:
            raise PoolError(f"a worker has not started within {READY_TIMEOUT_S:g} s")
        run = worker.run
        if run is None or took_s <= self._timeout_s:
            return ()
        self._end(worker)
        reason = f"not done within {self._timeout_s:g} s (--timeout)"
        return (self._runs_of.unfinished(run, reason, took_s, timed_out=True),)

    def _end(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.end()


LIBRARIES: Final = ("numpy", "msgpack", "pymap3d", "pymavlink", "cryptography")
"""Packages that take part in a run. Their versions must be the same everywhere."""
SOURCES: Final = "sources"

R = TypeVar("R")


class ClusterError(Error):
    """The cluster cannot be used; the text is one line."""


def identity(plugins: Iterable[str] = ()) -> dict[str, str]:
    """Return the versions by name, and a digest of our sources and of the `plugins` (`plugins_of`)."""
    return {
        "Python": f"{sys.version_info[0]}.{sys.version_info[1]}",
        "handfast": handfast_version(),
        **{name: _version(name) for name in LIBRARIES},
        SOURCES: program_digest(plugins),
    }


def program_digest(plugins: Iterable[str]) -> str:
    """Return 16 hex digits over our Python files and those of plugins.

    A plugin counts with its top-level package or its file, but not with what that imports in turn.
    """
    return sources_digest(ROOT, files_of_plugins(plugins)[0])


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Say what differs between two identities; empty if nothing does."""
    return ", ".join(
        f"{name} {there.get(name, 'unknown')} instead of {value}"
        for name, value in here.items()
        if there.get(name) != value
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


_checked: Final[list[Mapping[str, str]]] = []
"""Programs that this process had before and after its first run, which imports the rest of them."""


@dataclass(frozen=True, slots=True)
class SameProgram(Generic[R]):
    """A `Work` that only the given program drives.

    A worker imports what it needs when it starts and with its first run, and it may start late, to replace
    one that died. So it compares the program before and after its first run.
    """

    work: Work[R]
    program: Mapping[str, str]
    plugins: tuple[str, ...]

    def execute(self, number: int, go_on: GoOn) -> R:
        """Drive a run of the work.

        Raises:
            Refused: the program is another one.
        """
        if self.program in _checked:
            return self.work.execute(number, go_on)
        self._compare()
        result = self.work.execute(number, go_on)
        self._compare()
        _checked.append(self.program)
        return result

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> R:
        return self.work.unfinished(number, reason, wall_s, timed_out=timed_out)

    def _compare(self) -> None:
        if text := differences(self.program, identity(self.plugins)):
            raise Refused(f"the program is not the one that this command began with: {text}")
