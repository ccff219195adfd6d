"""Runs on the workers of a Dask scheduler: an `Engine` of many machines.

Every run is given to one worker by name. So this end, not the scheduler, decides what a lost worker means:
its runs are driven again elsewhere, and one that has lost two workers is a row. A worker is looked at before
it is given anything: one that would drive other numbers gets nothing.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
import uuid
import warnings
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Final, Generic, TypeVar

import distributed
from distributed.comm.core import CommClosedError
from distributed.security import Security

from agent.common.errors import Error
from agent.common.wording import printable
from deploy.cluster.identity import differences, identity
from deploy.cluster.on_worker import PROCESS, UnknownCampaign
from deploy.cluster.sent import Unfinished, Unreadable, pack
from deploy.simulate.worker_pool import POLL_S, EngineLost, GoOn, Work

AHEAD: Final = 1
"""Runs that wait at each thread of a worker, beside the one that it is at: no more are submitted."""
DEATHS_MAX: Final = 2
"""A run that was under way when so many workers died is not driven again."""
CONNECT_S: Final = 10.0
LOOK_S: Final = 1.0
"""How often it is looked which workers there are."""
SILENT_S: Final = 30.0
"""A scheduler that has said nothing for this long is given up."""
WORKERS_S: Final = 60.0
"""So long a campaign waits for a worker when it has none."""
RESULT_S: Final = 10.0
"""So long a result may take from a worker that has it."""
CLOSE_S: Final = 5.0
ASK_S: Final = 10.0
"""So long one question to the scheduler or a worker may take."""
KEEP_S: Final = 15.0
"""How often workers are told that the campaign goes on: they forget one that is not heard of
(`deploy.cluster.on_worker.IDLE_S`)."""
UNREACHED: Final = (TimeoutError, ConnectionError, CommClosedError, KeyError)
"""What a worker raises that is on its way here or away: it is asked again."""
_MODULE: Final = "deploy.cluster.on_worker"

T = TypeVar("T")
Say = Callable[[str], None]


class ClusterError(Error):
    """The cluster cannot be used; the text is one line."""


@dataclass(frozen=True, slots=True)
class _Given:
    """A run that a worker has, and the future that stands for it."""

    run: int
    worker: str
    future: Any


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
    ) -> None:
        self._address, self._work, self._timeout_s, self._files = address, work, timeout_s, files
        self._say, self._count, self._security, self._broken = say, count, security, broken
        self._campaign = uuid.uuid4().hex
        self._workers: dict[str, _Worker] = {}
        self._deaths: dict[int, list[str]] = {}
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._keys = 0
        self._worked = False

    @property
    def name(self) -> str:
        """How the scheduler is called in messages."""
        return self._address if isinstance(self._address, str) else str(next(iter(self._address.values())))

    def __enter__(self) -> Cluster[T]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions, which are compared and said here
            logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is said here
            keywords = {"address": self._address} if isinstance(self._address, str) else self._address
            try:
                self._client: Any = distributed.Client(
                    **keywords, timeout=CONNECT_S, security=self._security, set_as_default=False
                )
            except (OSError, ValueError, TypeError, RuntimeError, ImportError) as error:
                raise ClusterError(f"there is no scheduler at {self.name}: {_text(error)}") from None
        try:
            self._data = pack(self._work)
            self._watch = _Watch(self._client, self._campaign, self._data, self._files, self._timeout_s)
        except BaseException:
            self._client.close(timeout=CLOSE_S)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._watch.stop()
        if self._client.status == "running":
            workers = list(self._workers)
            self._cancel(each for worker in self._workers.values() for each in worker.given.values())
            self._watch.end(workers)
        with suppress(Exception):
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
                alone_s, self._worked = time.monotonic(), True
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
        for address, there in seen.workers.items():
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
        if self._watch.seen.refused and not self._worked and not self._watch.seen.unknown:
            raise kind(f"no worker of {self.name} can be used; each has another installation than this one")
        if waited_s > WORKERS_S:
            raise kind(f"there is no worker at {self.name}: none has come within {WORKERS_S:.0f} s")

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
            remote(_MODULE, "drive"), self._campaign, run, key=key, workers=[address], pure=False
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
            for worker in self._workers.values():
                if key in worker.given:
                    yield worker.given[key]

    def _take(self, given: _Given, waiting: deque[int]) -> Iterator[T]:
        """What came of a run; one that was not driven waits again."""
        worker = self._workers.get(given.worker)
        if worker is None or given.future.key not in worker.given:
            return  # its worker was given up meanwhile
        try:
            found = given.future.result(timeout=RESULT_S)
        except TimeoutError:
            self._ended.put(given.future.key)  # unless its worker is gone, which shows
            return
        except (distributed.KilledWorker, distributed.client.FutureCancelledError):
            return  # its worker, or the scheduler, is gone, which shows
        except UnknownCampaign:
            self._watch.forget(given.worker)
            return
        except Exception as error:
            found = Unreadable(_text(error))
        del worker.given[given.future.key]
        given.future.release()
        if isinstance(found, Unreadable):
            waiting.appendleft(given.run)
            self._refuse(given.worker, found.why, waiting)
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


@dataclass(frozen=True, slots=True)
class _There:
    """A worker that is there and may be given runs."""

    threads: int
    process: str


@dataclass(frozen=True, slots=True)
class _Seen:
    """What was seen when the scheduler was asked last: workers that may be given runs; how many may not; how
    many have not been looked at."""

    at_s: float
    workers: Mapping[str, _There]
    refused: int = 0
    unknown: int = 0


class _Watch:
    """Looks who is there, in a thread, so that a scheduler that does not answer holds up nothing else.

    Each worker is asked what it has installed, and told of the campaign, before it counts as there; and told
    again and again that the campaign goes on. One that does not answer holds up no other.
    """

    def __init__(
        self, client: Any, campaign: str, data: bytes, files: Mapping[str, bytes], timeout_s: float
    ) -> None:
        self._client = client
        self._campaign = campaign
        self._told = (campaign, data, files, timeout_s)
        self._refused: dict[str, str] = {}
        self._forgotten: set[str] = set()
        self._ask_at_s: dict[str, float] = {}
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._kept_s = time.monotonic()
        self._refuse_scheduler()
        self.seen = _Seen(time.monotonic(), {}, 0, 1)
        self._thread = threading.Thread(target=self._run, name="cluster", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(CLOSE_S)

    def said(self) -> Iterator[str]:
        """What a person should know, since it was asked last."""
        with suppress(queue.Empty):
            while True:
                yield self._said.get_nowait()

    def refuse(self, address: str, why: str) -> None:
        """From now on a worker does not count as there."""
        self._refused[address] = why
        self._said.put(f"the worker {address} is given nothing: {why}")

    def forget(self, address: str) -> None:
        """A worker is another process than it was: it is looked at as a new one."""
        self._forgotten.add(address)

    def end(self, workers: Sequence[str]) -> None:
        """Has these workers forget the campaign."""
        with suppress(Exception):  # who is not reached forgets it by itself
            self._ask(workers, "end", self._campaign)

    def _refuse_scheduler(self) -> None:
        """`ClusterError` where the scheduler's Python is another: what is sent to it would not be read."""
        try:
            about = self._client.sync(self._client.scheduler.versions, packages=[], callback_timeout=ASK_S)
        except Exception as error:
            raise ClusterError(f"the scheduler does not answer: {_text(error)}") from None
        there, here = _python(about), identity()["Python"]
        if there != here:
            raise ClusterError(f"the scheduler runs Python {there}, here is {here}: Dask needs one for all")

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._look()
            except Exception:  # it is gone, or closing: shown by its silence
                if self._client.status != "running":
                    return
            self._stop.wait(LOOK_S)

    def _look(self) -> None:
        threads: Mapping[str, int] = self._client.sync(
            self._client.scheduler.ncores, callback_timeout=ASK_S
        )
        now_s = time.monotonic()
        forgotten, self._forgotten = self._forgotten, set()
        known = {
            address: there
            for address, there in self.seen.workers.items()
            if address in threads and address not in self._refused and address not in forgotten
        }
        self._show(now_s, threads, known)
        strangers = [
            address
            for address in threads
            if address not in known and address not in self._refused
            and self._ask_at_s.get(address, 0.0) <= now_s
        ]  # fmt: skip
        if strangers:
            self._ask_at_s |= dict.fromkeys(strangers, now_s + ASK_S)
            accepted = self._accepted(strangers)
            known |= {address: _There(threads[address], process) for address, process in accepted.items()}
            self._show(now_s, threads, known)
        if now_s - self._kept_s > KEEP_S:
            self._kept_s = now_s
            for address, process in self._ask(list(known), "keep", self._campaign).items():
                if isinstance(process, str) and process != known[address].process:
                    self.forget(address)

    def _show(self, at_s: float, threads: Mapping[str, int], known: Mapping[str, _There]) -> None:
        refused = sum(address in self._refused for address in threads)
        self.seen = _Seen(at_s, dict(known), refused, len(threads) - refused - len(known))

    def _accepted(self, addresses: Sequence[str]) -> dict[str, str]:
        """Of these workers those that have the same installation, and now know of the campaign; by address
        which process each is."""
        here = identity()
        alike = []
        for address, about in self._each(addresses, self._versions).items():
            if isinstance(about, Mapping):
                if (there := _python(about)) == here["Python"]:
                    alike.append(address)
                else:
                    self.refuse(address, differences({"Python": here["Python"]}, {"Python": there}))
        processes: dict[str, str] = {}
        for address, told in self._ask(alike, "about").items():
            if isinstance(told, Mapping):
                if wrong := differences(here, told):
                    self.refuse(address, wrong)
                else:
                    processes[address] = told[PROCESS]
            elif not isinstance(told, UNREACHED):
                self.refuse(address, f"it has no handfast like this one ({_text(told)})")
        accepted = {}
        for address, told in self._ask(list(processes), "begin", *self._told).items():
            if told is None:
                accepted[address] = processes[address]
            elif not isinstance(told, UNREACHED):
                self.refuse(address, _text(told))
        return accepted

    async def _versions(self, address: str) -> Any:
        message = {"op": "versions", "packages": []}
        found = await self._client.scheduler.broadcast(msg=message, workers=[address], on_error="ignore")
        return found.get(address)

    def _ask(self, workers: Sequence[str], name: str, *arguments: Any) -> dict[str, Any]:
        """What a function of `on_worker` gives on each of these workers, or the exception that it raises."""

        async def ask(address: str) -> Any:
            found = await self._client._run(
                remote(_MODULE, name), *arguments, workers=[address], on_error="return"
            )
            return found[address]

        return self._each(workers, ask)

    def _each(self, workers: Sequence[str], ask: Callable[[str], Awaitable[Any]]) -> dict[str, Any]:
        """What each of these workers answers, or an exception; asked side by side, not for long."""

        async def one(address: str) -> Any:
            try:
                return await asyncio.wait_for(ask(address), ASK_S)
            except Exception as error:
                return error

        async def every() -> list[Any]:
            return await asyncio.gather(*map(one, workers))

        return dict(zip(workers, self._client.sync(every), strict=True))


def remote(module: str, name: str) -> Callable[..., Any]:
    """A function that calls one of a module that is imported where it is called, not where it is read.

    It travels by value: a scheduler reads what is submitted, and need not have handfast installed.
    """

    def call(*arguments: Any) -> Any:
        from importlib import import_module

        return getattr(import_module(module), name)(*arguments)

    return call


def _python(about: Mapping[str, Any]) -> str:
    return ".".join(str(about["host"]["python"]).split(".")[:2])


def _runs(count: int) -> str:
    return f"{count} run{'s are' if count != 1 else ' is'}"


def _text(error: BaseException) -> str:
    return printable(" ".join(f"{type(error).__name__}: {error}".split())[:300])
