"""Processes of a fleet that run on this machine, as the kernel's table of processes has them (proc(5)),
and the logs in the folder of their run."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.fleet.model import Fleet
from handfast.deploy.faults.process_actions import Process

PROC: Final = Path("/proc")
RUNS, PAUSED = "active", "paused"
WITH: Final = "--with="
"""How the option of `plant` begins that names more robots."""
_STOPPED: Final = ("T", "t")


class ProcessState(NamedTuple):
    """A process: its number, `RUNS` or `PAUSED` (by SIGSTOP), since how long it runs (s), the processor time
    it took (s), and its memory (bytes)."""

    pid: int
    state: str
    age_s: float
    cpu_s: float
    memory_bytes: int


def fleet_processes(fleet: Fleet, fleet_file: Path) -> dict[Process, ProcessState]:
    """This user's agents and plants that read this fleet file."""
    found: dict[Process, ProcessState] = {}
    for folder in PROC.glob("[0-9]*"):
        # One that ends meanwhile, or is another user's, is none.
        with suppress(OSError, ValueError, LookupError):
            if folder.stat().st_uid != os.getuid():
                continue
            words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            file = _after(words, "--fleet")
            if (os.readlink(folder / "cwd") / Path(file)).resolve() != fleet_file.resolve():
                continue
            robot, module = int(_after(words, "--robot")), _after(words, "-m")
            roles = {"handfast.agent": "agent", fleet.robot(robot).kind.program: "plant"}
            state = process_state(int(folder.name))
            found.update(((each, roles[module]), state) for each in (robot, *_beside(words)))
    return found


def _beside(words: Sequence[str]) -> list[int]:
    """The robots whose plants share a process, after the first."""
    given = next((word for word in words if word.startswith(WITH)), WITH)
    return [int(part) for part in given.removeprefix(WITH).split(",") if part]


def state_of(pid: int) -> str:
    """What a process that is known to live does: `RUNS` or `PAUSED`, as by Ctrl-Z."""
    try:
        return process_state(pid).state
    except (OSError, ValueError, IndexError):  # it ends just now, or this system has no such table
        return RUNS


def process_state(pid: int) -> ProcessState:
    """A process as it is now; raises OSError where there is none, ValueError where it has just ended."""
    fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()  # from the third on
    ticks = os.sysconf("SC_CLK_TCK")
    state, spent, begun = fields[0], int(fields[11]) + int(fields[12]), int(fields[19])
    if state in ("Z", "X"):
        raise ValueError
    pages = int((PROC / str(pid) / "statm").read_text().split()[1])
    return ProcessState(
        pid,
        PAUSED if state in _STOPPED else RUNS,
        max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - begun / ticks),
        spent / ticks,
        pages * os.sysconf("SC_PAGE_SIZE"),
    )


def _after(words: Sequence[str], option: str) -> str:
    """The word after an option; raises ValueError or IndexError where there is none."""
    return words[words.index(option) + 1]


LINE_BYTES_MAX: Final = 4_000_000
LAST_BYTES_MAX: Final = 4096
_NAME: Final = re.compile(r"robot-(\d+)-(\w+)\.log")


class LogFile:
    """The log of one process, read on from where it was read last.

    Attributes:
        robot: whose process it is.
        name: the robot and the process's role, as it begins its own lines.
    """

    def __init__(self, path: Path, robot: int, role: str) -> None:
        self.robot: Final = robot
        self.name: Final = f"robot {robot} {role}"
        self._path = path
        self._at = 0

    def lines(self, *, complete: bool = False) -> Iterator[str]:
        """What was written since, without the process's name; `complete`: not a line that is being written.

        Raises:
            OSError: the file cannot be read.
        """
        with open(self._path, "rb") as file:
            file.seek(self._at)
            while data := file.readline(LINE_BYTES_MAX):
                if complete and not data.endswith(b"\n") and len(data) < LINE_BYTES_MAX:
                    return
                self._at = file.tell()
                yield data.decode(errors="replace").rstrip("\n").removeprefix(f"{self.name}: ")

    def last(self, count: int | None, *, complete: bool = False) -> Iterable[str]:
        """The last `count` lines, or all; as `lines`."""
        lines = self.lines(complete=complete)
        return lines if count is None else deque(lines, count)


def log_files(folder: Path, robots: Collection[int]) -> list[LogFile]:
    """The logs of these robots' processes, in the order of robots; none where there is no such folder."""
    found = [
        LogFile(path, int(name[1]), name[2])
        for path in folder.glob("*.log")
        if (name := _NAME.fullmatch(path.name)) is not None
    ]
    return sorted((log for log in found if log.robot in robots), key=lambda log: (log.robot, log.name))


def last_words(folder: Path, robot: int, role: str) -> str:
    """The last line of a process's log, "" where there is none."""
    try:
        with open(folder / f"robot-{robot}-{role}.log", "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_BYTES_MAX))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    return lines[-1].removeprefix(f"robot {robot} {role}: ") if lines else ""
