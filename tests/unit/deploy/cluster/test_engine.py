"""Which worker is given which run, and what the loss of one means; without a scheduler."""

from __future__ import annotations

import asyncio
import gc
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed.client import AllExit, FutureCancelledError

from handfast.deploy.cluster import engine
from handfast.deploy.cluster.connection import ClusterError, GivenUp
from handfast.deploy.cluster.engine import AHEAD, DEMAND_MAX, NOBODY_HAS, Cluster
from handfast.deploy.cluster.on_worker import UnknownCampaign
from handfast.deploy.cluster.sent import Unfinished, Unreadable
from handfast.deploy.cluster.watch import Seen, There
from handfast.deploy.simulate.worker_pool import EngineLost


class Numbers:
    """Work of which only `unfinished` is asked."""

    def execute(self, number: int, go_on: Callable[[], bool]) -> str:
        raise AssertionError(number)

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> str:
        return f"{number}: {reason}"


class Future:
    def __init__(self, key: str, run: int, worker: str) -> None:
        self.key, self.run, self.worker = key, run, worker
        self.found: object = None
        self.released = False
        self._call: Callable[[object], None] = lambda _: None

    def add_done_callback(self, call: Callable[[object], None]) -> None:
        self._call = call

    def end(self, found: object) -> None:
        self.found = found
        self._call(self)

    def result(self, timeout: float) -> object:
        if isinstance(self.found, Exception):
            raise self.found
        return self.found

    def release(self) -> None:
        self.released = True


class Client:
    """Takes note of what is submitted and cancelled."""

    status = "running"

    def __init__(self) -> None:
        self.futures: list[Future] = []
        self.cancelled: list[Future] = []
        self.demand: list[Future] = []

    def submit(
        self, _call: object, _campaign: str, run: int, *, key: str, workers: list[str], **_: Any
    ) -> Future:
        self.futures.append(Future(key, run, workers[0]))
        return self.futures[-1]

    def map(
        self, call: object, values: range, *, key: list[str], resources: dict[str, int], **_: Any
    ) -> list[Future]:
        assert call is int, "which is there whatever a worker has installed"
        assert resources == {NOBODY_HAS: 1}
        made = [Future(each, -1, "") for each, _ in zip(key, values, strict=True)]
        self.demand += made
        return made

    def _cancel(self) -> None:
        raise AssertionError

    def sync(self, call: object, futures: list[Future], **_: Any) -> None:
        assert call == self._cancel
        self.cancelled += futures


class Watch:
    """Shows what the test says."""

    def __init__(self) -> None:
        self.seen = Seen(time.monotonic(), {})
        self.refused: dict[str, str] = {}
        self.forgotten: list[str] = []

    def show(self, **threads: int) -> None:
        there = {name: There(count, "process") for name, count in threads.items()}
        self.seen = Seen(time.monotonic(), there)

    def said(self) -> Iterator[str]:
        return iter(())

    def usable(self) -> list[tuple[str, There]]:
        return [pair for pair in self.seen.workers.items() if pair[0] not in self.refused]

    def refuse(self, address: str, why: str) -> None:
        self.refused[address] = why

    def forget(self, address: str) -> None:
        self.forgotten.append(address)


class Bench:
    """A cluster whose rounds a test writes down: what happens before each."""

    def __init__(self, **options: Any) -> None:
        self.told: list[str] = []
        self.counts: list[tuple[int, int]] = []
        self.cluster = Cluster(
            "tcp://there:1",
            Numbers(),
            9.0,
            files={},
            say=self.told.append,
            count=lambda *found: self.counts.append(found),
            **options,
        )
        self.client, self.watch = Client(), Watch()
        self.cluster._client, self.cluster._watch = self.client, self.watch  # type: ignore[assignment]

    def rounds(self, runs: range, *steps: Callable[[], object]) -> list[object]:
        """What comes of runs in as many rounds as there are steps."""
        left = list(steps)

        def go_on() -> bool:
            if not left:
                return False
            left.pop(0)()
            return True

        return list(self.cluster.results(runs, go_on))

    def given(self) -> dict[str, list[int]]:
        """Runs that workers were given and still have, in order."""
        found: dict[str, list[int]] = {}
        for address, worker in self.cluster._workers.items():
            found[address] = [given.run for given in worker.given.values()]
        return found

    def end(self, run: int, found: object = None) -> Callable[[], None]:
        """A step: the last future of a run ends."""
        return lambda: [each for each in self.client.futures if each.run == run][-1].end(
            f"done {run}" if found is None else found
        )


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "POLL_S", 0.001)


