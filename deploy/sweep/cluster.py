"""Drive the runs of a campaign on the workers of a Dask scheduler. Each run is one Dask task.

The worker's thread does not drive the run itself. It watches a process that does
(`deploy.simulate.worker_pool`), so that a run that dies or hangs becomes a row, as on one machine."""

from __future__ import annotations

import logging
import multiprocessing
import pickle
import queue
import shutil
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

import distributed
from distributed.versions import VersionMismatchWarning

from handfast.agent.common.errors import Error
from handfast.agent.common.wording import printable
from handfast.deploy.console.wording import error_text
from handfast.deploy.simulate.worker_pool import (
    POLL_S,
    Abandoned,
    ClusterError,
    EngineLost,
    GoOn,
    Pool,
    PoolError,
    Refused,
    Work,
    differences,
    identity,
)

CONNECT_S: Final = 10.0
"""Timeout of each step of connecting to the scheduler."""
ANSWER_S: Final = 20.0
"""Timeout of a question to the scheduler. A scheduler that takes longer is treated as lost."""
LOOK_S: Final = 2.0
"""Period at which the scheduler is asked how many workers it has."""
CLOSE_S: Final = 5.0
"""Timeout of each step of closing the connection."""
SUBMITTED_MAX: Final = 2000
"""Maximum number of runs that the scheduler holds at a time."""

T = TypeVar("T")


class Cluster(Generic[T]):
    """Drives runs of `work` on the workers of a scheduler, each run in at most `timeout_s`. An `Engine`.

    Args:
        address: ``tcp://host:port`` or ``tls://host:port``.
        files: contents of plugin files by their names below a folder of packages; sent to the workers.
        wait_s: time to wait while the scheduler has no worker.

    Raises:
        ClusterError: on entering: the scheduler cannot be reached, or a worker has other versions.
    """

    def __init__(
        self,
        address: str,
        work: Work[T],
        timeout_s: float,
        files: Mapping[str, bytes],
        wait_s: float,
    ) -> None:
        self._address, self._work, self._wait_s = address, work, wait_s
        self._campaign = Campaign(pickle.dumps(work), files, timeout_s)
        self._name = f"handfast-{uuid.uuid4().hex}"
        self._asked_s = self._manned_s = time.monotonic()

    def __enter__(self) -> Cluster[T]:
        for name in list(logging.root.manager.loggerDict):
            if name.partition(".")[0] == "distributed":
                logging.getLogger(name).setLevel(logging.CRITICAL)  # errors are reported as one line
        make: Any = distributed.Client
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", VersionMismatchWarning)  # `_compare` names what matters
            try:
                self._client: Any = make(self._address, timeout=CONNECT_S, set_as_default=False)
            except Exception as error:  # Dask raises almost anything, depending on who answers there
                raise ClusterError(
                    f"cannot connect to a Dask scheduler at {self._address}: {_line(error)}"
                ) from None
        try:
            self._compare()
            self._client.register_plugin(self._campaign, name=self._name)
        except BaseException as error:
            self.__exit__(None, None, None)
            if isinstance(error, Error) or not isinstance(error, Exception):
                raise
            raise ClusterError(f"the workers of {self._address} cannot be used: {_line(error)}") from None
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._ask(self._client.scheduler.unregister_worker_plugin, CLOSE_S, name=self._name)
        with suppress(Exception):
            self._client.close(timeout=CLOSE_S)

    def _compare(self) -> None:
        """Compare the versions of all workers with those of this installation."""
        here = identity()
        for address, there in self._client.run(identity, on_error="return").items():
            if isinstance(there, Exception):
                raise ClusterError(f"the worker {address} cannot load handfast: {_line(there)}")
            if text := differences(here, there):
                raise ClusterError(
                    f"the worker {address} has another installation: {text}. Install the same there, "
                    "and restart it"
                )

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[T]:
        """Yield the results of `runs` in the order in which they end, until all are done or `go_on` returns
        False.

        Raises:
            EngineLost: the scheduler or every worker is gone, or a worker cannot drive runs.
        """
        waiting = iter(runs)
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        submitted: dict[Any, int] = {}
        self._manned_s = time.monotonic()
        while go_on():
            while len(submitted) < SUBMITTED_MAX and (run := next(waiting, None)) is not None:
                key = (self._name, run)
                future = self._client.submit(drive, self._name, run, key=key, pure=False)
                submitted[future] = run
                future.add_done_callback(ended.put)
            if not submitted:
                return
            try:
                future = ended.get(timeout=POLL_S)
            except queue.Empty:
                self._look()
                continue
            yield self._result(submitted.pop(future), future)

    def _result(self, run: int, future: Any) -> T:
        try:
            found = future.result(timeout=ANSWER_S)
        except distributed.KilledWorker as error:
            found = Unfinished(f"the {error.allowed_failures + 1} workers that drove it died", 0.0, False)
        except PoolError as error:
            raise EngineLost(f"a worker of {self._address} cannot drive runs: {error}") from None
        except Exception as error:
            raise EngineLost(f"the scheduler {self._address} is gone ({_line(error)})") from None
        if isinstance(found, Unfinished):
            return self._work.unfinished(run, found.reason, found.wall_s, timed_out=found.timed_out)
        result: T = found
        return result

    def _look(self) -> None:
        """Raise `EngineLost` if the scheduler does not answer, or has had no worker for too long."""
        if (now_s := time.monotonic()) < self._asked_s + LOOK_S:
            return
        self._asked_s = now_s
        try:
            workers = self._ask(self._client.scheduler.identity, ANSWER_S, n_workers=0)["n_workers"]
        except Exception as error:
            raise EngineLost(f"the scheduler {self._address} is gone ({_line(error)})") from None
        if workers:
            self._manned_s = now_s
        elif now_s - self._manned_s > self._wait_s:
            raise EngineLost(
                f"the scheduler {self._address} has had no worker for {self._wait_s:g} s "
                "(--cluster-wait, or cluster_wait in Python, waits longer)"
            )

    def _ask(self, question: Any, timeout_s: float, **arguments: object) -> Any:
        return self._client.sync(question, callback_timeout=timeout_s, **arguments)


