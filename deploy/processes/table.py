"""Which processes of a fleet run on this machine, whoever started them, as the kernel's table of processes
has them (proc(5))."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
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
