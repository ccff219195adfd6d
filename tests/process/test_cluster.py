"""Campaigns on a Dask scheduler with real workers, and the death of each who has a part in one."""

from __future__ import annotations

import csv
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.deploy.cluster import connection
from handfast.deploy.cluster.connection import ClusterError
from handfast.deploy.cluster.engine import Cluster
from tests.passing_law import PassingLaw
from tests.process.dask_processes import DaskProcesses, changed_copy
from tests.process.harness import Command, children, no_trouble, wait_for
from tests.process.killing_work import HANGS, KILLS, KillingWork

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # Dask's own, of sockets of the dead
SWEEP = ("pair", "--duration", "3s", "--over", "control.kp=0.5,1", "--over", "faults.delay=0..200ms")
REPEAT = ("--repeat", "5", "--random-starts", "--duration", "30s")
"""Each run so long that a loss is seen before the others are driven."""
STATUS_S = 100.0


def rows(folder: Path) -> list[list[str]]:
    """The table of a sweep without the last column, the time that runs took."""
    found = list(csv.reader((folder / "results.csv").read_text().splitlines()))
    assert found[0][-1] == "wall_s"
    return [row[:-1] for row in found]


def assert_same_folder(one: Path, other: Path) -> None:
    assert {path.name for path in one.iterdir()} == {path.name for path in other.iterdir()}
    for path in one.iterdir():
        if path.name != "results.csv":
            assert path.read_bytes() == (other / path.name).read_bytes(), path.name
    assert rows(one) == rows(other)


