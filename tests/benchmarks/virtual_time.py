"""`handfast simulate delta` against real time: the loop alone, and the whole command."""

from __future__ import annotations

import subprocess
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Final

from agent.fleet.loading import load_fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path
from deploy.simulate.simulation import Simulation
from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import BenchmarkError, environment, handfast

TARGET: Final = 20.0


def run(options: Options) -> Result:
    fleet = resolved(load_fleet(fleet_path("delta")))
    duration_s = fleet.fleet.duration_s
    repetitions = 3 if options.quick else 7

    def loop() -> None:
        Simulation(fleet).run()

    def command(*arguments: str) -> None:
        with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
            out = str(Path(folder) / "run")
            done = subprocess.run(
                handfast("simulate", "delta", "--quiet", "--out", out, *arguments),
                env=environment(),
                capture_output=True,
                check=False,
            )
        if done.returncode not in (0, 1):  # 1: it ran, and its verdict failed
            raise BenchmarkError(f"handfast simulate: {done.stderr.decode(errors='replace')[-500:]}")

    result = Result()
    for name, limit, what in (
        ("simulation loop, nothing recorded", None, loop),
        ("whole command, --no-report", TARGET, lambda: command("--no-report")),
        ("whole command with report", TARGET, command),
    ):
        took = []
        for _ in range(repetitions):
            begun = time.perf_counter()
            what()
            took.append(time.perf_counter() - begun)
        result.figures.append(
            Figure(
                name, duration_s / median(took), "x real time", limit, at_most=False, note=f"{spread(took)} s"
            )
        )
    return result