def test_no_more_is_submitted_than_threads_have_and_a_few_that_wait() -> None:
    bench = Bench()
    found = bench.rounds(range(1000), lambda: bench.watch.show(a=1, b=2), bench.end(0), bench.end(1))
    assert found == ["done 0", "done 1"]
    assert len(bench.client.futures) <= 2 + 3 * (1 + AHEAD)
    assert {address: len(runs) for address, runs in bench.given().items()} == {"a": 2, "b": 3}
    assert bench.counts == [(3, 2)]
    assert sorted(each.run for each in bench.client.futures[:3]) == [0, 1, 2], "threads first"


def test_runs_of_a_lost_worker_are_driven_elsewhere_and_before_others() -> None:
    bench = Bench()
    bench.rounds(range(6), lambda: bench.watch.show(a=1), lambda: bench.watch.show(b=1))
    # Run 0 was under way: it is driven alone. Run 1 only waited there.
    assert bench.given() == {"b": [0]}
    assert bench.told == ["the worker a is gone; 2 runs are driven again elsewhere"]
    assert [each.run for each in bench.client.cancelled] == [0, 1]
    assert bench.cluster._deaths == {0: ["a"]}


def test_a_run_that_two_workers_died_with_is_a_result() -> None:
    bench = Bench()
    found = bench.rounds(
        range(4),
        lambda: bench.watch.show(a=1),
        lambda: bench.watch.show(b=1),
        lambda: bench.watch.show(c=1),
        bench.end(1),
    )
    assert found == ["0: the workers that drove it died: a, b", "done 1"]


def test_another_process_at_the_same_address_is_another_worker() -> None:
    bench = Bench()
    bench.rounds(
        range(1),
        lambda: bench.watch.show(a=1),
        bench.end(0, UnknownCampaign("x")),
    )
    assert bench.watch.forgotten == ["a"]
    bench = Bench()

    def again() -> None:
        bench.watch.seen = Seen(time.monotonic(), {"a": There(1, "another")})

    bench.rounds(range(1), lambda: bench.watch.show(a=1), again)
    assert bench.cluster._deaths == {0: ["a"]}
    assert bench.given() == {"a": [0]}


def test_a_worker_that_cannot_read_the_work_is_given_nothing_and_its_runs_go_to_others() -> None:
    bench = Bench()
    found = bench.rounds(
        range(3),
        lambda: bench.watch.show(a=1, b=1),
        bench.end(0, Unreadable("no module")),
        lambda: None,
        bench.end(0),
    )
    assert bench.watch.refused == {"a": "no module"}
    assert found == ["done 0"]
    assert bench.cluster._deaths == {}


def test_a_run_that_others_cancelled_is_given_again() -> None:
    bench = Bench()
    found = bench.rounds(
        range(1),
        lambda: bench.watch.show(a=1),
        bench.end(0, FutureCancelledError("key", "by others")),
        lambda: None,
        bench.end(0),
    )
    assert found == ["done 0"]
    assert len(bench.client.futures) == 2
    assert bench.cluster._deaths == {}


def test_what_timed_out_or_died_there_is_what_the_work_makes_of_it() -> None:
    bench = Bench()
    found = bench.rounds(
        range(1), lambda: bench.watch.show(a=1), bench.end(0, Unfinished("its process died", 1.0, False))
    )
    assert found == ["0: its process died"]


def test_a_scheduler_that_is_gone_or_silent_ends_the_campaign() -> None:
    bench = Bench()
    with pytest.raises(EngineLost, match=r"^the scheduler tcp://there:1 is gone$"):
        bench.rounds(range(1), lambda: setattr(bench.client, "status", "connecting"))
    bench = Bench()
    silent = Seen(time.monotonic() - 2.0 * engine.SILENT_S, {})
    with pytest.raises(EngineLost):
        bench.rounds(range(1), lambda: setattr(bench.watch, "seen", silent))


