"""What runs within a Dask worker: it says what it has installed, and drives runs in processes of its own.

A run is not driven by the worker's thread that has been given it, but by a process that this thread watches
(`deploy.simulate.worker_pool`): so one that dies or hangs is what it is on one machine, a row, and what is
no longer wanted can be ended.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from handfast.deploy.cluster.identity import CHANGED, SOURCES, identity
from handfast.deploy.cluster.sent import SentWork, write_files
from handfast.deploy.simulate.worker_pool import Abandoned, GoOn, Pool

IDLE_S: Final = 60.0
"""A campaign that is given nothing for this long is forgotten, and its processes end: who asked is gone."""
PROCESS: Final = "process"

_BEGUN: Final = identity()
_TOKEN: Final = uuid.uuid4().hex
_campaigns: Final[dict[str, Campaign]] = {}
_guard: Final = threading.Lock()


class UnknownCampaign(Exception):
    """This process was told nothing of the campaign, or has forgotten it."""


def about() -> dict[str, str]:
    """`identity` of this installation, and `PROCESS`, which no other process has."""
    found = dict(identity())
    if found[SOURCES] != _BEGUN[SOURCES]:
        found[SOURCES] = CHANGED
    return found | {PROCESS: _TOKEN}


def begin(campaign: str, data: bytes, files: Mapping[str, bytes], timeout_s: float) -> None:
    """Makes a campaign known; runs are driven from then on."""
    # Dask's nannies start workers as daemons, which may have no children; ours end by themselves.
    if multiprocessing.parent_process() is not None:
        multiprocessing.current_process().daemon = False
    made = Campaign(campaign, data, files, timeout_s)
    with _guard:
        before = _campaigns.get(campaign)
        _campaigns[campaign] = made
    if before is not None:
        before.end()


def drive(campaign: str, number: int) -> object:
    """What came of one run, of which Dask's task is this call: the work's result, or as `SentWork` has it.

    Raises:
        UnknownCampaign: `begin` was not called here.
        handfast.deploy.simulate.worker_pool.PoolError: no process can be started.
        handfast.deploy.simulate.worker_pool.Abandoned: nobody wants it any more.
    """
    with _guard:
        known = _campaigns.get(campaign)
    if known is None:
        raise UnknownCampaign(campaign)
    return known.drive(number, wanted())


def keep(campaign: str) -> str:
    """Has a campaign live on though no run comes. Returns `PROCESS`, empty where it is not known."""
    with _guard:
        known = _campaigns.get(campaign)
    return _TOKEN if known is not None and known.keep() else ""


def end(campaign: str) -> None:
    """Forgets a campaign and ends its processes; fine where there is none."""
    with _guard:
        known = _campaigns.pop(campaign, None)
    if known is not None:
        known.end()


def wanted() -> GoOn:
    """Whether the task that calls this is still asked for: not after it was cancelled, or its client or the
    scheduler has gone, which Dask tells a worker, but not the task."""
    from distributed import Status, get_worker

    worker = get_worker()
    key = worker.get_current_task()
    running = (Status.init, Status.running, Status.paused)

    def look() -> bool:
        task = worker.state.tasks.get(key)
        return task is not None and task.state == "executing" and worker.status in running

    return look


class Campaign:
    """The processes of one campaign: as many as there are threads that ask at a time.

    Arguments as of `begin`.
    """

    def __init__(self, name: str, data: bytes, files: Mapping[str, bytes], timeout_s: float) -> None:
        self._name, self._timeout_s = name, timeout_s
        self._folder = tempfile.TemporaryDirectory(prefix="handfast-plugins-") if files else None
        if self._folder is not None:
            write_files(Path(self._folder.name), files)
        self._work = SentWork(data, Path(self._folder.name) if self._folder is not None else None)
        self._idle: list[Pool[Any]] = []
        self._busy: set[Pool[Any]] = set()
        self._guard = threading.Lock()
        self._ended = False
        self._timer: threading.Timer | None = None
        self._wait()

    def drive(self, number: int, go_on: GoOn) -> object:
        with self._guard:
            if self._ended:
                raise UnknownCampaign(self._name)
            pool = self._idle.pop() if self._idle else Pool(self._work, 1, self._timeout_s)
            self._busy.add(pool)
            self._stop_waiting()
        done = False
        try:
            for result in pool.results((number,), lambda: go_on() and not self._ended):
                done = True
                return result
            raise Abandoned
        finally:
            with self._guard:
                self._busy.discard(pool)
                kept = done and not self._ended
                if kept:
                    self._idle.append(pool)
                if not self._busy and not self._ended:
                    self._wait()
            if not kept:
                pool.__exit__(None, None, None)

    def keep(self) -> bool:
        """Starts the time anew after which it is forgotten; False when it is already."""
        with self._guard:
            if not self._busy and not self._ended:
                self._wait()
            return not self._ended

    def end(self) -> None:
        """Ends its processes; runs under way end within a moment, each in its thread."""
        with self._guard:
            self._ended = True
            self._stop_waiting()
            idle, self._idle = self._idle, []
        for pool in idle:
            pool.__exit__(None, None, None)
        if self._folder is not None:
            self._folder.cleanup()

    def _wait(self) -> None:
        self._stop_waiting()
        self._timer = threading.Timer(IDLE_S, end, (self._name,))
        self._timer.daemon = True
        self._timer.start()

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
