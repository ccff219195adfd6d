"""`handfast simulate` against real time: delta, its loop alone and the whole command, and large lattices,
which nobody can have as processes: what a second of a robot takes should not grow with the fleet."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from agent.fleet.loading import load_fleet
from agent.formation.geometry import resolved
from deploy.analysis.lattice import lattice
from deploy.console.arguments import fleet_path
from deploy.simulate.simulation import Simulation
from tests.benchmarks.figures import Figure, Options, Result, number, spread
from tests.benchmarks.processes import BenchmarkError, environment, handfast

TARGET: Final = 20.0
LATTICES: Final = ((25, 10.0), (100, 10.0), (500, 10.0))
LATTICES_QUICK: Final = ((25, 5.0), (100, 5.0))
"""Robots, and for how long they drive, s."""


class Large(NamedTuple):
    """What `handfast simulate` of a lattice took, s; its memory at most, MB; whether it passed."""

    robots: int
    took_s: float
    cpu_s: float
    memory_mb: float
    passed: bool


def large(robots: int, duration_s: float) -> Large:
    """One lattice of so many robots in virtual time, with all that the command makes but figures."""
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        file = Path(name) / f"lattice{robots}.toml"
        file.write_text(lattice(f"lattice{robots}", robots, duration_s=duration_s), encoding="utf-8")
        words = ("simulate", str(file), "--quiet", "--no-report", "--out", str(Path(name) / "run"))
        begun = time.perf_counter()
        process = subprocess.Popen(
            handfast(*words), env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        assert process.stderr is not None
        told = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        if code not in (0, 1):
            raise BenchmarkError(f"handfast simulate: {told.decode(errors='replace')[-500:]}")
        took_s = time.perf_counter() - begun
        return Large(robots, took_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0, code == 0)


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
    lattices = LATTICES_QUICK if options.quick else LATTICES
    sizes = [(large(robots, duration_s), duration_s) for robots, duration_s in lattices]
    per_robot = [1000.0 * each.cpu_s / each.robots / duration_s for each, duration_s in sizes]
    for (each, duration_s), cost in zip(sizes, per_robot, strict=True):
        result.figures.append(
            Figure(
                f"lattice of {each.robots} at 10 Hz for {duration_s:g} s, --no-report",
                each.took_s,
                "s",
                note=f"{number(cost)} ms of CPU for a second of a robot, {each.memory_mb:.0f} MB, "
                f"{'passed' if each.passed else 'FAILED'}",
            )
        )
    small, big = sizes[0][0].robots, sizes[-1][0].robots
    name = f"CPU for a second of a robot, lattice of {big} / {small}"
    result.figures.append(Figure(name, per_robot[-1] / per_robot[0]))
    return result
