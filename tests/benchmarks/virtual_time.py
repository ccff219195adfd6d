"""`handfast simulate` against real time: delta, its loop alone and the whole command, and large lattices,
which nobody can have as processes: what a second of a robot takes should not grow with the fleet.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.simulate.simulation import Simulation
from tests.benchmarks.figures import Figure, Options, Result, number, spread
from tests.benchmarks.processes import BenchmarkError, environment, handfast, pss_mb

LOOP: Final = 80.0
"""Times real time, of the delta's loop alone."""
WHOLE: Final = 50.0
"""Of the command without a report."""
REPORTED: Final = 20.0
LATTICE45: Final = 5.0
ROBOT_S: Final = 500.0
"""Seconds of a robot that a core simulates in a second."""
FAULTS: Final = ("faults.delay=0.7s", "faults.loss=25%")
"""The middle of what robustness is studied over: ways are looked for, and predictions reach far."""
AS_INSTALLED: Final = {"PYTHONDONTWRITEBYTECODE": ""}
"""Of a command: what it imports is compiled once, not each time anew, whatever runs the benchmarks."""
GROWTH_MB: Final = 0.1
"""Of a process with each run that it drives: a sweep's workers drive thousands."""
GROWTH_FIRST: Final = 4
GROWTH_RUNS: Final = 16
"""So many runs, of which the first still load modules and fill what is kept."""
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
            handfast(*words), env=environment(AS_INSTALLED), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        assert process.stderr is not None
        told = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        if code not in (0, 1):
            raise BenchmarkError(f"handfast simulate: {told.decode(errors='replace')[-500:]}")
        took_s = time.perf_counter() - begun
        return Large(robots, took_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0, code == 0)


def command(fleet: str, *arguments: str) -> float:
    """`handfast simulate`, whole, s."""
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        words = ("simulate", fleet, "--quiet", "--out", str(Path(folder) / "run"), *arguments)
        begun = time.perf_counter()
        done = subprocess.run(
            handfast(*words), env=environment(AS_INSTALLED), capture_output=True, check=False
        )
        took_s = time.perf_counter() - begun
    if done.returncode not in (0, 1):  # 1: it ran, and its verdict failed
        raise BenchmarkError(f"handfast simulate: {done.stderr.decode(errors='replace')[-500:]}")
    return took_s


def loop(fleet: Fleet) -> tuple[float, float]:
    """The simulation alone, of which nothing is recorded, s; and what it takes of a processor, s."""
    begun, cpu = time.perf_counter(), time.process_time()
    Simulation(fleet).run()
    return time.perf_counter() - begun, time.process_time() - cpu


def growth() -> Figure:
    """By how much this process grows with each of many short runs."""
    fleet = resolved(load_fleet(fleet_path("delta"), ["fleet.duration_s=4"]))
    sizes = []
    for _ in range(GROWTH_FIRST + GROWTH_RUNS):
        loop(fleet)
        sizes.append(pss_mb(os.getpid()))
    more_mb = (sizes[-1] - sizes[GROWTH_FIRST - 1]) / GROWTH_RUNS
    return Figure("a process grows with each run of 4 s by", more_mb, "MB", GROWTH_MB)


def delta(repetitions: int) -> list[Figure]:
    """The delta: loop, the same with links that fail, command without and with a report, one after the other
    in each repetition."""
    fleet, faulty = (resolved(load_fleet(fleet_path("delta"), given)) for given in ((), FAULTS))
    duration_s = fleet.fleet.duration_s
    loops, failing, bare, reported = [], [], [], []
    for _ in range(repetitions):
        loops.append(loop(fleet))
        failing.append(loop(faulty))
        bare.append(command("delta", "--no-report"))
        reported.append(command("delta"))
    alone = [took for took, _ in loops]
    found = [
        Figure(name, duration_s / median(took), "x real time", limit, at_most=False, note=f"{spread(took)} s")
        for name, limit, took in (
            ("simulation loop, nothing recorded", LOOP, alone),
            ("whole command, --no-report", WHOLE, bare),
            ("whole command with report", REPORTED, reported),
        )
    ]
    for name, took in (("--no-report", bare), ("with report", reported)):
        ratios = [whole / one for whole, one in zip(took, alone, strict=True)]
        found.append(Figure(f"whole command, {name} / loop", median(ratios), note=spread(ratios)))
    ratios = [with_faults / without for (_, with_faults), (_, without) in zip(failing, loops, strict=True)]
    name = f"CPU of the loop, {' and '.join(FAULTS)} / without"
    found.append(Figure(name, median(ratios), note=spread(ratios)))
    cpu_s = min(cpu for _, cpu in loops)
    ours = len(fleet.robots) * duration_s / cpu_s
    found.append(
        Figure("loop: robot-seconds a second of a core", ours, "", ROBOT_S, at_most=False, note="the best")
    )
    return found


def run(options: Options) -> Result:
    result = Result(delta(3 if options.quick else 7))
    result.figures.append(growth())
    fleet = load_fleet(fleet_path("lattice45"))
    duration_s = 10.0 if options.quick else fleet.fleet.duration_s
    took_s = command("lattice45", "--no-report", "--duration", str(duration_s))
    result.figures.append(
        Figure(
            f"lattice45 for {duration_s:g} s, --no-report",
            duration_s / took_s,
            "x real time",
            LATTICE45,
            at_most=False,
            note=f"{number(took_s)} s",
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