def test_without_a_worker_it_ends_with_the_reason() -> None:
    refused = Seen(time.monotonic() + 60.0, {}, refused=2)
    bench = Bench()
    with pytest.raises(
        ClusterError, match="each has another installation than this one: give them this one, and"
    ):
        bench.rounds(range(1), lambda: setattr(bench.watch, "seen", refused))
    bench = Bench(expects=lambda: 3)  # a third one is to come
    bench.rounds(range(1), lambda: setattr(bench.watch, "seen", refused))
    bench = Bench(broken=lambda: "host1: no ssh")
    with pytest.raises(ClusterError, match="host1: no ssh"):
        bench.rounds(range(1), bench.watch.show)
    bench = Bench(patience_s=0.0)
    with pytest.raises(ClusterError, match="there is no worker at tcp://there:1"):
        bench.rounds(range(1), bench.watch.show, bench.watch.show)
    bench = Bench(patience_s=0.0)
    with pytest.raises(EngineLost):  # some runs are done: it is not that nothing could be
        bench.rounds(
            range(9), lambda: bench.watch.show(a=1), bench.end(0), bench.watch.show, bench.watch.show
        )


def test_the_scheduler_knows_how_many_runs_wait_though_there_is_no_worker() -> None:
    """An adaptive cluster, which begins without a worker, starts none for a client that submits nothing."""
    bench = Bench()
    bench.rounds(range(5), lambda: None, lambda: None)
    assert len(bench.client.demand) == 5
    bench.rounds(range(3), lambda: bench.watch.show(a=1), bench.end(0), bench.end(1), bench.end(2))
    assert all(future.released for future in bench.client.demand), "nothing waits any more"

    many = Bench()
    many.rounds(range(10 * DEMAND_MAX), lambda: None)
    assert len(many.client.demand) == DEMAND_MAX


def test_a_run_that_is_a_row_now_is_not_said_to_be_driven_again() -> None:
    bench = Bench()
    found = bench.rounds(
        range(2),
        lambda: bench.watch.show(a=1),
        lambda: bench.watch.show(b=1),
        lambda: bench.watch.show(c=1),
    )
    assert found == ["0: the workers that drove it died: a, b"]
    assert bench.told == ["the worker a is gone; 2 runs are driven again elsewhere", "the worker b is gone"]


def test_waiting_for_a_worker_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "WAITS_S", 0.05)
    bench = Bench(patience_s=600.0)
    bench.rounds(range(2), lambda: None, lambda: time.sleep(0.1), lambda: None, lambda: None)
    (text,) = bench.told
    assert text == "there is no worker at tcp://there:1 yet: waiting for one since 0 s, for 600 s at most"


def test_who_is_told_to_stop_before_there_is_a_connection_drives_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object) -> None:
        raise GivenUp

    monkeypatch.setattr(engine, "connected", refused)
    with Cluster("tcp://there:1", Numbers(), 9.0, files={}, say=print, go_on=lambda: False) as cluster:
        assert list(cluster.results(range(3), lambda: False)) == []


def test_certificates_that_cannot_be_used_are_one_line(tmp_path: Path) -> None:
    missing = str(tmp_path / "ca.pem")
    settings = {"ca-file": missing, "client.cert": missing, "client.key": missing}
    with (
        dask.config.set({f"distributed.comm.tls.{name}": value for name, value in settings.items()}),
        pytest.raises(ClusterError, match=rf"tls\.ca-file, {missing}: no such file or directory$"),
        Cluster("tls://127.0.0.1:1", Numbers(), 9.0, files={}, say=print),
    ):
        raise AssertionError


def test_what_dask_leaves_behind_is_not_shown_and_what_others_do_is(caplog: pytest.LogCaptureFixture) -> None:
    """Tasks that wait for futures of a worker that is lost, where one of them has failed already."""

    async def leave() -> None:
        for error in (AllExit(), KeyError("of others")):
            asyncio.get_running_loop().create_future().set_exception(error)  # nobody will ask
        gc.collect()

    with engine._silenced():
        pass
    asyncio.run(leave())
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [KeyError]
