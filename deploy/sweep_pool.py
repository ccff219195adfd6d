"""Worker processes of a sweep: one run at a time each, ended when a run takes too long.

A run that takes its process with it, or never ends, costs that run and nothing else: the process is
replaced. The workers end with the process that started them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Final

from deploy.children import ONE_THREAD
from deploy.sweep import Plan
from deploy.sweep_run import CRASHED, TIMED_OUT, Abandoned, Row, execute, unfinished

POLL_S: Final = 0.2
"""How often the pool asks whether it is to go on."""
READY_TIMEOUT_S: Final = 60.0
START_ATTEMPTS: Final = 3
"""So many starts that fail one after the other end the sweep: it is not for a run that they do."""
END_TIMEOUT_S: Final = 2.0
_READY: Final = "ready"
_BLOCKED: Final = (signal.SIGINT, signal.SIGHUP)


class PoolError(RuntimeError):
    """Workers cannot be started; one line."""


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _work(connection: Connection, plan: Plan) -> None:
    """A worker: takes numbers of runs until there are no more, gives rows."""
    parent = multiprocessing.parent_process()

    def go_on() -> bool:
        return parent is None or parent.is_alive()

    with suppress(EOFError, BrokenPipeError, ConnectionResetError, Abandoned):
        connection.send(_READY)
        while True:
            connection.send(execute(plan, connection.recv(), go_on))


class _Worker:
    """One process, and the run that it is at."""

    def __init__(self, plan: Plan) -> None:
        # spawn: a fork of a process with threads (the progress display has one) may hang.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, plan), daemon=True)
        # A Ctrl-C reaches every process of a terminal, and is its starter's to answer. A mask, unlike a
        # handler, holds from the new process's first instruction on. The tracker, which `start` would
        # start first, undoes it: so it has to run already.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        self.run: int | None = None
        self.ready = False
        self.begun_s = time.monotonic()

    def give(self, run: int) -> None:
        self.run, self.begun_s = run, time.monotonic()
        with suppress(BrokenPipeError, ConnectionResetError):  # it is gone: its end is seen when read
            self.connection.send(run)

    def take(self) -> Row | str | None:
        """What it sent; None when it is gone."""
        try:
            received: Row | str = self.connection.recv()
        except (EOFError, ConnectionResetError):
            return None
        return received

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
        """Ends the process, now."""
        self.connection.close()
        self.process.kill()
        self.process.join()
        self.process.close()


class Pool:
    """Drives runs of `plan` in `jobs` processes, each run in at most `timeout_s`. A context manager."""

    def __init__(self, plan: Plan, jobs: int, timeout_s: float) -> None:
        self._plan, self._jobs, self._timeout_s = plan, jobs, timeout_s
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        for name, value in ONE_THREAD.items():
            os.environ.setdefault(name, value)

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in list(self._workers):
            self._end(worker)

    def rows(self, runs: Iterable[int], go_on: Callable[[], bool]) -> Iterator[Row]:
        """The rows of `runs`, in whatever order they end, until all are done or `go_on` says no.

        Raises:
            PoolError: a worker does not come up.
        """
        queue = deque(runs)
        while go_on():
            busy = sum(worker.run is not None for worker in self._workers)
            if not queue and not busy:
                return
            while len(self._workers) < min(self._jobs, busy + len(queue)):
                self._workers.append(_Worker(self._plan))
            for worker in self._workers:
                if queue and worker.ready and worker.run is None:
                    worker.give(queue.popleft())
            readable = wait([worker.connection for worker in self._workers], POLL_S)
            for worker in list(self._workers):
                row = self._take(worker) if worker.connection in readable else self._look(worker)
                if row is not None:
                    yield row

    def _take(self, worker: _Worker) -> Row | None:
        received = worker.take()
        if isinstance(received, Row):
            worker.run = None
            return received
        if received is not None:
            worker.ready, self._failed_starts = True, 0
            return None
        death, run, took_s = worker.death(), worker.run, time.monotonic() - worker.begun_s
        self._end(worker)
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts == START_ATTEMPTS:
                raise PoolError(f"the sweep's workers cannot start: {death}")
        return None if run is None else unfinished(self._plan, run, CRASHED, death, took_s)

    def _look(self, worker: _Worker) -> Row | None:
        took_s = time.monotonic() - worker.begun_s
        if not worker.ready and took_s > READY_TIMEOUT_S:
            raise PoolError(f"a worker of the sweep has not started within {READY_TIMEOUT_S:g} s")
        run = worker.run
        if run is None or took_s <= self._timeout_s:
            return None
        self._end(worker)
        reason = f"not done within {self._timeout_s:g} s (--timeout)"
        return unfinished(self._plan, run, TIMED_OUT, reason, took_s)

    def _end(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.end()
