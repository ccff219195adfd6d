"""Ticks missed beside other load, with `[process] realtime` and without.

`handfast run delta` at several rates, beside ``stress-ng --cpu 1`` (without it a Python that counts on end):
one drive without real time and one with it in turn, of at most `DRIVE_MINUTES` each, as often as makes
`--minutes` of either, and as often with nothing beside it. Robots do not lower their rate. A rate that this
machine does not carry (`deploy.check.capacity`) is not driven in real time: that would leave too
little to the command that records the drive.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Final

import numpy as np

from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path
from deploy.processes.machine import overload_here
from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.processes import BenchmarkError, NotHereError, end, environment, finish, handfast

FLEET: Final = "delta"
RATES_HZ: Final = (50, 100, 200)
MINUTES: Final = 1.0
QUICK_MINUTES: Final = 0.25
DRIVE_MINUTES: Final = 5.0
"""A recording is read whole: longer drives take more memory than a small machine has."""
RUN: Final = "run"
REALTIME: Final = "realtime"
KINDS: Final = {"alone": (False, False), "beside load": (False, True), REALTIME: (True, True)}
"""Whether a drive asks for real time, and whether there is other load."""
ENDED: Final = ": ending ("
MISSED: Final = re.compile(r": missed (\d+) of \d+ ticks")
"""What a process says at its end (`agent.runtime.loop`)."""
LIMIT: Final = 0.01
"""%, of an hour at 200 Hz."""
COMMAND_TIMEOUT_S: Final = 120.0
SETTLED_S: Final = 2.0
"""Ticks are counted from then on: a fleet is started beside that load, too."""


@dataclass
class Count:
    """Ticks that were made and missed, of one role."""

    made: int = 0
    missed: int = 0

    @property
    def percent(self) -> float:
        whole = self.made + self.missed
        return 100.0 * self.missed / whole if whole else float("nan")

    def __str__(self) -> str:
        return f"{self.missed} of {self.made + self.missed}"


@dataclass
class Found:
    """What drives of one kind came to."""

    agents: Count
    plants: Count
    recorded: Count
    """States of plants: what is missing has its plant missed, or the command, which records beside robots."""
    heard_s: float = 0.0
    driven_s: float = 0.0
    """How much of how long drives the recording has of robots' agents."""


def add(found: Found, recording: Recording, logs: Path) -> None:
    """Counts the ticks of one drive: of agents as their status says, of plants as the logs in a folder say,
    from their start on, and what the recording has of them."""
    period_s = recording.fleet.period_ns / 1e9
    for robot in recording.robots.values():
        status = robot.status
        here = np.flatnonzero((status.t > SETTLED_S) & (status.t <= recording.end_s))
        found.driven_s += recording.end_s - SETTLED_S
        if len(here) > 1:
            first, last = int(here[0]), int(here[-1])
            missed = status.counters[last].get("overruns", 0) - status.counters[first].get("overruns", 0)
            span_s = float(status.t[last] - status.t[first])
            found.heard_s += span_s
            found.agents.missed += missed
            found.agents.made += max(0, round(span_s / period_s) - missed)
        times = robot.plant.t[(robot.plant.t > SETTLED_S) & (robot.plant.t <= recording.end_s)]
        found.recorded.made += len(times)
        found.recorded.missed += int(np.rint(np.diff(times) / period_s - 1.0).clip(min=0).sum())
        text = (logs / f"robot-{robot.id}-plant.log").read_text(encoding="utf-8")
        if ENDED not in text:
            raise BenchmarkError(f"the plant of robot {robot.id} did not end in order")
        said = MISSED.search(text)
        missed = int(said[1]) if said else 0
        found.plants.missed += missed
        found.plants.made += round(recording.end_s / period_s) - missed


@contextmanager
def beside() -> Iterator[str]:
    """Load on one core, meanwhile; what makes it."""
    words = [shutil.which("stress-ng") or "", "--cpu", "1"]
    if not words[0]:
        words = [sys.executable, "-c", "while True: pass"]
    burner = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        time.sleep(0.5)
        if burner.poll() is not None:
            raise BenchmarkError(f"{words[0]} ended with {burner.returncode}")
        yield "stress-ng --cpu 1" if "stress-ng" in words[0] else "a Python that counts"
    finally:
        burner.terminate()
        end(burner)


