"""Fleets as `handfast run` has them on this machine: one run from the command to its end, what it cost and
what came of it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf, nan
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent.fleet.loading import load_fleet
from deploy.analysis.lattice import lattice
from deploy.check.capacity import cost_of
from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from deploy.recording.run_files import FLEET_FILE, METRICS_FILE
from tests.benchmarks.processes import cpu_s, descendants, end, environment, handfast, state_of

PATIENCE_S: Final = 60.0
"""Beyond its duration: a run that is not driving by then, or has not ended, is asked to end."""
KILL_S: Final = 30.0
STEADY_S: Final = 2.0
"""Before and after the window in which processor time is measured."""
HEARD_S: Final = 1.0
"""Whose last message is older, at the end, is not heard."""
DRIVES: Final = re.compile(rb"^ *\d+\.\d s  worst")
ALIVE: Final = re.compile(rb"alive after")
NOT_ENDED: Final = re.compile(rb"(.+) did not end when asked")


@dataclass
class Found:
    """What a run was: nan and None for what it did not come to.

    Attributes:
        alive_s, drive_s: from the command until all processes live, until the fleet drives.
        cpu: by role, processor time in a second of the drive: of one agent and one body, of all routers
            together, and of `run` itself as "run".
        model: the same, as `deploy.check.capacity` has it for a processor like its own.
        killed: processes that did not end when asked.
        status: exit status of the command; below 0 when it had to be killed.
        metrics: its metrics.json; {} without.
        deaf, directions: between neighbours: that nothing came over in the end, and all.
        opened_anew: links.
        lines: what it said.
    """

    alive_s: float = nan
    drive_s: float = nan
    cpu: dict[str, float] = field(default_factory=dict)
    model: dict[str, float] = field(default_factory=dict)
    killed: int = 0
    status: int = -1
    metrics: Mapping[str, Any] = field(default_factory=dict)
    deaf: int = 0
    directions: int = 0
    opened_anew: int = 0
    load: float = nan
    lines: list[str] = field(default_factory=list)

    @property
    def drove(self) -> bool:
        return self.drive_s == self.drive_s  # not nan

    @property
    def missed(self) -> float:
        """Share of its agents' ticks that were missed; inf where it never drove."""
        if not self.drove or not self.metrics or not self.metrics["duration_s"]:
            return inf
        ticks = self.metrics["robots"] * self.metrics["rate_hz"] * self.metrics["duration_s"]
        return float(self.metrics["tick"]["overruns"]) / float(ticks)

    @property
    def settled(self) -> bool:
        return bool(self.metrics) and self.metrics["settling_time_s"] is not None

    @property
    def heard_all(self) -> bool:
        return self.directions > 0 and self.deaf == 0

    @property
    def ended(self) -> bool:
        """Whether all of its processes ended when they were asked to, and the command by itself."""
        return self.killed == 0 and self.status >= 0


class Running:
    """A run while it drives: for who does something to it meanwhile."""

    def __init__(self, process: subprocess.Popen[bytes], begun_s: float) -> None:
        self.process, self.begun_s = process, begun_s

    def processes(self) -> dict[int, str]:
        """Role of each of its processes, by pid."""
        pid = self.process.pid
        return {pid: "run"} | {child: _role(child) for child in descendants(pid)}

    def cpu(self) -> dict[int, tuple[str, float]]:
        found = {}
        for pid, role in self.processes().items():
            try:
                found[pid] = role, cpu_s(pid)
            except OSError:
                continue
        return found


