"""Runs on the workers of a Dask scheduler: an `Engine` of many machines.

Every run is given to one worker by name. So this end, not the scheduler, decides what a lost worker means:
its runs are driven again elsewhere, and one that has lost two workers is a row. A worker is looked at before
it is given anything: one that would drive other numbers gets nothing.
"""

from __future__ import annotations

import logging
import queue
import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Generic, TypeVar

import distributed
from distributed.security import Security

from agent.common.wording import printable
from deploy.cluster.on_worker import UnknownCampaign
from deploy.cluster.sent import Unfinished, Unreadable, pack
from deploy.cluster.watch import CLOSE_S, MODULE, ClusterError, Watch, error_line, remote
from deploy.simulate.worker_pool import POLL_S, EngineLost, GoOn, Work

AHEAD: Final = 1
"""Runs that wait at each thread of a worker, beside the one that it is at: no more are submitted."""
DEATHS_MAX: Final = 2
"""A run that was under way when so many workers died is not driven again."""
CONNECT_S: Final = 10.0
SILENT_S: Final = 30.0
"""A scheduler that has said nothing for this long is given up."""
WORKERS_S: Final = 60.0
"""So long a campaign waits for a worker when it has none."""
RESULT_S: Final = 10.0
"""So long a result may take from a worker that has it."""

T = TypeVar("T")
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class _Given:
    """A run that a worker has, and the future that stands for it."""

    run: int
    worker: str
    future: Any


class _Cancelled:
    """What came of a run whose future was cancelled: nothing."""


@dataclass
class _Worker:
    """A worker that may be given runs: those that it has, in the order in which it got them."""

    threads: int
    process: str
    given: dict[str, _Given] = field(default_factory=dict)

    @property
    def under_way(self) -> list[_Given]:
        """What it drives now; the rest waits there."""
        return list(self.given.values())[: self.threads]


