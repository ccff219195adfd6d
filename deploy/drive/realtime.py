"""What the processes of a fleet have been granted of real time, as lines of a preflight.

Of processes that run the processes are looked at; where none do, one is started that asks as they would.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Final

from agent.fleet.model import Fleet
from agent.fleet.process_section import ProcessSection
from agent.messages.key_expressions import ROLES
from agent.runtime.realtime_granted import Granted, from_json, said
from deploy.drive.vehicle_checks import OK, WARNING, Line, sentences
from deploy.faults.process_actions import Process
from deploy.processes.command_line import words_of

NAME: Final = "realtime"
TRIAL: Final = "agent.runtime.realtime"
TRIAL_S: Final = 20.0


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


def trial(section: ProcessSection) -> dict[str, Granted | None]:
    """What an agent and a plant would be granted that this process starts, by role."""
    return {role: _tried(section, role) for role in ROLES}


def _tried(section: ProcessSection, role: str) -> Granted | None:
    arguments = ["--role", role, "--priority", str(section.priority)]
    if section.cpus:
        arguments += ["--cpus", ",".join(map(str, section.cpus))]
    words: Sequence[str] = words_of(TRIAL, arguments)
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, timeout=TRIAL_S, text=True
        )
        return from_json(json.loads(done.stdout))
    return None
