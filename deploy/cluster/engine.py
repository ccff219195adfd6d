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
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from math import isfinite
from types import TracebackType
from typing import Any, Final, Generic, TypeVar

import distributed
from distributed.security import Security

from handfast.deploy.cluster.connection import CLOSE_S, ClusterError, GivenUp, connected
from handfast.deploy.cluster.dask_configuration import configured_security
from handfast.deploy.cluster.on_worker import UnknownCampaign
from handfast.deploy.cluster.reasons import error_line
from handfast.deploy.cluster.sent import Unfinished, Unreadable, pack
from handfast.deploy.cluster.watch import LOOK_S, MODULE, Watch, remote
from handfast.deploy.simulate.worker_pool import POLL_S, EngineLost, GoOn, Work

AHEAD: Final = 1
"""Runs that wait at each thread of a worker, beside the one that it is at: no more are submitted."""
DEATHS_MAX: Final = 2
"""A run that was under way when so many workers died is not driven again."""
SILENT_S: Final = 30.0
"""A scheduler that has said nothing for this long is given up."""
WORKERS_S: Final = 60.0
"""So long a campaign waits for a worker when it has none, unless somebody says otherwise."""
WAITS_S: Final = 20.0
"""So often it is said that it waits."""
NOBODY_HAS: Final = "handfast-nobody"
DEMAND_MAX: Final = 200
"""So many of the runs that wait here the scheduler is told of."""
RESULT_S: Final = 10.0
"""So long a result may take from a worker that has it."""
HEARD_S: Final = 2.0
HURRY_S: Final = 0.5
"""What the end of a campaign may ask for may take so long where the scheduler says nothing."""

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
        address: ``tcp://host:port`` or ``tls://host:port``.
        files: of plugins that go along, by their names below a folder of packages.
        say: is told of workers that are refused, are lost or come late.
        count: is told how many runs are driven at a time, on how many workers, whenever that changes.
        security: of the connections; else as Dask's configuration has it.
        broken: says why there will be no workers any more, None while there may be.
        expects: how many workers there will be, 0 where nobody knows.
        patience_s: so long it waits for a worker when it has none.
        name: how the scheduler is called in messages; else by its address.
        go_on: is asked while there is no connection yet: where it says no none is made, and no run is driven.

    Raises:
        ClusterError: on entering: there is no such scheduler, or it is of no use.
    """

    def __init__(
        self,
        address: str,
        work: Work[T],
        timeout_s: float,
        *,
        files: Mapping[str, bytes],
        say: Say,
        count: Callable[[int, int], None] = lambda _runs, _workers: None,
        security: Security | None = None,
        broken: Callable[[], str | None] = lambda: None,
        expects: Callable[[], int] = lambda: 0,
        patience_s: float = WORKERS_S,
        name: str = "",
        go_on: GoOn = lambda: True,
    ) -> None:
        self._address, self._work, self._timeout_s, self._files = address, work, timeout_s, files
        self._say, self._count, self._security, self._broken = say, count, security, broken
        self._expects, self._patience_s, self.name = expects, patience_s, name or address
        self._wanted = go_on
        self._campaign = uuid.uuid4().hex
        self._workers: dict[str, _Worker] = {}
        self._deaths: dict[int, list[str]] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._keys = 0
        self._worked = False  # whether a run has come back
        self._demand: list[Any] = []
        self._left = ExitStack()

    def __enter__(self) -> Cluster[T]:
        security = self._security or configured_security()
        certified = security.get_connection_args("client")["ssl_context"] is not None
        if self._address.startswith("tls://") and not certified:
            raise ClusterError(
                f"{self.name} needs certificates: name them in Dask's configuration "
                "(distributed.comm.tls.ca-file, client.cert and client.key)"
            )
        with ExitStack() as stack:
            stack.enter_context(_silenced())
            with suppress(GivenUp):  # then nobody wants results either
                self._client: Any = stack.enter_context(
                    connected(self._address, security, self.name, self._wanted)
                )
                self._watch = Watch(
                    self._client, self._campaign, pack(self._work), self._files, self._timeout_s, self._wanted
                )
                stack.callback(self._end)
            self._left = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.close()

    def _end(self) -> None:
        """Has nobody work for this campaign any more."""
        # Of a scheduler that stands still nobody can ask anything; workers end what nobody asks for.
        within_s = CLOSE_S if self._watch.silent_s < LOOK_S + HEARD_S else HURRY_S
        if not self._watch.stop(within_s):
            within_s = HURRY_S
        if self._client.status == "running":
            workers = list(self._workers)
            given = [each.future for worker in self._workers.values() for each in worker.given.values()]
            self._cancel([*given, *self._demand], within_s)
            self._watch.end(workers, within_s)

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[T]:
        """What came of `runs`, in whatever order they end, until all are done or `go_on` says no.

        Raises:
            ClusterError: no worker can be had from the start.
            EngineLost: the scheduler, or every worker, is gone.
        """
        waiting = deque(runs)
        alone_s = time.monotonic()
        told_s = 0.0
        while go_on():
            yield from self._look(waiting)
            if not waiting and not any(worker.given for worker in self._workers.values()):
                return
            if self._workers:
                alone_s, told_s = time.monotonic(), 0.0
            else:
                waited_s = time.monotonic() - alone_s
                self._refuse_nobody(waited_s)
                if waited_s > told_s + WAITS_S and isfinite(self._patience_s):
                    told_s = waited_s
                    self._say(
                        f"there is no worker at {self.name} yet: waiting for one since {waited_s:.0f} s, "
                        f"for {self._patience_s:.0f} s at most"
                    )
            self._give(waiting)
            self._ask_for(len(waiting))
            for given in self._done():
                before = self._ended.qsize()
                yield from self._take(given, waiting)
                if self._ended.qsize() > before:
                    break  # it could not be had: whether the scheduler is gone is seen first

    # ------------------------------------------------------------------ workers

    def _look(self, waiting: deque[int]) -> Iterator[T]:
        """Takes note of who has come and gone; runs that are not driven again are results."""
        seen = self._watch.seen
        if self._client.status != "running" or time.monotonic() - seen.at_s > SILENT_S:
            raise EngineLost(f"the scheduler {self.name} is gone")
        for text in self._watch.said():
            self._say(text)
        before = self._at_work()
        for address, worker in list(self._workers.items()):
            there = seen.workers.get(address)
            if there is None or there.process != worker.process:
                yield from self._lost(address, waiting)
        for address, there in self._watch.usable():
            self._workers.setdefault(address, _Worker(there.threads, there.process))
        now = self._at_work()
        if now != before:
            self._count(*now)

    def _at_work(self) -> tuple[int, int]:
        """How many runs are driven at a time, and on how many workers."""
        return sum(worker.threads for worker in self._workers.values()), len(self._workers)

    def _lost(self, address: str, waiting: deque[int]) -> Iterator[T]:
        """Has what a worker had driven again elsewhere, but for what has died with too many."""
        worker = self._workers.pop(address)
        blamed = {given.run for given in worker.under_way}
        self._cancel(given.future for given in worker.given.values())
        again, rows = 0, list[T]()
        for given in reversed(worker.given.values()):
            if given.run in blamed:
                deaths = self._deaths.setdefault(given.run, [])
                deaths.append(address)
                if len(deaths) >= DEATHS_MAX:
                    reason = f"the workers that drove it died: {', '.join(deaths)}"
                    rows.append(self._work.unfinished(given.run, reason, 0.0, timed_out=False))
                    continue
            waiting.appendleft(given.run)
            again += 1
        self._say(f"the worker {address} is gone{f'; {_runs(again)} driven again elsewhere' * bool(again)}")
        yield from rows

    def _refuse_nobody(self, waited_s: float) -> None:
        """Raises where there is no worker, and none to be waited for."""
        kind = EngineLost if self._worked else ClusterError
        if (why := self._broken()) is not None:
            raise kind(why)
        seen = self._watch.seen
        if seen.refused >= max(1, self._expects()) and not seen.unknown:
            raise kind(
                f"no worker of {self.name} can be used; each has another installation than this one: give "
                "them this one, and start them again"
            )
        if waited_s > self._patience_s:
            raise kind(
                f"there is no worker at {self.name}: none has come within {self._patience_s:.0f} s "
                "(--cluster-wait, or cluster_wait in Python, waits longer)"
            )

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

    def _ask_for(self, waiting: int) -> None:
        """Has the scheduler know how many runs wait here: an adaptive cluster grows by what it knows of.

        It is told by tasks that no worker can take, for that nobody has what they need. Given to no worker,
        they are also there while there is none, when no run can be given.
        """
        wanted = min(waiting, DEMAND_MAX)
        for future in self._demand[wanted:]:
            future.release()
        del self._demand[wanted:]
        if wanted > len(self._demand):
            self._keys += 1
            keys = [self._key(f"waits-{self._keys}-{k}") for k in range(len(self._demand), wanted)]
            self._demand += self._client.map(
                int, range(len(keys)), key=keys, resources={NOBODY_HAS: 1}, pure=False
            )

    def _key(self, rest: str) -> str:
        """The name of a task, which tells Dask that all of a campaign take about as long."""
        return f"handfast-{self._campaign}-{rest}"

    def _submit(self, run: int, address: str, worker: _Worker) -> None:
        self._keys += 1
        key = self._key(f"{run}-{self._keys}")
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
        self._cancel(given.future for given in worker.given.values())
        waiting.extendleft(given.run for given in reversed(worker.given.values()))
        self._watch.refuse(address, why)

    def _cancel(self, futures: Iterable[Any], within_s: float = CLOSE_S) -> None:
        with suppress(Exception):  # the scheduler may be gone, which shows
            self._client.sync(self._client._cancel, list(futures), force=True, callback_timeout=within_s)


class _NoAllExit(logging.Filter):
    """Lets through all but what is about `AllExit`, by which Dask ends a wait early: it says nothing else."""

    def filter(self, record: logging.LogRecord) -> bool:
        return record.exc_info is None or record.exc_info[0] is not distributed.client.AllExit


_NO_ALL_EXIT: Final = _NoAllExit()


@contextmanager
def _silenced() -> Iterator[None]:
    """A context in which Dask logs nothing: what matters of it is said as one line.

    What asyncio says of waits that Dask has ended early stays unsaid afterwards, too: it comes when they are
    garbage, which may be at any time.
    """
    logging.getLogger("asyncio").addFilter(_NO_ALL_EXIT)
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
