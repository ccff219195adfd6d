"""`handfast run delta`: from the command until all live, from Ctrl-C until all are gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Final

from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import BenchmarkError, end, environment, handfast, state_of

ALIVE_S: Final = 3.0
GONE_S: Final = 1.0
COMMAND_S: Final = 0.4
PROCESSES: Final = 12
TIMEOUT_S: Final = 60.0
POLL_S: Final = 0.002


def children_of(pid: int) -> list[int]:
    """Pids of a process's children, and of theirs: those of robots, not the server that forks them."""
    found, parents = [], [pid]
    while parents:
        for listing in Path(f"/proc/{parents.pop()}/task").glob("*/children"):
            try:
                parents += map(int, listing.read_text().split())
            except OSError:
                continue
        found += [child for child in parents if child not in found]
    return [child for child in found if b"--robot" in command_of(child)]


def command_of(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def wait_for(what: str, done: threading.Event, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not done.wait(0.05):
        if process.poll() is not None or time.monotonic() > deadline:
            raise BenchmarkError(f"handfast run never said {what!r}")


def once(folder: Path) -> tuple[float, float, float]:
    """Seconds until all live, from Ctrl-C until all processes are gone, and until the command ended."""
    marks = {b"alive after": threading.Event(), b" s  worst": threading.Event()}
    at: dict[bytes, float] = {}
    begun = time.perf_counter()
    process = subprocess.Popen(
        handfast("run", "delta", "--duration", "60", "--out", str(folder)),
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )

    def read() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            for mark, event in marks.items():
                if mark in line and not event.is_set():
                    at[mark] = time.perf_counter()
                    event.set()

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    children: list[int] = []
    try:
        wait_for("alive", marks[b"alive after"], process)
        children = children_of(process.pid)
        if len(children) != PROCESSES:
            raise BenchmarkError(f"handfast run has {len(children)} children, not {PROCESSES}")
        wait_for("driving", marks[b" s  worst"], process)
        time.sleep(1.0)
        asked = time.perf_counter()
        process.send_signal(signal.SIGINT)
        while any(state_of(pid) not in ("", "Z") for pid in children):
            if time.perf_counter() - asked > TIMEOUT_S:
                raise BenchmarkError("processes are left after Ctrl-C")
            time.sleep(POLL_S)
        gone = time.perf_counter()
        process.wait(TIMEOUT_S)
        return at[b"alive after"] - begun, gone - asked, time.perf_counter() - asked
    finally:
        end(process)
        for pid in children:  # they end with their parent; these would be strays
            if state_of(pid) not in ("", "Z"):
                os.kill(pid, signal.SIGKILL)
        reader.join(1.0)


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


def run(options: Options) -> Result:
    repetitions = 3 if options.quick else 10
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        found = [once(Path(folder) / str(number)) for number in range(repetitions)]
    alive, gone, ended = zip(*found, strict=True)
    result = Result(
        [
            Figure("command to all 12 alive, worst", max(alive), "s", ALIVE_S, note=spread(alive)),
            Figure("Ctrl-C to all 12 gone, worst", max(gone), "s", GONE_S, note=spread(gone)),
            Figure("Ctrl-C to the command's end, report written", median(ended), "s", note=spread(ended)),
        ]
    )
    for arguments in (("--help",), ("check", "delta")):
        result.figures.append(above_python(repetitions, *arguments))
    return result
