"""`handfast sweep` from outside: its processes, its folder, and every way in which it can be cut short."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
from pathlib import Path

import pytest

from tests.passing_law import PassingLaw
from tests.process.harness import Command, children, wait_for

QUICK = ("--duration", "1s", "--over", "control.kp=0,1", "--over", "control.c2=0.3,0.6,1.2", "--no-check")
ENDLESS = "1e6"
"""Fleet time (s) of a run that no machine gets through during a test."""
BUSY_S = 3.0
"""Processor time of a worker that has long started and driven a second of fleet time."""


def table(folder: Path) -> list[dict[str, str]]:
    """The rows of a sweep without the time that they took, by run."""
    rows = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    for row in rows:
        assert float(row.pop("wall_s")) >= 0.0
    return sorted(rows, key=lambda row: int(row["run"]))


def sweep(folder: Path, *arguments: str, status: int = 0) -> Command:
    """One sweep from start to end."""
    with Command(folder, "sweep", *arguments) as command:
        assert command.wait(100.0) == status, command.told()
    return command


def workers(command: Command) -> list[int]:
    """pids of the processes that drive."""
    return [pid for pid, text in children(command.process.pid).items() if "spawn_main" in text]


def wait_for_rows(command: Command, folder: Path, count: int) -> None:
    """Waits until `count` runs are kept and the sweep goes on."""

    def look() -> bool:
        assert command.process.poll() is None, command.told()
        results = folder / "results.csv"
        return results.exists() and results.read_bytes().count(b"\n") > count

    wait_for(look, f"{count} rows", 60.0, command.told)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Command]:
    """A sweep that nothing disturbs, with two workers."""
    folder = tmp_path_factory.mktemp("whole")
    command = sweep(
        folder, "delta", *QUICK, "--repeat", "2", "--random-starts", "--jobs", "2", "--out", "out"
    )
    return folder / "out", command


def test_a_sweep_leaves_rows_summaries_and_pictures(whole: tuple[Path, Command]) -> None:
    folder, command = whole
    rows = table(folder)
    assert [row["run"] for row in rows] == [str(run) for run in range(12)]
    assert [(row["control.kp"], row["control.c2"], row["repeat"]) for row in rows[5:8]] == [
        ("0", "1.2", "1"),
        ("1", "0.3", "0"),
        ("1", "0.3", "1"),
    ]
    assert all(row["verdict"] == "failed" and "not settled" in row["reason"] for row in rows), rows
    for name in ("settling_time", "least_distance", "rms_error", "share_safe"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    summary = json.loads((folder / "summary.json").read_text())
    assert [cell["safe"]["count"] for cell in summary["cells"]] == [2] * 6
    assert [margin["failed"] for margin in summary["margins"]] == ["0"] * 3
    assert len(list(csv.reader((folder / "summary.csv").read_text().splitlines()))) == 7
    assert re.search(r"^12 runs \(6 cells, 2 of each\), 2 at a time, into out$", command.err, re.MULTILINE)
    assert re.search(
        r"^12 of 12 runs, \d+\.\d\d a second, 0:00:00 left, 12 unsafe or not settled$",
        command.err,
        re.MULTILINE,
    )
    assert "margin of control.kp with control.c2=0.3: none, not even 0" in command.out
    assert command.out.endswith("\nout\n")


@pytest.mark.long
def test_one_worker_finds_the_same(whole: tuple[Path, Command], tmp_path: Path) -> None:
    sweep(tmp_path, "delta", *QUICK, "--repeat", "2", "--random-starts", "--jobs", "1", "--out", "out")
    assert table(tmp_path / "out") == table(whole[0])
    for name in ("summary.csv", "summary.json", "share_safe.png", "sweep.toml", "fleet.toml"):
        assert (tmp_path / "out" / name).read_bytes() == (whole[0] / name).read_bytes()


@pytest.mark.long
def test_a_complete_folder_is_only_summed_up_again(whole: tuple[Path, Command]) -> None:
    folder, _ = whole
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name in ("summary.csv", "summary.json", "share_safe.png"):
        (folder / name).unlink()
    command = sweep(folder.parent, str(folder))
    assert "runs" not in command.err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.long
def test_one_run_can_be_driven_by_itself(whole: tuple[Path, Command], tmp_path: Path) -> None:
    folder, _ = whole
    sweep(tmp_path, str(folder), "--write", "7")
    with Command(
        tmp_path, "simulate", str(folder / "run-7.toml"), "--no-report", "--no-check", "--out", "run"
    ) as run:
        assert run.wait() == 1  # in 1 s nothing settles
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    (row,) = (row for row in table(folder) if row["run"] == "7")
    assert float(row["rms_distance_error_m"]) == metrics["rms_distance_error_m"]
    assert float(row["min_distance_m.any"]) == metrics["min_distance_m"]["any"]
    (folder / "run-7.toml").unlink()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_was_cut_short_goes_on(
    whole: tuple[Path, Command], tmp_path: Path, number: signal.Signals
) -> None:
    """Every row that was kept stays as it is, whatever ended the sweep; in the end all are the same."""
    arguments = ("delta", *QUICK, "--repeat", "2", "--random-starts", "--out", "out")
    with Command(tmp_path, "sweep", *arguments) as command:
        wait_for_rows(command, tmp_path / "out", 2)
        if number != signal.SIGKILL:  # as a terminal, a shell's `kill %1` and a unit do: to every process
            os.killpg(command.process.pid, number)
            assert command.wait() == 130
            assert re.search(
                r"^\d+ of 12 runs are done and kept; go on with: handfast sweep out$",
                command.err,
                re.MULTILINE,
            )
        else:
            left = workers(command)
            command.process.kill()
            command.process.wait()
            command.wait_until_gone(left)
    kept = (tmp_path / "out" / "results.csv").read_bytes()
    assert 2 <= kept.count(b"\n") - 1 <= 12
    command = sweep(tmp_path, *arguments)
    assert set(kept[: kept.rfind(b"\n")].split(b"\n")) <= set(
        (tmp_path / "out" / "results.csv").read_bytes().split(b"\n")
    )
    assert table(tmp_path / "out") == table(whole[0])


def worker_at_work(command: Command) -> int:
    """pid of a worker that has computed for longer than a start takes: it is at a run."""

    def look() -> int | None:
        assert command.process.poll() is None, command.told()
        for pid in workers(command):
            user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
            if (int(user) + int(system)) / os.sysconf("SC_CLK_TCK") > BUSY_S:
                return pid
        return None

    pid = wait_for(look, "a worker at work", 60.0, command.told)
    assert pid is not None
    return pid


@pytest.mark.long
def test_a_run_that_does_not_end_and_one_that_dies_are_rows(tmp_path: Path) -> None:
    """Each costs its own run and no other, one that dies when it has twice; and no worker goes on when the
    sweep itself is gone."""
    arguments = ("pair", "--over", f"fleet.duration_s=1,{ENDLESS}", "--no-check", "--out", "out")
    with Command(tmp_path / "killed", "sweep", *arguments, "--jobs", "1") as command:
        for _ in range(2):
            os.kill(pid := worker_at_work(command), signal.SIGKILL)
            command.wait_until_gone([pid])
        assert command.wait() == 0, command.told()
    first, second = table(tmp_path / "killed" / "out")
    assert (first["verdict"], second["verdict"], second["safe"], second["settled"]) == (
        "failed",
        "crashed",
        "",
        "",
    )
    assert second["reason"] == "its process was killed by SIGKILL"
    assert "1 of 2 runs were not finished; run 1: its process was killed by SIGKILL" in command.out

    with Command(tmp_path / "orphan", "sweep", *arguments) as command:
        worker_at_work(command)
        left = workers(command)
        command.process.kill()
        command.process.wait()
        command.wait_until_gone(left)

    command = sweep(tmp_path / "late", *arguments, "--timeout", "3s")
    first, second = table(tmp_path / "late" / "out")
    assert (first["verdict"], second["verdict"]) == ("failed", "timed out")
    assert second["reason"] == "not done within 3 s (--timeout)"


@pytest.mark.long
def test_rows_are_of_the_files_that_the_sweep_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that takes the place of another finds files that have been edited: it drives nothing."""
    law = PassingLaw(tmp_path, monkeypatch, "law_that_changes")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    arguments = ("pair", "--law", law.reference, "--over", f"fleet.duration_s=1,{ENDLESS}", "--no-check")
    file = tmp_path / "law_that_changes.py"
    written = file.read_text()
    with Command(tmp_path / "in", "sweep", *arguments, "--jobs", "1", "--out", "out") as command:
        wait_for_rows(command, tmp_path / "in" / "out", 1)
        file.write_text(written + "\n")
        os.kill(worker_at_work(command), signal.SIGKILL)
        assert command.wait(60.0) == 2, command.told()
        assert re.search(
            r"^handfast: the program is not the one .* began with: sources \w+ instead of \w+$",
            command.err,
            re.MULTILINE,
        )
    assert len(table(tmp_path / "in" / "out")) == 1
    again = sweep(tmp_path / "in", "out", status=2)
    assert "the 1 of 2 runs that are done were driven by other Python files" in again.err
    file.write_text(written)
    sweep(tmp_path / "in", "out", "--timeout", "3s")
    assert [row["verdict"] for row in table(tmp_path / "in" / "out")] == ["failed", "timed out"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("delta", "--over", "control.kp=1,x"), "--over control.kp=x: must be a number"),
        (("delta", "--over", "control.kp=1", "--jobs", "0"), "--jobs must be at least 1, got 0"),
        (
            ("delta", "--over", "formation.distance_m=1,2"),
            "(formation.distance_m=2)\nhandfast: delta: not started because of the errors above",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_message(tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    command = sweep(tmp_path / "in", *arguments, status=2)
    assert says in command.err
    assert {path.name for path in (tmp_path / "in").iterdir()} == {"stdout", "stderr"}