def wait_for_rows(command: Command, folder: Path, more: int) -> None:
    """Waits until so many more rows are kept."""
    results = folder / "results.csv"
    before = results.read_bytes().count(b"\n") if results.exists() else 1

    def look() -> bool:
        assert command.process.poll() is None, command.told()
        return results.exists() and results.read_bytes().count(b"\n") >= before + more

    wait_for(look, f"{more} rows", STATUS_S, command.told)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the sweep leaves without a cluster."""
    folder = tmp_path_factory.mktemp("local")
    with Command(folder, "sweep", *SWEEP, *REPEAT, "--out", "out") as command:
        assert command.wait(STATUS_S) == 0, command.told()
    assert "10 runs, 0 unsafe: with 95 % confidence at most 25.9 % of such runs are unsafe" in command.out
    return folder / "out"


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskProcesses]:
    """Processes of which none dies."""
    with DaskProcesses(tmp_path_factory.mktemp("dask")) as processes:
        yield processes


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[DaskProcesses]:
    """Processes that a test may kill."""
    with DaskProcesses(tmp_path / "dask") as processes:
        yield processes


@pytest.mark.long
def test_a_worker_the_command_and_the_scheduler_are_lost_and_the_folder_is_the_same(
    local: Path, dask: DaskProcesses, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ("sweep", *SWEEP, *REPEAT, "--out", "out", "--cluster")
    with Command(tmp_path, *arguments, dask.address) as command:
        wait_for_rows(command, out, 2)
        os.kill(dask.worker_process(0), signal.SIGKILL)
        gone = re.compile(r"^the worker tcp://\S+ is gone; \d runs? (is|are) driven again", re.MULTILINE)
        wait_for(lambda: gone.search(command.err), "its loss", STATUS_S, command.told)
        wait_for_rows(command, out, 1)
        command.process.kill()
        command.process.wait()

    with Command(tmp_path, "sweep", "out", "--cluster", dask.address) as command:
        wait_for_rows(command, out, 2)
        assert dask.scheduler is not None
        dask.scheduler.kill()
        dask.scheduler.wait()
        assert command.wait(STATUS_S) == 1, command.told()
    assert re.search(
        r"^the scheduler tcp://\S+ is gone: \d+ of 10 runs are done and kept; go on with: "
        r"handfast sweep out --cluster tcp://\S+$",
        command.err,
        re.MULTILINE,
    )
    no_trouble(command.err, "the command")
    for worker in dask.workers:  # without a scheduler, they end, and what they drive with them
        worker.wait(STATUS_S)
    dask.workers.clear()

    dask.start()
    with Command(tmp_path, *arguments, str(dask.file)) as command:  # which names the scheduler too
        assert command.wait(STATUS_S) == 0, command.told()
    no_trouble(command.err, "the command")
    assert_same_folder(out, local)


@pytest.mark.long
def test_after_ctrl_c_nothing_is_driven_any_more(lasting: DaskProcesses, tmp_path: Path) -> None:
    with Command(
        tmp_path, "sweep", *SWEEP, "--repeat", "500", "--out", "out", "--cluster", lasting.address
    ) as (command):
        wait_for_rows(command, tmp_path / "out", 1)
        os.killpg(command.process.pid, signal.SIGINT)
        assert command.wait() == 130, command.told()
    assert re.search(r"^\d+ of 1000 runs are done and kept; go on with", command.err, re.MULTILINE)
    no_trouble(command.err, "the command")

    def driving() -> list[int]:
        """Processes of runs: below those of workers, which are below their nannies."""
        nannies = [pid for worker in lasting.workers for pid in children(worker.pid)]
        return [pid for nanny in nannies for pid in children(nanny)]

    wait_for(lambda: not driving(), "no run is under way", STATUS_S, lasting.told)


def test_a_law_of_others_goes_along(
    lasting: DaskProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "law_of_a_sweep")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    arguments = ("pair", "--law", law.reference, "--duration", "1s", "--over", "control.gone.gain=1,2")
    with Command(tmp_path, "sweep", *arguments, "--no-check", "--out", "local") as command:
        assert command.wait(STATUS_S) == 0, command.told()
    with Command(
        tmp_path, "sweep", *arguments, "--no-check", "--out", "out", "--cluster", lasting.address
    ) as command:
        assert command.wait(STATUS_S) == 0, command.told()
    assert_same_folder(tmp_path / "out", tmp_path / "local")
    assert "crashed" not in (tmp_path / "out" / "results.csv").read_text()


@pytest.mark.long
def test_a_run_that_kills_its_worker_twice_and_one_that_hangs_are_results(dask: DaskProcesses) -> None:
    told: list[str] = []
    with Cluster(dask.address, KillingWork(), 2.0, files={}, say=told.append) as cluster:
        found = set(cluster.results(range(6), lambda: True))
    assert {f"done {number}" for number in range(6) if number not in (KILLS, HANGS)} <= found, found
    assert f"timed out {HANGS}: not done within 2 s (--timeout)" in found
    (crashed,) = (text for text in found if text.startswith(f"crashed {KILLS}"))
    assert re.fullmatch(r"crashed 0: the workers that drove it died: tcp://\S+, tcp://\S+", crashed)
    assert len(found) == 6
    assert sum("is gone" in text for text in told) == 2, told


@pytest.mark.long
def test_a_worker_with_other_sources_is_given_nothing(tmp_path: Path) -> None:
    with DaskProcesses(tmp_path / "dask", 0) as other:
        other.add_worker(changed_copy(tmp_path / "changed"), "--name", "other")
        told: list[str] = []
        with (
            Cluster(other.address, KillingWork(), 9.0, files={}, say=told.append) as cluster,
            pytest.raises(ClusterError, match="each has another installation than this one"),
        ):
            list(cluster.results([2], lambda: True))
        (text,) = told
        assert re.fullmatch(
            r"the worker tcp://\S+ \(other\) is given nothing: its sources of handfast are others "
            r"\(\w+, here \w+\): install the same there and start it again",
            text,
        )
        other.add_worker()
        with Cluster(other.address, KillingWork(), 9.0, files={}, say=told.append) as cluster:
            wait_for(lambda: cluster._watch.usable(), "the good worker", STATUS_S, other.told)
            assert list(cluster.results([2], lambda: True)) == ["done 2"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("127.0.0.1:8786", "--cluster 127.0.0.1:8786: must be tcp://HOST:PORT"),
        ("tls://127.0.0.1:1", "tls://127.0.0.1:1 needs certificates: name them in Dask's configuration"),
        ("ssh:delta", "--cluster ssh:delta: the fleet has no hosts"),
    ],
)
def test_what_is_no_cluster_is_one_line(tmp_path: Path, where: str, says: str) -> None:
    with Command(tmp_path, "sweep", *SWEEP, "--out", "out", "--cluster", where) as command:
        assert command.wait(STATUS_S) == 2, command.told()
    assert f"handfast: {says}" in command.err
    no_trouble(command.err, "the command")


@pytest.mark.long
def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "CONNECT_S", 0.3)
    with (
        pytest.raises(ClusterError, match=r"^there is no scheduler at tcp://127\.0\.0\.1:1: [^\n]+$"),
        Cluster("tcp://127.0.0.1:1", KillingWork(), 9.0, files={}, say=print),
    ):
        pass
