"""What is known here of the processes of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.hosts import status
from handfast.deploy.hosts.status import logs_of, process_row, run_words
from handfast.deploy.inventory.known_fleets import KnownFleet
from handfast.deploy.inventory.registry import Running
from handfast.deploy.processes.running import PAUSED, RUNS, ProcessState

FILE = FLEETS / "pair.toml"
FLEET = load_fleet(FILE)
RUN = Running("pair", 4711, "/runs/pair", "/runs/pair/fleet.toml", "2026-11-20T10:00:00")
DRIVE = Running("pair", 4712, "/runs/drive", "/runs/drive/robots.toml", "2026-11-20T10:00:05", attached=True)


def test_a_row_of_each_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robot-1-agent.log").write_text("robot 1 agent: running\n")
    (tmp_path / "robot-2-agent.log").write_text("robot 2 agent: ending (SIGTERM)\n")
    monkeypatch.setattr(
        status,
        "fleet_processes",
        lambda *_: {(1, "agent"): ProcessState(7, RUNS, 20.0, 1.0, 50_000_000)},
    )
    here = status.this_machine(FLEET, FILE, tmp_path)
    row = process_row(FLEET, 1, "agent", here, None, 0.0)
    assert (row["unit"], row["host"], row["cpu_percent"], row["memory_mb"]) == ("active", None, 5.0, 50.0)
    assert (row["up_s"], row["says"], row["restarts"]) == (20.0, "running", None)
    gone = process_row(FLEET, 2, "agent", here, None, 0.0)
    assert (gone["unit"], gone["says"], gone["up_s"]) == ("none", "ending (SIGTERM)", None)
    elsewhere = status.this_machine(FLEET, FILE, None)
    assert process_row(FLEET, 2, "plant", elsewhere, None, 0.0)["says"] is None


def test_logs_are_those_of_the_run_that_has_started_the_processes() -> None:
    assert logs_of(KnownFleet("pair", FILE, (DRIVE, RUN))) == Path("/runs/pair/logs")
    assert logs_of(KnownFleet("pair", FILE, (DRIVE,))) is None


def test_a_run_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "state_of", {4711: RUNS, 4712: PAUSED}.__getitem__)
    assert run_words(RUN) == "run by process 4711 since 10:00:00: /runs/pair"
    assert run_words(DRIVE) == (
        "driven by process 4712 since 10:00:05, PAUSED: `fg` there or `kill -CONT 4712` lets it go on: "
        "/runs/drive"
    )
