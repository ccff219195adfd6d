"""Campaigns on a Dask scheduler: a worker and the command are killed, and another version is refused."""

from __future__ import annotations

import csv
import os
import re
import signal
from pathlib import Path

import pytest

from tests.passing_law import PassingLaw
from tests.process.dask_processes import DaskProcesses, changed_copy
from tests.process.harness import Command, children, no_trouble, wait_for

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # Dask's own, of sockets of the dead
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


def test_a_sweep_outlives_a_worker_and_the_command_and_is_the_same_as_on_one_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "law_of_a_sweep")  # which the workers do not have
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    sweep = (
        "sweep", "pair", "--law", law.reference, "--over", "control.gone.gain=0.9,1", "--random-starts",
        "--over", "faults.delay=0..200ms", "--repeat", "5", "--duration", "30s", "--no-check",
    )  # fmt: skip
    with Command(tmp_path, *sweep, "--out", "local") as command:
        assert command.wait(STATUS_S) == 0, command.told()
    out = tmp_path / "out"
    with DaskProcesses(tmp_path / "dask") as dask:
        with Command(tmp_path, *sweep, "--out", "out", "--cluster", dask.address) as command:
            wait_for_rows(command, out, 1)
            os.kill(dask.worker_process(0), signal.SIGKILL)
            wait_for_rows(command, out, 1)
            os.killpg(command.process.pid, signal.SIGINT)
            assert command.wait() == 130, command.told()
        kept = re.search(
            r"^(\d+) of 10 runs are done and kept; go on with: handfast sweep out --cluster tcp://\S+$",
            command.err,
            re.MULTILINE,
        )
        assert kept, command.told()
        no_trouble(command.err, "the command")

        def driving() -> list[int]:
            """Processes of runs: below those of workers, which are below their nannies."""
            nannies = [pid for worker in dask.workers for pid in children(worker.pid)]
            return [pid for nanny in nannies for pid in children(nanny)]

        wait_for(lambda: not driving(), "no run is under way", STATUS_S, dask.told)
        before = rows(out)[1:]
        assert len(before) == int(kept[1])
        with Command(tmp_path, "sweep", "out", "--cluster", str(dask.file)) as command:
            assert command.wait(STATUS_S) == 0, command.told()
        no_trouble(command.err, "the command")
    assert all(row in rows(out) for row in before)
    assert_same_folder(out, tmp_path / "local")
    assert "crashed" not in (out / "results.csv").read_text()


@pytest.mark.long
def test_a_worker_with_other_sources_is_refused_in_one_line(tmp_path: Path) -> None:
    with DaskProcesses(tmp_path / "dask", 1) as dask:
        log = dask.add_worker(changed_copy(tmp_path / "changed"))
        wait_for(lambda: "Registered to" in log.read_text(), "the worker", STATUS_S, dask.told)
        with Command(tmp_path, "sweep", "pair", "--out", "out", "--cluster", dask.address) as command:
            assert command.wait(STATUS_S) == 2, command.told()
    assert re.search(
        r"^handfast: the worker tcp://\S+ has another installation: sources \w+ instead of \w+\. Install the "
        r"same there, and restart it$",
        command.err,
        re.MULTILINE,
    )
    no_trouble(command.err, "the command")
    assert len(rows(tmp_path / "out")) == 1
