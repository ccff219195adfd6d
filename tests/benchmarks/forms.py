"""What is compiled (`make compiled`) against the Python that it is made of, side by side in one run.

Both forms take turns, each measurement in a process of its own: a tick, hot and after a sleep; ticks of a run
as its agents measure them; the simulation's loop and the whole command; CPU of a robot against a bare Zenoh
program.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, Final

from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import BenchmarkError, NotHereError

ROOT: Final = Path(__file__).parents[2]
COMPILED: Final = ROOT / ".venv-compiled" / "bin" / "python"
TIMEOUT_S: Final = 900.0

Found = dict[str, float]

AIMS: Final[dict[str, tuple[str, float, float, bool]]] = {
    "tick_hot_us": ("tick in one process, hot, us", 110.0, 50.0, True),
    "tick_cold_us": ("tick in one process after a sleep, us", 0.0, 0.0, True),
    "tick_run_us": ("tick in a run, median, us", 300.0, 150.0, True),
    "loop_x": ("simulation loop, x real time", 0.0, 80.0, False),
    "whole_x": ("whole command, --no-report, x real time", 0.0, 50.0, False),
    "report_x": ("whole command with report, x real time", 0.0, 20.0, False),
    "lattice45_x": ("lattice45, whole, --no-report, x real time", 0.0, 5.0, False),
    "robot_s": ("loop: robot-seconds a second of a core", 0.0, 500.0, False),
    "cpu": ("CPU of a robot against bare Zenoh, our threads", 1.9, 1.5, True),
}
"""By the name of a number: what it is, the aims as Python and compiled (0: none), whether at most."""


def tick_in_process(quick: bool) -> Found:
    """A tick, hot and after a sleep."""
    from tests.benchmarks import tick

    duration_s = 5.0 if quick else 20.0
    return {
        "tick_hot_us": median(tick.probe(duration_s).ticks_us),
        "tick_cold_us": median(tick.probe(duration_s, sleep_s=tick.COLD_SLEEP_S).ticks_us),
    }


def tick_in_a_run(quick: bool) -> Found:
    """Ticks of `handfast run delta`, as its agents measure them."""
    from tests.benchmarks import tick

    return {"tick_run_us": tick.in_a_run(Options(quick)).figures[0].value}


def in_virtual_time(quick: bool) -> Found:
    """The simulation's loop, and the whole command."""
    from handfast.agent.fleet.loading import load_fleet
    from handfast.agent.formation.geometry import resolved
    from handfast.deploy.console.arguments import fleet_path
    from tests.benchmarks import virtual_time

    fleet, lattice = (resolved(load_fleet(fleet_path(name))) for name in ("delta", "lattice45"))
    lasts_s = fleet.fleet.duration_s
    took_s, cpu_s = virtual_time.loop(fleet)
    found = {"loop_x": lasts_s / took_s, "robot_s": len(fleet.robots) * lasts_s / cpu_s}
    found["whole_x"] = lasts_s / virtual_time.command("delta", "--no-report")
    found["report_x"] = lasts_s / virtual_time.command("delta")
    if not quick:
        whole_s = virtual_time.command("lattice45", "--no-report")
        found["lattice45_x"] = lattice.fleet.duration_s / whole_s
    return found


def cpu_of_a_robot(quick: bool) -> Found:
    """CPU of agent and plant against the bare program with the same threads."""
    from tests.benchmarks import cpu

    figures = cpu.run(Options(quick)).figures
    return {"cpu": next(each.value for each in figures if each.name.endswith("our Zenoh threads"))}


MEASURES: Final[dict[str, tuple[Callable[[bool], Found], int]]] = {
    "tick_in_process": (tick_in_process, 5),
    "tick_in_a_run": (tick_in_a_run, 2),
    "in_virtual_time": (in_virtual_time, 3),
    "cpu_of_a_robot": (cpu_of_a_robot, 1),
}
"""What is measured, and how often by each form in turn."""


def _in(python: str, name: str, quick: bool) -> Found:
    """What a measure gives in a process of that interpreter. Its own packages come before those here."""
    code = (
        f"import json, sys; sys.path.append({str(ROOT)!r}); from tests.benchmarks import forms; "
        f"found = forms.MEASURES[{name!r}][0]({quick}); print('found', json.dumps(found))"
    )
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        done = subprocess.run(
            [python, "-P", "-c", code], cwd=folder, capture_output=True, text=True, timeout=TIMEOUT_S
        )
    line = next((each for each in done.stdout.splitlines() if each.startswith("found ")), None)
    if done.returncode or line is None:
        raise BenchmarkError(f"{name}: {done.stderr.strip()[-500:]}")
    found: Found = json.loads(line.removeprefix("found "))
    return found


def run(options: Options) -> Result:
    if not COMPILED.exists():
        raise NotHereError("nothing is compiled here: make compiled")
    forms = {"as Python": sys.executable, "compiled": str(COMPILED)}
    seen: dict[str, dict[str, list[float]]] = {form: {} for form in forms}
    for name, (_, rounds) in MEASURES.items():
        for _ in range(1 if options.quick else rounds):
            for form, python in forms.items():
                for what, value in _in(python, name, options.quick).items():
                    seen[form].setdefault(what, []).append(value)
    result = Result()
    for what, (words, *aims, at_most) in AIMS.items():
        medians: list[float] = []
        for form, aim in zip(forms, aims, strict=True):
            values: list[Any] = seen[form].get(what, [])
            if values:
                medians.append(median(values))
                result.figures.append(
                    Figure(f"{words}: {form}", medians[-1], "", aim or None, at_most, spread(values))
                )
        if len(medians) == 2:
            result.figures.append(Figure(f"{words}: compiled / Python", medians[1] / medians[0]))
    return result