def drive(
    folder: Path, rate_hz: int, duration_s: float, *, realtime: bool, more: Sequence[str] = ()
) -> Recording:
    out = folder / RUN
    shutil.rmtree(out, ignore_errors=True)
    settings = [
        f"fleet.rate_hz={rate_hz}",
        f"control.rate_min_hz={rate_hz}",
        f"process.realtime={str(realtime).lower()}",
        *more,
    ]
    words = handfast("run", FLEET, "--no-report", "--no-check", "--quiet", "--out", str(out))
    words += ["--duration", f"{duration_s:g}", *(word for each in settings for word in ("--set", each))]
    finish(words, duration_s + COMMAND_TIMEOUT_S)
    return read_run(out)


def steal_s() -> float:
    """Time that this machine was not given though it wanted it, by its hypervisor; all cores, since boot."""
    fields = Path("/proc/stat").read_text().split("\n")[0].split()
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


def needs_realtime() -> None:
    """Raises `NotHereError` where this machine grants none."""
    words = [sys.executable, "-P", "-m", "agent.runtime.realtime", "--role", "plant", "--priority", "40"]
    done = subprocess.run(words, capture_output=True, text=True, env=environment())
    granted = json.loads(done.stdout or "null")
    if not granted or not granted["fifo"]:
        raise NotHereError("this machine grants no SCHED_FIFO (RLIMIT_RTPRIO, or a container)")


def run(options: Options) -> Result:
    needs_realtime()
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    refused = {rate_hz: overload_here(_asking(rate_hz)) for rate_hz in RATES_HZ}
    asked = [
        (rate_hz, kind) for rate_hz in RATES_HZ for kind in KINDS if kind != REALTIME or not refused[rate_hz]
    ]
    result = measured(asked, minutes, DRIVE_MINUTES)
    result.details += [f"not in real time: {why}" for why in refused.values() if why]
    return result


def measured(
    asked: Sequence[tuple[int, str]], minutes: float, drive_minutes: float, settings: Sequence[str] = ()
) -> Result:
    """What so many minutes of each rate, Hz, and kind come to: in turn, in drives of that many at most."""
    drives = max(1, ceil(minutes / drive_minutes))
    duration_s = 60.0 * minutes / drives
    found = {each: Found(Count(), Count(), Count()) for each in asked}
    begun, stolen, what = time.monotonic(), steal_s(), ""
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        for _ in range(drives):
            for rate_hz, kind in asked:
                realtime, loaded = KINDS[kind]
                with beside() if loaded else nullcontext("") as load:
                    what = load or what
                    recording = drive(Path(folder), rate_hz, duration_s, realtime=realtime, more=settings)
                each = found[rate_hz, kind]
                add(each, recording, Path(folder) / RUN / "logs")
                print(f"  {rate_hz} Hz, {kind}: agents {each.agents}, plants {each.plants}", flush=True)
    stolen = (steal_s() - stolen) / (time.monotonic() - begun) / (os.cpu_count() or 1)
    return _result(found, minutes, what, stolen)


def _asking(rate_hz: int) -> Fleet:
    return resolved(load_fleet(fleet_path(FLEET), [f"fleet.rate_hz={rate_hz}", "process.realtime=true"]))


def _result(found: dict[tuple[int, str], Found], minutes: float, what: str, stolen: float) -> Result:
    figures, rows = [], []
    for (rate_hz, kind), each in found.items():
        if kind == REALTIME:
            for role, count in (("agents", each.agents), ("plants", each.plants)):
                name = f"ticks missed by {role} in real time, {rate_hz} Hz"
                figures.append(Figure(name, count.percent, "%", LIMIT, note=str(count)))
        counts = each.agents, each.plants, each.recorded
        cells = [f"{number(count.percent)} % ({count})" for count in counts]
        heard = f"{100.0 * each.heard_s / each.driven_s:.0f} %" if each.driven_s else "-"
        rows.append([f"{rate_hz} Hz, {kind}", *cells, heard])
    head = ["", "agents missed", "plants missed", "states not recorded", "heard of agents"]
    note = f"{minutes:g} min each, 12 processes, {os.cpu_count()} cores, beside {what}; {stolen:.1%} stolen"
    return Result(figures, [note, *table(head, rows)])
