"""Which workers of a Dask scheduler may be given runs: those that are there, and have what this end has.

Versions are asked for by Dask's own means first, since nothing else may be sent to another Python.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from distributed.comm.core import CommClosedError

from handfast.agent.common.wording import printable
from handfast.deploy.cluster.connection import CLOSE_S, ClusterError, GivenUp, patiently
from handfast.deploy.cluster.identity import INSTALL, differences, identity
from handfast.deploy.cluster.on_worker import PROCESS
from handfast.deploy.cluster.reasons import error_line
from handfast.deploy.simulate.worker_pool import GoOn

LOOK_S: Final = 1.0
"""How often it is looked which workers there are."""
ASK_S: Final = 10.0
"""So long one question to the scheduler or a worker may take."""
KEEP_S: Final = 15.0
"""How often workers are told that the campaign goes on: they forget one that is not heard of
(`deploy.cluster.on_worker.IDLE_S`)."""
UNREACHED: Final = (TimeoutError, ConnectionError, CommClosedError, KeyError)
"""What a worker raises that is on its way here or away: it is asked again."""
MODULE: Final = "handfast.deploy.cluster.on_worker"


@dataclass(frozen=True, slots=True)
class There:
    """A worker that is there and may be given runs."""

    threads: int
    process: str


@dataclass(frozen=True, slots=True)
class Seen:
    """What was seen when the scheduler was asked last: workers that may be given runs; how many may not; how
    many have not been looked at."""

    at_s: float
    workers: Mapping[str, There]
    refused: int = 0
    unknown: int = 0


class Watch:
    """Looks who is there, in a thread, so that a scheduler that does not answer holds up nothing else.

    Each worker is asked what it has installed, and told of the campaign, before it counts as there; and told
    again and again that the campaign goes on. One that does not answer holds up no other.
    """

    def __init__(
        self,
        client: Any,
        campaign: str,
        data: bytes,
        files: Mapping[str, bytes],
        timeout_s: float,
        go_on: GoOn = lambda: True,
    ) -> None:
        self._client = client
        self._campaign = campaign
        self._told = (campaign, data, files, timeout_s)
        self._refused: dict[str, str] = {}
        self._names: dict[str, str] = {}
        self._forgotten: set[str] = set()
        self._ask_at_s: dict[str, float] = {}
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._kept_s = time.monotonic()
        self._refuse_scheduler(go_on)
        self.seen = Seen(time.monotonic(), {}, 0, 1)
        self._thread = threading.Thread(target=self._run, name="cluster", daemon=True)
        self._thread.start()

    def stop(self, within_s: float = CLOSE_S) -> bool:
        """Looks no more; whether it has ended already: else it waits for an answer."""
        self._stop.set()
        self._thread.join(within_s)
        return not self._thread.is_alive()

    @property
    def silent_s(self) -> float:
        """For how long the scheduler has said nothing."""
        return time.monotonic() - self.seen.at_s

    def said(self) -> Iterator[str]:
        """What a person should know, since it was asked last."""
        with suppress(queue.Empty):
            while True:
                yield self._said.get_nowait()

    def usable(self) -> list[tuple[str, There]]:
        """Workers that may be given runs, by address."""
        return [
            (address, there) for address, there in self.seen.workers.items() if address not in self._refused
        ]

    def refuse(self, address: str, why: str) -> None:
        """From now on a worker does not count as there."""
        self._refused[address] = why
        name = self._names.get(address, address)
        called = f" ({printable(name)})" if name != address else ""
        self._said.put(f"the worker {address}{called} is given nothing: {why}")

    def forget(self, address: str) -> None:
        """A worker is another process than it was: it is looked at as a new one."""
        self._forgotten.add(address)

    def end(self, workers: Sequence[str], within_s: float = ASK_S) -> None:
        """Has these workers forget the campaign."""
        with suppress(Exception):  # who is not reached forgets it by itself
            self._ask(workers, "end", self._campaign, within_s=within_s)

    def _refuse_scheduler(self, go_on: GoOn) -> None:
        """`ClusterError` where the scheduler's Python is another: what is sent to it would not be read."""
        ask = partial(self._client.scheduler.versions, packages=[])
        try:
            about = self._client.sync(patiently, ask, ASK_S, go_on)
        except GivenUp:
            raise
        except Exception as error:
            raise ClusterError(f"the scheduler does not answer: {error_line(error)}") from None
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
        threads: Mapping[str, int] = self._client.sync(self._client.scheduler.ncores, callback_timeout=ASK_S)
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
            self._learn_names()
            self._ask_at_s |= dict.fromkeys(strangers, now_s + ASK_S)
            accepted = self._accepted(strangers)
            known |= {address: There(threads[address], process) for address, process in accepted.items()}
            self._show(now_s, threads, known)
        if now_s - self._kept_s > KEEP_S:
            self._kept_s = now_s
            for address, process in self._ask(list(known), "keep", self._campaign).items():
                if isinstance(process, str) and process != known[address].process:
                    self.forget(address)

    def _show(self, at_s: float, threads: Mapping[str, int], known: Mapping[str, There]) -> None:
        refused = sum(address in self._refused for address in threads)
        self.seen = Seen(at_s, dict(known), refused, len(threads) - refused - len(known))

    def _learn_names(self) -> None:
        """Takes note of what workers are called, by whoever started them."""
        with suppress(Exception):  # a name only helps
            ask = partial(self._client.scheduler.identity, n_workers=-1)
            workers = self._client.sync(ask, callback_timeout=ASK_S)["workers"]
            self._names |= {address: str(about["name"]) for address, about in workers.items()}

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
                why = f"it has no handfast like this one ({error_line(told)})"
                self.refuse(address, f"{why}: install the same there, {INSTALL}, and start it again")
        accepted = {}
        for address, told in self._ask(list(processes), "begin", *self._told).items():
            if told is None:
                accepted[address] = processes[address]
            elif not isinstance(told, UNREACHED):
                self.refuse(address, error_line(told))
        return accepted

    async def _versions(self, address: str) -> Any:
        message = {"op": "versions", "packages": []}
        found = await self._client.scheduler.broadcast(msg=message, workers=[address], on_error="ignore")
        return found.get(address)

    def _ask(
        self, workers: Sequence[str], name: str, *arguments: Any, within_s: float = ASK_S
    ) -> dict[str, Any]:
        """What a function of `on_worker` gives on each of these workers, or the exception that it raises."""

        async def ask(address: str) -> Any:
            found = await self._client._run(
                remote(MODULE, name), *arguments, workers=[address], on_error="return"
            )
            return found[address]

        return self._each(workers, ask, within_s)

    def _each(
        self, workers: Sequence[str], ask: Callable[[str], Awaitable[Any]], within_s: float = ASK_S
    ) -> dict[str, Any]:
        """What each of these workers answers, or an exception; asked side by side, not for long."""

        async def one(address: str) -> Any:
            try:
                return await asyncio.wait_for(ask(address), min(within_s, ASK_S))
            except Exception as error:
                return error

        async def every() -> list[Any]:
            return await asyncio.gather(*map(one, workers))

        found = self._client.sync(every, callback_timeout=within_s + CLOSE_S)
        return dict(zip(workers, found, strict=True))


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
