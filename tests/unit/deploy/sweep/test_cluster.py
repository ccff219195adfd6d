"""Runs as Dask tasks, with a scheduler that is made up."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import distributed
import pytest

from handfast.agent.common.errors import Error
from handfast.deploy.simulate.worker_pool import (
    Abandoned,
    ClusterError,
    EngineLost,
    PoolError,
    Refused,
    identity,
)
from handfast.deploy.sweep import cluster as engine
from handfast.deploy.sweep.cluster import Campaign, Cluster, SentWork, Unfinished


class Doubles:
    def execute(self, number: int, _go_on: Callable[[], bool]) -> int:
        return 2 * number

    def unfinished(self, number: int, reason: str, _wall_s: float, *, timed_out: bool) -> str:
        return f"{number} {'timed out' if timed_out else 'crashed'}: {reason}"


class Scheduler:
    """Stands in for `distributed.Client`: `answers` holds what a run gives or raises, by its number.

    A run without an answer gives its double; one whose answer is None never ends.
    """

    def __init__(self) -> None:
        self.answers: dict[int, object] = {}
        self.workers: dict[str, object] = {"tcp://one:1": identity()}
        self.submitted: list[int] = []
        self.most = self.left = 0
        self.closed = self.lost = False
        self.scheduler = SimpleNamespace(identity="identity", unregister_worker_plugin="unregister")

    def __call__(self, address: str, **_: object) -> Scheduler:
        if self.lost:
            raise OSError(f"Timed out trying to connect to {address}\nafter 10 s")
        return self

    def run(self, function: object, **_: object) -> dict[str, object]:
        assert function is identity
        return self.workers

    def register_plugin(self, plugin: Campaign, name: str) -> None:
        assert pickle.dumps(plugin)

    def sync(self, question: str, **_: object) -> dict[str, int]:
        if self.lost:
            raise TimeoutError
        return {"n_workers": len(self.workers)}

    def submit(self, _function: object, _name: str, run: int, **_: object) -> Future:
        self.submitted.append(run)
        self.left += 1
        self.most = max(self.most, self.left)
        return Future(self, run)

    def close(self, **_: object) -> None:
        self.closed = True


class Future:
    def __init__(self, scheduler: Scheduler, run: int) -> None:
        self.scheduler, self.run = scheduler, run

    def add_done_callback(self, callback: Callable[[object], None]) -> None:
        if self.scheduler.answers.get(self.run, 0) is not None:
            callback(self)

    def result(self, **_: object) -> object:
        self.scheduler.left -= 1
        answer = self.scheduler.answers.get(self.run, 2 * self.run)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def scheduler(monkeypatch: pytest.MonkeyPatch) -> Scheduler:
    made = Scheduler()
    monkeypatch.setattr(distributed, "Client", made)
    monkeypatch.setattr(engine, "LOOK_S", 0.0)
    return made


def cluster(wait_s: float = 60.0) -> Cluster[Any]:
    return Cluster("tcp://there:1", Doubles(), 9.0, {}, wait_s)


def drive(runs: range, wait_s: float = 60.0) -> list[object]:
    with cluster(wait_s) as made:
        return list(made.results(runs, lambda: True))


def test_every_run_is_a_task_and_a_scheduler_holds_few_at_a_time(
    scheduler: Scheduler, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "SUBMITTED_MAX", 3)
    assert drive(range(20)) == [2 * run for run in range(20)]
    assert (scheduler.submitted, scheduler.most, scheduler.closed) == (list(range(20)), 3, True)


def test_runs_whose_processes_or_workers_died_are_results(scheduler: Scheduler) -> None:
    scheduler.answers[0] = Unfinished("not done within 9 s", 9.0, timed_out=True)
    scheduler.answers[1] = distributed.KilledWorker("key", SimpleNamespace(address="tcp://one:1"), 3)
    assert drive(range(3)) == [
        "0 timed out: not done within 9 s",
        "1 crashed: the 4 workers that drove it died",
        4,
    ]


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (PoolError("no such module"), "^a worker of tcp://there:1 cannot drive runs: no such module$"),
        (ValueError("gone"), r"^the scheduler tcp://there:1 is gone \(ValueError: gone\)$"),
    ],
)
def test_a_worker_or_scheduler_that_cannot_go_on_ends_the_campaign(
    scheduler: Scheduler, answer: Exception, says: str
) -> None:
    scheduler.answers[1] = answer
    with pytest.raises(EngineLost, match=says):
        drive(range(3))
    assert scheduler.closed


def test_a_scheduler_without_workers_is_waited_for(scheduler: Scheduler) -> None:
    scheduler.workers = {}
    scheduler.answers[0] = None
    with pytest.raises(EngineLost, match=r"^the scheduler tcp://there:1 has had no worker for 0\.3 s"):
        drive(range(1), wait_s=0.3)


def test_a_scheduler_that_does_not_answer_is_lost(scheduler: Scheduler) -> None:
    scheduler.answers[0] = None
    with cluster() as made:
        scheduler.lost = True
        with pytest.raises(EngineLost, match=r"^the scheduler tcp://there:1 is gone"):
            list(made.results(range(1), lambda: True))


def test_results_end_when_they_are_no_longer_wanted(scheduler: Scheduler) -> None:
    scheduler.answers[1] = None
    until_s = time.monotonic() + 0.3
    with cluster() as made:
        assert list(made.results(range(2), lambda: time.monotonic() < until_s)) == [0]


@pytest.mark.parametrize(
    ("there", "says"),
    [
        (
            identity() | {"numpy": "1.0"},
            r"the worker tcp://one:1 has another installation: numpy 1\.0 instead",
        ),
        (ModuleNotFoundError("No module named 'deploy'"), "the worker tcp://one:1 cannot load handfast: Mod"),
    ],
)
def test_a_worker_with_another_program_is_refused_before_anything_runs(
    scheduler: Scheduler, there: object, says: str
) -> None:
    scheduler.workers["tcp://one:1"] = there
    with pytest.raises(ClusterError, match=says):
        drive(range(3))
    assert (scheduler.submitted, scheduler.closed) == ([], True)


def test_a_scheduler_that_is_not_there_is_one_line(scheduler: Scheduler) -> None:
    scheduler.lost = True
    with pytest.raises(
        Error, match=r"^cannot connect to a Dask scheduler at tcp://there:1: Timed out trying [^\n]+$"
    ):
        drive(range(1))


# --- in the workers ---------------------------------------------------------------------------------


class Dies(Doubles):
    def execute(self, number: int, go_on: Callable[[], bool]) -> int:
        if number == 0:
            raise SystemExit(3)
        return super().execute(number, go_on)


def test_a_worker_drives_runs_in_processes_and_leaves_nothing(tmp_path: Any) -> None:
    worker: Any = SimpleNamespace(local_directory=str(tmp_path))
    campaign = Campaign(pickle.dumps(Dies()), {"a_package/module.py": b"x = 1\n"}, 60.0)
    campaign.setup(worker)
    assert [path.read_bytes() for path in tmp_path.rglob("module.py")] == [b"x = 1\n"]
    found = campaign.drive(0, lambda: True)
    assert isinstance(found, Unfinished)
    assert found.reason == "its process ended with exit status 3"
    assert campaign.drive(3, lambda: True) == 6
    with pytest.raises(Abandoned):
        campaign.drive(4, lambda: False)
    campaign.teardown(worker)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(Abandoned):
        campaign.drive(5, lambda: True)


def test_work_that_cannot_be_read_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.path", [])
    with pytest.raises(Refused, match="no_such_module"):
        SentWork(b"cno_such_module\nName\n.", "folder").execute(1, lambda: True)
