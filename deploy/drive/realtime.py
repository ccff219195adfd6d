"""What the processes of a fleet have been granted of real time, as lines of a preflight.

Of processes that run the processes are looked at; where none do, one is started that asks as they would.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from handfast.agent.fleet.hosts import ProcessSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.runtime.realtime_granted import (
    KILLED_S,
    OVERRUN_S,
    POLICIES,
    Granted,
    Thread,
    cores,
    from_json,
    said,
)
from handfast.deploy.drive.readiness import OK, WARNING, Line, sentences
from handfast.deploy.faults.process_actions import Process
from handfast.deploy.processes.attributes import words_of
from handfast.deploy.processes.child import FleetProcesses

NAME: Final = "realtime"
TRIAL: Final = "handfast.agent.runtime.realtime"
TRIAL_S: Final = 20.0
GIVEN_UP: Final = POLICIES[0]
_TASKS: Final = Path("/proc/self/task")
LOOK_S: Final = 1.0
"""How often is looked whether processes have real time still."""
RECORDING_NICE: Final = -10
"""Of the command that records a fleet in real time: ten times the share of a program that asks for none."""


def lines(
    section: ProcessSection, granted: Mapping[Process, Granted | None], *, as_units: bool
) -> dict[int, list[Line]]:
    """The lines of each robot: one for each of its processes, or one for both where that is the same.

    Args:
        granted: what processes have, None of those that cannot be looked at.
        as_units: whether systemd has started them.
    """
    found: dict[int, list[Line]] = {}
    for (robot, role), each in sorted(granted.items()):
        words = said(section, role, each, as_unit=as_units)
        line = Line(f"{NAME} {role}", WARNING if words.advice else OK, *words)
        before = found.setdefault(robot, [])
        if before and before[-1][1:] == line[1:]:
            before[-1] = before[-1]._replace(name=NAME)
        else:
            before.append(line)
    return found


def is_realtime(line: Line) -> bool:
    """Whether a line is one of these: a robot that has no others has no vehicle."""
    return line.name.startswith(NAME)


def in_words(fleet: Fleet, granted: Mapping[Process, Granted | None]) -> list[str]:
    """Sentences for processes on this machine: what robots have in common is said once, warnings as such."""
    both = [
        (line, robot)
        for robot, each in lines(fleet.process, granted, as_units=False).items()
        for line in each
    ]
    good, bad = ([each for each in both if each[0].level == level] for level in (OK, WARNING))
    return [*sentences(good), *(f"warning: {sentence}" for sentence in sentences(bad))]


class Watch:
    """Looks now and then at the processes of a drive whether they have real time still.

    Args:
        processes: those of the fleet.
    """

    def __init__(self, fleet: Fleet, processes: FleetProcesses) -> None:
        self._fleet, self._processes = fleet, processes
        self._had: dict[Process, Granted] = {}
        self._due_s = 0.0

    def begin(self) -> list[str]:
        """Sentences about what was granted, before a drive."""
        if not self._fleet.process.realtime:
            return []
        granted = self._processes.granted()
        self._had = {process: each for process, each in granted.items() if each is not None and each.fifo}
        return in_words(self._fleet, granted)

    def look(self, at_s: float) -> list[str]:
        """Sentences without their ends about who has it no longer as it was; `at_s`: of this process's
        clock."""
        if not self._had or at_s < self._due_s:
            return []
        self._due_s = at_s + LOOK_S
        granted = self._processes.granted()
        found: list[str] = []
        for process, had in sorted(self._had.items()):
            has = granted.get(process)
            if has is not None:
                self._had[process] = has
                found += _changed(process, had, has)
        return found


def _changed(process: Process, had: Granted, has: Granted) -> Iterator[str]:
    """Sentences without their ends. Who took it is not to be seen; threads that are new are not its own."""
    robot, role = process
    before = {(each.number, each.name): each for each in had.threads}
    changed: dict[tuple[str, str], list[Thread]] = {}
    for each in has.threads:
        was = before.get((each.number, each.name), each)
        then, now = was.scheduling, each.scheduling
        if was.cpus != each.cpus:
            then, now = f"{then}, {cores(was.cpus)}", f"{now}, {cores(each.cpus)}"
        if then != now:
            changed.setdefault((then, now), []).append(each)
    if had.fifo and has.threads[0].scheduling == GIVEN_UP:
        yield (
            f"The {role} of robot {robot} has real time no longer ({GIVEN_UP}): it ran for {OVERRUN_S:g} s "
            "without waiting and gave it up, which its log says, or somebody took it away"
        )
        changed = {key: each for key, each in changed.items() if not key[1].startswith(GIVEN_UP)}
    for (then, now), threads in changed.items():
        whose = f"the {role} of robot {robot}"
        if threads[0] is not has.threads[0]:  # not its loop
            names = sorted({each.name for each in threads})
            whose = f"thread{'s' * (len(names) > 1)} {', '.join(names)} of {whose}"
        have = "have" if whose.startswith("threads") else "has"
        yield f"{whose[0].upper()}{whose[1:]} {have} {now} now, which somebody changed from {then}"


@contextmanager
def recording(fleet: Fleet) -> Iterator[None]:
    """This process goes before others that have no real time, if the fleet has it and the kernel allows it.

    Robots wait for nobody: what they say while this process waits for a core is in no recording.
    """
    threads = _threads() if fleet.process.realtime else []
    raised = {
        thread: nice for thread, nice in threads if nice > RECORDING_NICE and _set(thread, RECORDING_NICE)
    }
    try:
        yield
    finally:
        for thread, nice in raised.items():
            _set(thread, nice)


def _threads() -> list[tuple[int, int]]:
    """This process's, with the niceness of each: on Linux it is theirs."""
    found = []
    with suppress(OSError):
        for thread in map(int, os.listdir(_TASKS)):
            with suppress(ProcessLookupError):
                found.append((thread, os.getpriority(os.PRIO_PROCESS, thread)))
    return found


def _set(thread: int, nice: int) -> bool:
    with suppress(OSError):  # it may not, or has ended
        os.setpriority(os.PRIO_PROCESS, thread, nice)
        return True
    return False


def ended(fleet: Fleet, how: str) -> str:
    """How a process ended, with what may have done it where nobody else has."""
    if fleet.process.realtime and how == f"killed by {signal.SIGKILL.name}":
        how += f"; the kernel kills one in real time that runs for {KILLED_S:g} s without waiting"
    return how


def trial(section: ProcessSection) -> dict[str, Granted | None]:
    """What an agent and a plant would be granted that this process starts, by role."""
    return {role: _tried(section, role) for role in ROLES}


def _tried(section: ProcessSection, role: str) -> Granted | None:
    arguments = ["--role", role]
    if section.cpus:
        arguments += ["--cpus", ",".join(map(str, section.cpus))]
    words: Sequence[str] = words_of(TRIAL, arguments)
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, timeout=TRIAL_S, text=True
        )
        return from_json(json.loads(done.stdout))
    return None