class Cluster(Generic[T]):
    """Drives runs of `work` on the workers of a scheduler, each run in at most `timeout_s`. An `Engine`.

    Args:
        address: ``tcp://host:port`` or ``tls://host:port``, or keywords for `distributed.Client`.
        files: of plugins that go along, by their names below a folder of packages.
        say: is told of workers that are refused, are lost or come late.
        count: is told how many runs are driven at a time, whenever that changes.
        security: of the connections; else as Dask's configuration has it.
        broken: says why there will be no workers any more, None while there may be.
        expects: how many workers there will be, 0 where nobody knows.
        patience_s: so long it waits for a worker when it has none.
        name: how the scheduler is called in messages; else by its address.

    Raises:
        ClusterError: on entering: there is no such scheduler, or it is of no use.
    """

    def __init__(
        self,
        address: str | Mapping[str, Any],
        work: Work[T],
        timeout_s: float,
        *,
        files: Mapping[str, bytes],
        say: Say,
        count: Callable[[int], None] = lambda _: None,
        security: Security | None = None,
        broken: Callable[[], str | None] = lambda: None,
        expects: Callable[[], int] = lambda: 0,
        patience_s: float = WORKERS_S,
        name: str = "",
    ) -> None:
        self._address, self._work, self._timeout_s, self._files = address, work, timeout_s, files
        self._say, self._count, self._security, self._broken = say, count, security, broken
        self._expects, self._patience_s, self._called = expects, patience_s, name
        self._campaign = uuid.uuid4().hex
        self._workers: dict[str, _Worker] = {}
        self._deaths: dict[int, list[str]] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._keys = 0
        self._worked = False  # whether a run has come back

    @property
    def name(self) -> str:
        """How the scheduler is called in messages."""
        if self._called:
            return self._called
        return self._address if isinstance(self._address, str) else str(next(iter(self._address.values())))

    def __enter__(self) -> Cluster[T]:
        security = self._security or Security()  # as Dask's configuration has it
        if self.name.startswith("tls://") and security.get_connection_args("client")["ssl_context"] is None:
            raise ClusterError(
                f"{self.name} needs certificates: name them in Dask's configuration "
                "(distributed.comm.tls.ca-file, client.cert and client.key)"
            )
        with ExitStack() as stack:
            stack.enter_context(_silenced())
            keywords = {"address": self._address} if isinstance(self._address, str) else self._address
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of versions, which are compared and said here
                try:
                    self._client: Any = distributed.Client(
                        **keywords, timeout=CONNECT_S, security=security, set_as_default=False
                    )
                except (OSError, ValueError, TypeError, RuntimeError, ImportError) as error:
                    why = str(error) if isinstance(error, OSError) else error_line(error)
                    raise ClusterError(f"there is no scheduler at {self.name}: {printable(why)}") from None
            stack.callback(self._close)
            self._watch = Watch(self._client, self._campaign, pack(self._work), self._files, self._timeout_s)
            stack.callback(self._end)
            self._left = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.close()

    def _end(self) -> None:
        """Has nobody work for this campaign any more."""
        self._watch.stop()
        if self._client.status == "running":
            workers = list(self._workers)
            self._cancel(each for worker in self._workers.values() for each in worker.given.values())
            self._watch.end(workers)

    def _close(self) -> None:
        with suppress(Exception):  # of a scheduler that is gone
            self._client.close(timeout=CLOSE_S)

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[T]:
        """What came of `runs`, in whatever order they end, until all are done or `go_on` says no.

        Raises:
            ClusterError: no worker can be had from the start.
            EngineLost: the scheduler, or every worker, is gone.
        """
        waiting = deque(runs)
        alone_s = time.monotonic()
        while go_on():
            yield from self._look(waiting)
            if not waiting and not any(worker.given for worker in self._workers.values()):
                return
            if self._workers:
                alone_s = time.monotonic()
            else:
                self._refuse_nobody(time.monotonic() - alone_s)
            self._give(waiting)
            for given in self._done():
                yield from self._take(given, waiting)

    # ------------------------------------------------------------------ workers

    def _look(self, waiting: deque[int]) -> Iterator[T]:
        """Takes note of who has come and gone; runs that are not driven again are results."""
        seen = self._watch.seen
        if self._client.status != "running" or time.monotonic() - seen.at_s > SILENT_S:
            raise EngineLost(f"the scheduler {self.name} is gone")
        for text in self._watch.said():
            self._say(text)
        before = sum(worker.threads for worker in self._workers.values())
        for address, worker in list(self._workers.items()):
            there = seen.workers.get(address)
            if there is None or there.process != worker.process:
                yield from self._lost(address, waiting)
        for address, there in self._watch.usable():
            self._workers.setdefault(address, _Worker(there.threads, there.process))
        now = sum(worker.threads for worker in self._workers.values())
        if now != before:
            self._count(now)

    def _lost(self, address: str, waiting: deque[int]) -> Iterator[T]:
        """Has what a worker had driven again elsewhere, but for what has died with too many."""
        worker = self._workers.pop(address)
        blamed = {given.run for given in worker.under_way}
        self._say(f"the worker {address} is gone; {_runs(len(worker.given))} driven again elsewhere")
        self._cancel(worker.given.values())
        for given in reversed(worker.given.values()):
            if given.run in blamed:
                deaths = self._deaths.setdefault(given.run, [])
                deaths.append(address)
                if len(deaths) >= DEATHS_MAX:
                    reason = f"the workers that drove it died: {', '.join(deaths)}"
                    yield self._work.unfinished(given.run, reason, 0.0, timed_out=False)
                    continue
            waiting.appendleft(given.run)

    def _refuse_nobody(self, waited_s: float) -> None:
        """Raises where there is no worker, and none to be waited for."""
        kind = EngineLost if self._worked else ClusterError
        if (why := self._broken()) is not None:
            raise kind(why)
        seen = self._watch.seen
        if seen.refused >= max(1, self._expects()) and not seen.unknown:
            raise kind(f"no worker of {self.name} can be used; each has another installation than this one")
        if waited_s > self._patience_s:
            raise kind(f"there is no worker at {self.name}: none has come within {self._patience_s:.0f} s")

    # ------------------------------------------------------------------ runs

    def _give(self, waiting: deque[int]) -> None:
        """Submits runs: one for each thread first, then those that wait there."""
        for ahead in range(AHEAD + 1):
            for address, worker in self._workers.items():
                while waiting and len(worker.given) < worker.threads * (ahead + 1):
                    # A run that was there when a worker died is driven by itself: if it is what kills them,
                    # it must not take others along, of which then nobody knows whose fault it was.
                    suspects = [given for given in worker.given.values() if given.run in self._deaths]
                    if suspects or (waiting[0] in self._deaths and worker.given):
                        break
                    self._submit(waiting.popleft(), address, worker)

    def _submit(self, run: int, address: str, worker: _Worker) -> None:
        self._keys += 1
        key = f"handfast-{self._campaign}-{run}-{self._keys}"
        future = self._client.submit(
            remote(MODULE, "drive"), self._campaign, run, key=key, workers=[address], pure=False
        )
        worker.given[key] = _Given(run, address, future)
        future.add_done_callback(lambda _: self._ended.put(key))

    def _done(self) -> Iterator[_Given]:
        """Runs whose futures have ended; waits for one, but not long."""
        timeout_s = POLL_S
        while True:
            try:
                key = self._ended.get(timeout=timeout_s) if timeout_s else self._ended.get_nowait()
            except queue.Empty:
                return
            timeout_s = 0.0
            given = [worker.given[key] for worker in self._workers.values() if key in worker.given]
            yield from given  # none where its worker was given up meanwhile

    def _take(self, given: _Given, waiting: deque[int]) -> Iterator[T]:
        """What came of a run; one that was not driven waits again."""
        worker = self._workers[given.worker]
        try:
            found = given.future.result(timeout=RESULT_S)
        except TimeoutError:
            self._ended.put(given.future.key)  # unless its worker is gone, which shows
            return
        except distributed.KilledWorker:
            return  # its worker is gone, which shows
        except distributed.client.FutureCancelledError:
            found = _Cancelled()  # by others, or the scheduler is gone, which shows
        except UnknownCampaign:
            self._watch.forget(given.worker)
            return
        except Exception as error:
            found = Unreadable(error_line(error))
        del worker.given[given.future.key]
        self._worked |= not isinstance(found, (Unreadable, _Cancelled))
        given.future.release()
        if isinstance(found, _Cancelled):
            waiting.appendleft(given.run)
        elif isinstance(found, Unreadable):
            self._refuse(given.worker, found.why, waiting)
            waiting.appendleft(given.run)
        elif isinstance(found, Unfinished):
            yield self._work.unfinished(given.run, found.reason, found.wall_s, timed_out=found.timed_out)
        else:
            yield found

    def _refuse(self, address: str, why: str, waiting: deque[int]) -> None:
        """Gives a worker nothing any more."""
        worker = self._workers.pop(address)
        self._cancel(worker.given.values())
        waiting.extendleft(given.run for given in reversed(worker.given.values()))
        self._watch.refuse(address, why)

    def _cancel(self, given: Iterable[_Given]) -> None:
        futures = [each.future for each in given]
        with suppress(Exception):  # the scheduler may be gone, which shows
            self._client.sync(self._client._cancel, futures, force=True, callback_timeout=CLOSE_S)


@contextmanager
def _silenced() -> Iterator[None]:
    """A context in which Dask logs nothing: what matters of it is said as one line."""
    loggers = [
        logging.getLogger(name)
        for name in list(logging.root.manager.loggerDict)
        if name.startswith("distributed")
    ]
    levels = [each.level for each in loggers]
    for each in loggers:
        each.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for each, level in zip(loggers, levels, strict=True):
            each.setLevel(level)


def _runs(count: int) -> str:
    return f"{count} run{'s are' if count != 1 else ' is'}"