def _line(error: BaseException) -> str:
    text = str(error)
    if not text or not isinstance(error, OSError):
        text = f"{type(error).__name__}: {text}"
    return printable(" ".join(text.split())[:300])


# --- in the workers ---------------------------------------------------------------------------------


class Unfinished(NamedTuple):
    """A run whose process died or was ended; fields as of `Work.unfinished`."""

    reason: str
    wall_s: float
    timed_out: bool


class Campaign(distributed.WorkerPlugin):
    """What a worker needs to drive runs: the work as bytes, plugin files, and the processes that are idle."""

    def __init__(self, data: bytes, files: Mapping[str, bytes], timeout_s: float) -> None:
        self._data, self._files, self._timeout_s = data, dict(files), timeout_s

    def setup(self, worker: distributed.Worker) -> None:
        if multiprocessing.parent_process() is not None:
            # A nanny starts workers as daemons, which may not have children. Ours end by themselves.
            multiprocessing.current_process().daemon = False
        self._ended = False
        self._idle: list[Pool[Any]] = []
        self._folder = Path(tempfile.mkdtemp(prefix="handfast-", dir=worker.local_directory))
        for name, data in self._files.items():
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        self._work = SentWork(self._data, str(self._folder))

    def teardown(self, worker: distributed.Worker) -> None:
        self._ended = True
        while self._idle:
            self._idle.pop().__exit__(None, None, None)
        shutil.rmtree(self._folder, ignore_errors=True)

    def drive(self, run: int, go_on: GoOn) -> object:
        """Return the result of a run, or `Unfinished`.

        Raises:
            PoolError: no run can be driven here.
            Abandoned: the run is no longer wanted.
        """
        try:
            pool = self._idle.pop()
        except IndexError:
            pool = Pool(self._work, 1, self._timeout_s)
        found: list[Any] = []
        try:
            found += pool.results((run,), lambda: go_on() and not self._ended)
        finally:
            if found and not self._ended:
                self._idle.append(pool)
            else:
                pool.__exit__(None, None, None)
        if not found:
            raise Abandoned
        return found[0]


class SentWork:
    """A `Work` as bytes, which only the processes that drive runs unpickle: they alone import plugins."""

    def __init__(self, data: bytes, folder: str) -> None:
        self._data, self._folder = data, folder
        self._work: Work[Any] | None = None

    def execute(self, number: int, go_on: GoOn) -> object:
        if self._work is None:
            sys.path.insert(0, self._folder)
            try:
                self._work = pickle.loads(self._data)  # noqa: S301 (docs/sweep.md says whom Dask trusts)
            except Exception as error:
                raise Refused(error_text(error)) from None
        assert self._work is not None
        return self._work.execute(number, go_on)

    def unfinished(self, _number: int, reason: str, wall_s: float, *, timed_out: bool) -> Unfinished:
        return Unfinished(reason, wall_s, timed_out)


def drive(name: str, run: int) -> object:
    """Drive one run of the campaign `name`. This call is the Dask task."""
    worker = distributed.get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        # Dask does not interrupt a task that was cancelled, or whose client or scheduler is gone.
        task = worker.state.tasks.get(key)
        return task is not None and task.state == "executing"

    return worker.plugins[name].drive(run, wanted)  # type: ignore[attr-defined]
