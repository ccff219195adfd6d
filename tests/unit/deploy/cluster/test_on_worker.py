"""Campaigns within a Dask worker, with pools that start no process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import distributed
import pytest

from handfast.deploy.cluster import on_worker
from handfast.deploy.cluster.identity import SOURCES, differences, identity
from handfast.deploy.simulate.worker_pool import Abandoned


class Here:
    """A pool that gives a run's number, until it is to go on no more."""

    made: list[Here]

    def __init__(self, _work: object, jobs: int, timeout_s: float) -> None:
        self.jobs, self.timeout_s, self.left, self.driven = jobs, timeout_s, 0, 0
        Here.made.append(self)

    def results(self, runs: tuple[int, ...], go_on: Callable[[], bool]) -> Iterator[int]:
        for run in runs:
            if go_on():
                self.driven += 1
                yield run

    def __exit__(self, *_: object) -> None:
        self.left += 1


@pytest.fixture(autouse=True)
def no_processes(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    Here.made = []
    monkeypatch.setattr(on_worker, "Pool", Here)
    monkeypatch.setattr(on_worker, "wanted", lambda: lambda: True)
    yield
    for name in list(on_worker._campaigns):
        on_worker.end(name)


def test_one_process_drives_run_after_run_and_ends_with_the_campaign() -> None:
    on_worker.begin("one", b"", {}, 9.0)
    assert [on_worker.drive("one", number) for number in (3, 4)] == [3, 4]
    (pool,) = Here.made
    assert (pool.jobs, pool.timeout_s, pool.driven, pool.left) == (1, 9.0, 2, 0)
    on_worker.end("one")
    assert pool.left == 1
    with pytest.raises(on_worker.UnknownCampaign):
        on_worker.drive("one", 5)
    on_worker.end("one")


def test_what_nobody_wants_any_more_is_ended_with_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    on_worker.begin("one", b"", {}, 9.0)
    monkeypatch.setattr(on_worker, "wanted", lambda: lambda: False)
    with pytest.raises(Abandoned):
        on_worker.drive("one", 3)
    assert [pool.left for pool in Here.made] == [1]


def test_a_campaign_that_nobody_speaks_of_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    forgotten = threading.Event()
    known = on_worker.end

    def end(name: str) -> None:
        known(name)
        forgotten.set()

    monkeypatch.setattr(on_worker, "end", end)
    monkeypatch.setattr(on_worker, "IDLE_S", 0.05)
    on_worker.begin("one", b"", {"package/plugin.py": b""}, 9.0)
    folder = on_worker._campaigns["one"]._folder
    assert folder is not None
    assert forgotten.wait(10.0)
    assert on_worker.keep("one") == ""
    with pytest.raises(FileNotFoundError):
        open(f"{folder.name}/package/plugin.py").close()


def test_a_campaign_that_is_told_to_go_on_is_kept() -> None:
    on_worker.begin("one", b"", {}, 9.0)
    assert on_worker.keep("one") == on_worker.about()[on_worker.PROCESS]
    assert on_worker.keep("two") == ""


def test_sources_that_changed_under_a_worker_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert differences(identity(), on_worker.about()) == ""
    monkeypatch.setattr(on_worker, "identity", lambda: dict(identity()) | {SOURCES: "else"})
    assert "changed since it started" in differences(identity(), on_worker.about())


@pytest.mark.parametrize(
    ("state", "status", "asked"),
    [
        ("executing", distributed.Status.running, True),
        ("executing", distributed.Status.closing, False),
        ("cancelled", distributed.Status.running, False),
        (None, distributed.Status.running, False),
    ],
)
def test_a_task_is_wanted_until_it_is_cancelled_or_the_worker_closes(
    monkeypatch: pytest.MonkeyPatch, state: str | None, status: Any, asked: bool
) -> None:
    monkeypatch.undo()
    tasks = {"key": SimpleNamespace(state=state)} if state is not None else {}
    worker = SimpleNamespace(
        get_current_task=lambda: "key", state=SimpleNamespace(tasks=tasks), status=status
    )
    monkeypatch.setattr(distributed, "get_worker", lambda: worker)
    assert on_worker.wanted()() is asked
