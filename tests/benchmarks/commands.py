"""What operators' commands do to a large fleet that drives: is a stop taken soon, and does the fleet keep its
rate while it is stopped, resumed, reshaped, left, and has a link made worse. What all tell all hear. How busy
the fleet had the machine before that says how much room there was: the same one is slower in some minutes.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from math import nan
from pathlib import Path
from typing import Final

from deploy.recording.recording import Recording
from deploy.verdict.lateness import grown
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.local_runs import Running, recorded, run_once, write_lattice
from tests.benchmarks.processes import environment, handfast

FLEETS: Final = ((45, 10.0), (60, 10.0), (100, 5.0))
FLEETS_QUICK: Final = FLEETS[1:2]
BEFORE_S, STOPPED_S, RESUMED_S, FAULT_S, RESHAPED_S, AFTER_S = 8.0, 5.0, 8.0, 5.0, 7.0, 8.0
RULED_S: Final = 2.0
STOP_S: Final = 1.0
MISSED: Final = 0.001
COMMAND_S: Final = 60.0
HEADING: Final = (
    "fleet", "cores busy before", "command", "took s", "exit", "robots late", "ticks missed",
)  # fmt: skip


def command(*words: str) -> tuple[float, int, str]:
    """Gives a command: how long that took (s), its exit status and what it said."""
    begun_s = time.perf_counter()
    done = subprocess.run(
        handfast(*words), env=environment(), capture_output=True, text=True, check=False, timeout=COMMAND_S
    )
    return time.perf_counter() - begun_s, done.returncode, done.stdout + done.stderr


def braked(said: str) -> tuple[int, float]:
    """How many robots took a stop by what `handfast stop` said of it, and the last of them after how many
    seconds; nan where it says nothing of that."""
    found = re.search(r"(\d+) of \d+ robots brake, the last after (\d+) ms", said)
    return (int(found[1]), int(found[2]) / 1000.0) if found else (0, nan)


def commanded(folder: Path, robots: int, rate_hz: float) -> tuple[list[Figure], list[list[str]]]:
    """Figures, and a row for each command, of a drive in which a fleet is stopped, may drive again, has one
    link lose messages for a while, is made larger, and is left by one robot."""
    name = f"lattice{robots}"
    given: list[tuple[str, float, float, int, str]] = []
    busy = [nan]

    def meanwhile(running: Running) -> None:
        before, then_s = _cpu_s(running), time.perf_counter()
        time.sleep(BEFORE_S)
        took_s = (time.perf_counter() - then_s) * (os.cpu_count() or 1)
        busy[0] = (_cpu_s(running) - before) / took_s
        for words, then_s in (
            (("stop", name), STOPPED_S),
            (("resume", name), RESUMED_S),
            (
                ("faults", "set", name, "--link", "1->2", "--loss", "10%", "--for", f"{RULED_S:g}s"),
                FAULT_S,
            ),
            (("change", "reshape", name, "--scale", "1.1"), RESHAPED_S),
            (("change", "leave", name, "--robot", f"{robots}"), AFTER_S),
        ):
            at_s = time.time()
            given.append((" ".join(words[: words.index(name)]), at_s, *command(*words)))
            time.sleep(max(0.0, at_s + then_s - time.time()))

    out = folder / name
    duration_s = BEFORE_S + STOPPED_S + RESUMED_S + FAULT_S + RESHAPED_S + AFTER_S + 1.0
    file = write_lattice(folder, robots, rate_hz)
    found = run_once(file, out, duration_s, "--no-check", meanwhile=meanwhile)
    what = f"{robots} at {rate_hz:g} Hz"
    recording = recorded(out)
    if recording is None or recording.epoch_ns is None or len(given) < 5:
        return [Figure(f"{what}: drives and takes five commands", 0.0, "", 1, at_most=False)], []
    epoch_s = recording.epoch_ns / 1e9
    ends_s = [at_s - epoch_s for _, at_s, *_ in given[1:]] + [recording.end_s]
    rows = [
        [
            what,
            f"{100.0 * busy[0]:.0f} %",
            kind,
            number(took_s),
            str(status),
            str(len(_late(recording, at_s - epoch_s, end_s))),
            str(_missed(recording, at_s - epoch_s, end_s)),
        ]
        for (kind, at_s, took_s, status, _), end_s in zip(given, ends_s, strict=True)
    ]
    late = sum(int(row[5]) for row in rows)
    took, after_s = braked(given[0][4])
    skipped = sum(int(row[6]) for row in rows)
    figures = [
        Figure(f"{what}: a stop is taken by the last robot after", after_s, "s", STOP_S),
        Figure(f"{what}: robots that took the stop", took, f"of {robots}", robots, at_most=False),
        Figure(f"{what}: robots that said that their machine is too slow after a command", late, "", 0),
        Figure(f"{what}: settled in the end", float(found.settled), "", 1, at_most=False),
    ]
    share = 100.0 * skipped / (robots * rate_hz * (recording.end_s - BEFORE_S))
    figures.append(Figure(f"{what}: ticks missed after the first command", share, "%", 100.0 * MISSED))
    return figures, rows


def _cpu_s(running: Running) -> float:
    """CPU that all processes of a run have used, s."""
    return sum(spent_s for _, spent_s in running.cpu().values())


def _late(recording: Recording, begin_s: float, end_s: float) -> set[int]:
    """Robots that said between two times that somebody's machine is too slow."""
    found = set()
    for robot in recording.ids:
        status = recording.robots[robot].status
        for t, reason in zip(status.t.tolist(), status.reasons, strict=True):
            if begin_s <= t < end_s and "overloaded" in reason:
                found.add(robot)
    return found


def _missed(recording: Recording, begin_s: float, end_s: float) -> int:
    """Ticks that agents skipped between two times."""
    skipped = 0
    for robot in recording.ids:
        status = recording.robots[robot].status
        rows = [row for row, t in enumerate(status.t.tolist()) if begin_s <= t < end_s]
        if rows:
            skipped += grown(status, "overruns", rows[0] - 1, rows[-1])
    return skipped


def run(options: Options) -> Result:
    result = Result()
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        for robots, rate_hz in FLEETS_QUICK if options.quick else FLEETS:
            figures, more = commanded(Path(name), robots, rate_hz)
            result.figures += figures
            rows += more
    result.details = table(HEADING, rows)
    return result
