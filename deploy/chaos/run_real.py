"""Scenarios driven by real processes on this machine, in real time, one after the other."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.chaos.draw import draw
from deploy.chaos.profiles.pieces import name_of
from deploy.chaos.report import Driven
from deploy.chaos.run import Outcome, judged, scenario_text
from deploy.console.interrupt import Interrupt
from deploy.drive.display.live_view import make_view
from deploy.drive.local import LocalRun
from deploy.processes.placement import place
from deploy.recording.mcap_reader import read_run
from deploy.report.run_folder import RunFolder
from deploy.verdict.run_result import RunResult

ROUTERS: Final = ('network.routers=["127.0.0.1:7447", "127.0.0.1:7448"]',)
"""The override that has robots linked to two routers, wherever `deploy.processes.placement` puts them."""


def real_results(
    seeds: Sequence[int], out: Path, interrupt: Interrupt, *, routed: bool = False
) -> Iterator[Driven]:
    """What came of the scenarios of `seeds`, until all are done or somebody says stop.

    The run of one that fails is kept below `out`, as `handfast run` leaves it but without a report.

    Args:
        routed: whether robots are linked to routers instead of to each other.

    Raises:
        deploy.processes.ports.NoPortsError, deploy.report.run_folder.FolderError,
        deploy.recording.recorder.RecordingError, agent.transport.bus.BusError: as
        `deploy.drive.local.LocalRun` and what it needs do.
    """
    for seed in seeds:
        tables = draw(seed)
        folder = out / f"{name_of(seed)}-run"
        shutil.rmtree(folder, ignore_errors=True)
        outcome = _drive(scenario_text(tables), ROUTERS if routed else (), folder, interrupt)
        if interrupt.count:
            return
        if not outcome.violations:
            shutil.rmtree(folder, ignore_errors=True)
        yield Driven(seed, tables, outcome)


def _drive(text: str, overrides: Sequence[str], folder: Path, interrupt: Interrupt) -> Outcome:
    begun_s = time.perf_counter()
    placed = place(resolved(parse_fleet(text, source=str(folder), overrides=overrides)))
    try:
        kept = RunFolder(folder, placed.fleet, "run")
        run = LocalRun(placed.fleet, kept, make_view(quiet=True), interrupt, placed.vehicles)
        try:
            run.run()
        finally:
            kept.close(run.reasons, interrupted=interrupt.count > 0)
    finally:
        placed.ports.close()
    outcome = judged(RunResult(read_run(folder)))
    return replace(outcome, wall_s=time.perf_counter() - begun_s)
