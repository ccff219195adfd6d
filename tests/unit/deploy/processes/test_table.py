"""Which processes of a fleet run here: found with real ones that only have the command lines of robots."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.processes.running import PAUSED, RUNS, fleet_processes, process_state, state_of

FLEET = load_fleet(FLEETS / "pair.toml")
DEADLINE_S = 20.0


class Pretender:
    """A process that has the command line of a robot's, and waits for the end of its input."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", "print(flush=True); input()", *words],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def there(self) -> None:
        """Waits until it runs: while a program is being loaded the kernel shows no command line of it."""
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"\n"

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[dict[str, Pretender]]:
    file = str(tmp_path / "fleet.toml")
    started = {
        "1 agent": Pretender(tmp_path, "-m", "handfast.agent", "--fleet", file, "--robot", "1"),
        "2 plant, by another working directory": Pretender(
            tmp_path, "-m", "handfast.plant", "--fleet", "fleet.toml", "--robot", "2", "--exit-with-parent"
        ),
        "another fleet's": Pretender(tmp_path, "-m", "handfast.agent", "--fleet", f"{file}x", "--robot", "2"),
        "a stranger": Pretender(tmp_path, "-m", "handfast.agent", "--fleet", file, "--robot", "9"),
        "no number": Pretender(tmp_path, "-m", "handfast.agent", "--fleet", file, "--robot", "x"),
        "a recorder": Pretender(tmp_path, "-m", "handfast.agent.recorder", "--fleet", file, "--robot", "1"),
        "cut short": Pretender(tmp_path, "-m", "handfast.agent", "--robot", "1", "--fleet"),
    }
    for each in started.values():
        each.there()
    yield started
    for each in started.values():
        each.end()


def test_those_that_read_the_fleet_file(robots: dict[str, Pretender], tmp_path: Path) -> None:
    found = fleet_processes(FLEET, tmp_path / "fleet.toml")
    assert {process: state.pid for process, state in found.items()} == {
        (1, "agent"): robots["1 agent"].process.pid,
        (2, "plant"): robots["2 plant, by another working directory"].process.pid,
    }
    state = found[1, "agent"]
    assert state.state == RUNS
    assert 0.0 <= state.age_s < DEADLINE_S
    assert 0.0 <= state.cpu_s < DEADLINE_S
    assert 1e5 < state.memory_bytes < 1e9


def test_the_plants_that_share_a_process_are_each_there(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    words = (
        "-m",
        "handfast.plant",
        "--fleet",
        str(file),
        "--robot",
        "1",
        "--orders",
        "x",
        "--with=2",
        "--logs=/x",
    )
    pool = Pretender(tmp_path, *words)
    try:
        pool.there()
        found = fleet_processes(FLEET, file)
    finally:
        pool.end()
    assert {process: state.pid for process, state in found.items()} == {
        (1, "plant"): pool.process.pid, (2, "plant"): pool.process.pid,
    }  # fmt: skip


def test_one_that_is_paused_and_one_that_has_ended(robots: dict[str, Pretender], tmp_path: Path) -> None:
    process = robots["1 agent"].process
    process.send_signal(signal.SIGSTOP)
    deadline = time.monotonic() + DEADLINE_S
    while state_of(process.pid) != PAUSED and time.monotonic() < deadline:
        time.sleep(0.005)
    assert fleet_processes(FLEET, tmp_path / "fleet.toml")[1, "agent"].state == PAUSED
    process.kill()
    while (1, "agent") in fleet_processes(FLEET, tmp_path / "fleet.toml") and time.monotonic() < deadline:
        time.sleep(0.005)
    with pytest.raises(ValueError):
        process_state(process.pid)  # a zombie: nobody has asked for its status yet
    assert state_of(process.pid) == RUNS