def _role(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return ""
    if b"agent.runtime.router" in words:
        return "router"
    if b"--robot" not in words:
        return "fork server"
    return "agent" if b"\0agent\0" in words else "plant"


def write_lattice(folder: Path, robots: int, rate_hz: float) -> Path:
    """The fleet file of a lattice of so many robots."""
    path = folder / f"lattice{robots}.toml"
    path.write_text(lattice(f"lattice{robots}", robots, rate_hz=rate_hz), encoding="utf-8")
    return path


def run_once(
    fleet: Path | str,
    out: Path,
    duration_s: float,
    *arguments: str,
    meanwhile: Callable[[Running], None] | None = None,
) -> Found:
    """One `handfast run` of a fleet for so long, to its end.

    Args:
        meanwhile: is called once it drives, in place of measuring what it costs.
    """
    found = Found()
    begun = time.perf_counter()
    process = subprocess.Popen(
        handfast(
            *("run", str(fleet), "--duration", f"{duration_s:g}", "--out", str(out), "--no-report"),
            *arguments,
        ),
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    driving = threading.Event()
    thread = threading.Thread(target=_read, args=(process, begun, found, driving), daemon=True)
    thread.start()
    running = Running(process, begun)
    children: dict[int, str] = {}
    try:
        if _wait(driving, process, PATIENCE_S):
            if meanwhile is not None:
                meanwhile(running)
            elif duration_s > 2.0 * STEADY_S:
                time.sleep(STEADY_S)
                before, then = running.cpu(), time.perf_counter()
                time.sleep(duration_s - 2.0 * STEADY_S)
                after, took_s = running.cpu(), time.perf_counter() - then
                found.cpu = _cost(before, after, took_s)
                found.load = os.getloadavg()[0]
        children = running.processes()
        if not found.drove and process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            found.status = process.wait(duration_s + PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(KILL_S)
            except subprocess.TimeoutExpired:
                process.kill()
    finally:
        end(process)
        for pid, role in children.items():  # they end with their parent; these would be strays
            if role != "run" and state_of(pid) not in ("", "Z") and _role(pid) == role:
                os.kill(pid, signal.SIGKILL)
        thread.join(1.0)
    _judge(found, out)
    return found


def _read(process: subprocess.Popen[bytes], begun: float, found: Found, driving: threading.Event) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        found.lines.append(line.decode(errors="replace").rstrip())
        if ALIVE.search(line) and found.alive_s != found.alive_s:
            found.alive_s = time.perf_counter() - begun
        elif DRIVES.match(line) and not driving.is_set():
            found.drive_s = time.perf_counter() - begun
            driving.set()
        elif NOT_ENDED.match(line):
            found.killed += 1
    driving.set()


def _wait(driving: threading.Event, process: subprocess.Popen[bytes], timeout_s: float) -> bool:
    return driving.wait(timeout_s) and process.poll() is None


def _cost(
    before: Mapping[int, tuple[str, float]], after: Mapping[int, tuple[str, float]], took_s: float
) -> dict[str, float]:
    """Processor time of all processes of each role in a second."""
    shares: dict[str, float] = {}
    for pid, (role, used) in after.items():
        if pid in before:
            shares[role] = shares.get(role, 0.0) + (used - before[pid][1]) / took_s
    return shares


def _judge(found: Found, out: Path) -> None:
    metrics = out / METRICS_FILE
    if not metrics.is_file():
        return
    found.metrics = json.loads(metrics.read_text(encoding="utf-8"))
    robots = found.metrics["robots"]
    for role in ("agent", "plant"):
        if role in found.cpu:
            found.cpu[role] /= robots
    cost = cost_of(load_fleet(out / FLEET_FILE))
    found.model = {"agent": cost.agent, "plant": cost.plant, "router": cost.routers, "run": cost.run}
    recording = recorded(out)
    if recording is None:
        return
    for robot in recording.ids:
        totals = recording.robots[robot].status.totals()
        found.opened_anew += totals.get("links.opened_anew", 0)
    found.deaf, found.directions = _deaf(recording)


def recorded(out: Path) -> Recording | None:
    """What a run has recorded; None where it was cut short before there was anything."""
    try:
        return read_run(out)
    except (OSError, ValueError, RuntimeError):
        return None


def _deaf(recording: Recording) -> tuple[int, int]:
    """Of the directions between neighbours: those over which nothing came in the last second, and all."""
    deaf = directions = 0
    for robot in recording.ids:
        status = recording.robots[robot].status
        driving = np.flatnonzero(status.t <= recording.end_s)
        if not len(driving):
            continue
        last = int(driving[-1])
        first = int(status.neighbour_counts[:last].sum())
        rows = status.neighbours[first : first + int(status.neighbour_counts[last])]
        directions += len(rows)
        deaf += int(((rows["age_us"] < 0) | (rows["age_us"] > HEARD_S * 1e6)).sum())
    return deaf, directions
