"""`handfast run` of 12, 90 and 200 agents and plants: from the command until all listen, live and drive, and
from Ctrl-C until all are gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from math import hypot, nan, sqrt
from pathlib import Path
from statistics import mean, median
from typing import Final

from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import (
    BenchmarkError,
    cpu_s,
    descendants,
    end,
    environment,
    handfast,
    pss_mb,
    state_of,
)

DRIVING_S: Final = {12: 1.5, 90: 8.0, 200: 15.0}
"""By the number of processes: how soon after the command they are to drive."""
DELTA: Final = 12
GONE_S: Final = 1.0
COMMAND_S: Final = 0.4
TIMEOUT_S: Final = 60.0
POLL_S: Final = 0.002
LISTENS: Final = "0A"
"""State of a socket in /proc/net/tcp."""
ALIVE, DRIVES, PORTS = b"alive after", b" s  worst", b"on ports "


def children_of(pid: int) -> list[int]:
    """Pids of a run's processes that are a robot's, whoever has forked them."""
    return [child for child in descendants(pid) if b"--robot" in command_of(child)]


def command_of(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def listening() -> set[int]:
    """TCP ports of this machine that somebody listens on."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if row[3] == LISTENS}


def lattice(robots: int, rate_hz: float = 10.0, side_m: float = 1.0) -> str:
    """A fleet file of a triangular lattice, each robot tied to those next to it, that stays where it is."""
    width = round(sqrt(robots))
    places = [
        (side_m * (k % width + 0.5 * (k // width % 2)), side_m * sqrt(0.75) * (k // width))
        for k in range(robots)
    ]
    edges = [
        [i + 1, j + 1]
        for j, (x, y) in enumerate(places)
        for i, (u, v) in enumerate(places[:j])
        if hypot(x - u, y - v) < 1.05 * side_m
    ]
    lines = [
        f'[fleet]\nname = "lattice{robots}"\nrate_hz = {rate_hz}\nduration_s = 600',
        f"[formation]\nsafe_distance_m = 0.22\nedges = {edges}",
        f"offsets = {[list(place) for place in places]}",
        '[trajectory]\nkind = "hold"',
    ]
    lines += [f"[[robot]]\nid = {k + 1}\nx_m = {x + 0.05}\ny_m = {y}" for k, (x, y) in enumerate(places)]
    return "\n".join(lines)


@dataclass
class Start:
    """What one start took, s from the command, and what its processes had used when all listened and when
    they drove; nan for what did not come in time."""

    listen_s: float = nan
    alive_s: float = nan
    drive_s: float = nan
    cpu_ms: float = nan
    pss_mb: dict[str, float] = field(default_factory=dict)
    gone_s: float = nan
    ended_s: float = nan


class Lines:
    """Reads what a run says, and notes when it said what is looked for."""

    def __init__(self, process: subprocess.Popen[bytes], marks: Collection[bytes]) -> None:
        self._process = process
        self.at = dict.fromkeys(marks, nan)
        self.text = dict.fromkeys(marks, b"")
        self.heard = {mark: threading.Event() for mark in marks}
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            for mark, event in self.heard.items():
                if mark in line and not event.is_set() and not (mark is DRIVES and b"-" in line.split()[0]):
                    self.at[mark], self.text[mark] = time.perf_counter(), line
                    event.set()

    def wait(self, mark: bytes, timeout_s: float) -> bool:
        """Whether it has been said in time."""
        deadline = time.monotonic() + timeout_s
        while not self.heard[mark].wait(0.05):
            if self._process.poll() is not None:
                raise BenchmarkError(f"handfast run ended and never said {mark!r}")
            if time.monotonic() > deadline:
                return False
        return True


def once(folder: Path, fleet: str, processes: int, timeout_s: float = TIMEOUT_S) -> Start:
    """One run, until it drives or `timeout_s` is over, and its end.

    Args:
        processes: agents and plants; of more than 24 robots plants share processes.
    """
    found = Start()
    begun = time.perf_counter()
    process = subprocess.Popen(
        handfast("run", fleet, "--no-check", "--duration", "600", "--out", str(folder)),
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    lines = Lines(process, (PORTS, ALIVE, DRIVES))
    children: list[int] = []
    try:
        if not lines.wait(PORTS, timeout_s):
            raise BenchmarkError("handfast run never started its processes")
        words = lines.text[PORTS].split(PORTS)[1].split()
        ports = set(range(int(words[0]), int(words[2].rstrip(b",")) + 1))
        deadline = begun + timeout_s
        while not ports <= listening() and time.perf_counter() < deadline:
            time.sleep(POLL_S)
        if ports <= listening():
            found.listen_s = time.perf_counter() - begun
        children = children_of(process.pid)
        agents = sum(b"\0handfast.agent\0" in command_of(pid) for pid in children)
        if agents != processes // 2:
            raise BenchmarkError(f"handfast run has {agents} agents, not {processes // 2}")
        found.cpu_ms = 1000.0 * mean(map(cpu_s, children))
        if lines.wait(DRIVES, max(0.0, deadline - time.perf_counter())):
            time.sleep(1.0)
            for role in ("agent", "plant"):
                pids = [pid for pid in children if f"\0handfast.{role}\0".encode() in command_of(pid)]
                found.pss_mb[role] = mean(map(pss_mb, pids))
        found.alive_s, found.drive_s = lines.at[ALIVE] - begun, lines.at[DRIVES] - begun
        asked = time.perf_counter()
        process.send_signal(signal.SIGINT)
        while any(state_of(pid) not in ("", "Z") for pid in children):
            if time.perf_counter() - asked > TIMEOUT_S:
                raise BenchmarkError("processes are left after Ctrl-C")
            time.sleep(POLL_S)
        found.gone_s = time.perf_counter() - asked
        process.wait(TIMEOUT_S)
        found.ended_s = time.perf_counter() - asked
        return found
    finally:
        end(process)
        for pid in children:  # they end with their parent; these would be strays
            if state_of(pid) not in ("", "Z"):
                os.kill(pid, signal.SIGKILL)
        lines.thread.join(1.0)


def took_s(words: Sequence[str]) -> float:
    begun = time.perf_counter()
    subprocess.run(words, env=environment(), stdout=subprocess.DEVNULL, check=False)
    return time.perf_counter() - begun


def above_python(repetitions: int, *arguments: str) -> Figure:
    """What a command takes more than ``python -c pass``: both in turn, so that a busy machine slows both."""
    bare = [sys.executable, "-c", "pass"]
    pairs = [(took_s(bare), took_s(handfast(*arguments))) for _ in range(repetitions)]
    more = [command_s - bare_s for bare_s, command_s in pairs]
    name = f"handfast {' '.join(arguments)}, more than python -c pass, median"
    return Figure(name, median(more), "s", COMMAND_S, note=spread(more))


def figures(processes: int, starts: Sequence[Start]) -> list[Figure]:
    """Of a size; nan where one of the starts did not come so far in time."""
    listen, alive, drive = zip(*((each.listen_s, each.alive_s, each.drive_s) for each in starts), strict=True)
    cpu = [each.cpu_ms for each in starts]
    rows = [
        Figure(f"command to all {processes} listen, worst", max(listen), "s", note=spread(listen)),
        Figure(f"CPU of each of {processes} until all listen", mean(cpu), "ms", note=spread(cpu)),
        Figure(f"command to all {processes} alive, worst", max(alive), "s", note=spread(alive)),
        Figure(
            f"command to all {processes} drive, worst",
            max(drive),
            "s",
            DRIVING_S[processes],
            note=spread(drive),
        ),
    ]
    for role in starts[0].pss_mb:
        memory = [each.pss_mb.get(role, nan) for each in starts]
        rows.append(
            Figure(f"PSS of one {role} of {processes} processes", median(memory), "MB", note=spread(memory))
        )
    return rows


def run(options: Options) -> Result:
    repetitions = 3 if options.quick else 10
    result = Result()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        folder = Path(name)
        found = [once(folder / str(number), "delta", DELTA) for number in range(repetitions)]
        result.figures += figures(DELTA, found)
        gone, ended = zip(*((each.gone_s, each.ended_s) for each in found), strict=True)
        result.figures += [
            Figure(f"Ctrl-C to all {DELTA} gone, worst", max(gone), "s", GONE_S, note=spread(gone)),
            Figure("Ctrl-C to the command's end, report written", median(ended), "s", note=spread(ended)),
        ]
        for processes in [size for size in DRIVING_S if size != DELTA and not (options.quick and size > 90)]:
            file = folder / f"lattice{processes}.toml"
            file.write_text(lattice(processes // 2), encoding="utf-8")
            timeout_s = 20.0 if options.quick else TIMEOUT_S
            result.figures += figures(
                processes, [once(folder / f"run{processes}", str(file), processes, timeout_s)]
            )
    for arguments in (("--help",), ("check", "delta")):
        result.figures.append(above_python(repetitions, *arguments))
    return result
