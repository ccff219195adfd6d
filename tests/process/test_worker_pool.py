"""A pool of worker processes: what becomes of runs whose process dies, and of what runs have started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from handfast.deploy.console.data_files import ROOT
from tests.process.dying_work import DIES, DIES_ONCE, FORKS, HANGS, STARTS
from tests.process.harness import running, wait_for

pytestmark = pytest.mark.long

RUNS = (0, DIES_ONCE, DIES, STARTS, FORKS, 6, 7)


def command(folder: Path, jobs: int, *runs: int) -> list[str]:
    return [sys.executable, "-m", "tests.process.dying_work", str(folder), str(jobs), *map(str, runs)]


def wait_until_gone(folder: Path, *runs: int) -> None:
    """Waits for the end of what these runs have started."""
    started = [int((folder / f"started-{run}").read_text()) for run in runs]
    wait_for(lambda: not any(map(running, started)), "the end of all that runs have started", 10.0, str)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_run_is_given_up_when_its_process_has_died_twice_and_leaves_nothing(
    tmp_path: Path, jobs: int
) -> None:
    ended = subprocess.run(
        command(tmp_path, jobs, *RUNS), cwd=ROOT, capture_output=True, text=True, timeout=100.0
    )
    assert ended.stderr == ""
    assert (tmp_path / f"died-{DIES_ONCE}").exists()
    done = [f"done {number}" for number in RUNS if number != DIES]
    assert ended.stdout.splitlines() == [f"crashed {DIES}: its process ended with exit status 7", *done]
    wait_until_gone(tmp_path, STARTS, FORKS)


@pytest.mark.parametrize("last", [HANGS, STARTS])
def test_what_runs_have_started_ends_when_the_pool_is_killed(tmp_path: Path, last: int) -> None:
    runs = (FORKS, STARTS, HANGS) if last == HANGS else (FORKS, STARTS)
    with subprocess.Popen(
        command(tmp_path, 1, *runs), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as pool:
        wait_for((tmp_path / f"started-{last}").exists, "the last run", 60.0, str)
        pool.kill()
    wait_until_gone(tmp_path, *runs)
