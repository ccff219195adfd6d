"""Recording on the robots: how much disk and CPU it takes, and what it costs the agent that it listens to.

One fleet drives all the time; recorders come and go beside it, so that windows with and without them take
turns and what else the machine does falls on both.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import encode
from handfast.agent.recorder.folder import recording_files
from handfast.deploy.recording.mcap_reader import McapFile
from tests.benchmarks.driven_fleet import driving
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import ROLES, Group, Observer, cpu_s, mean, pss_mb

RECORDER: Final = "recorder"
SETTLE_S: Final = 3.0
DISK_MB: Final = 256
"""`recording.max_mb` as it comes."""


@dataclass
class _Found:
    """One figure per window."""

    cpu: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """CPU in per cent of a core, by what runs and beside what."""
    rates: list[float] = field(default_factory=list)
    """Bytes per second on one robot's disk."""
    memory: list[float] = field(default_factory=list)
    heard: list[float] = field(default_factory=list)
    messages: list[float] = field(default_factory=list)


def run(options: Options) -> Result:
    rounds, window_s = (2, 10.0) if options.quick else (5, 20.0)
    found = _Found()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        folder = Path(name)
        with driving(folder) as (fleet, fleet_file, robots, observer):

            def beside(number: int) -> None:
                recordings = folder / str(number)
                with Group(folder) as recorders:
                    _record(recorders, fleet, fleet_file, recordings)
                    _measure(found, " with", fleet, observer, robots, recorders, recordings, window_s)
                _read(found, fleet, recordings)

            def alone(_: int) -> None:
                with Group(folder) as nobody:
                    _measure(found, " without", fleet, observer, robots, nobody, folder, window_s)

            for number in range(rounds):
                # The order of the arms changes from round to round.
                for arm in (beside, alone) if number % 2 == 0 else (alone, beside):
                    arm(number)
    return _result(found)


def _measure(
    found: _Found,
    arm: str,
    fleet: Fleet,
    observer: Observer,
    robots: Group,
    recorders: Group,
    recordings: Path,
    window_s: float,
) -> None:
    """One window, after all have settled."""
    observer.watch(SETTLE_S)
    stored, before, begun = _stored(fleet, recordings), _cpu(robots, recorders), time.monotonic()
    observer.watch(window_s)
    recorders.check()
    after, took = _cpu(robots, recorders), time.monotonic() - begun
    for role in ROLES:
        found.cpu[role + arm].append(100.0 * (after[role] - before[role]) / took / len(fleet.ids))
    pids = recorders.pids(RECORDER)
    if pids:
        found.cpu[RECORDER].append(100.0 * (after[RECORDER] - before[RECORDER]) / took / len(pids))
        found.rates.append((_stored(fleet, recordings) - stored) / took / len(pids))
        found.memory.append(mean(map(pss_mb, pids)))


def _result(found: _Found) -> Result:
    rate = median(found.rates)
    figures = [
        Figure("on the disk per robot", rate / 1e3, "kB/s", note=f"{median(found.messages):.0f} messages/s"),
        Figure(f"{DISK_MB} MB hold", DISK_MB * 1e6 / rate / 3600.0, "h"),
        Figure("bytes heard / bytes on the disk", median(found.heard)),
        Figure("CPU of a recorder", median(found.cpu[RECORDER]), "% of a core"),
        Figure("memory of a recorder", median(found.memory), "MB"),
    ]
    for role in ROLES:
        pairs = zip(found.cpu[f"{role} with"], found.cpu[f"{role} without"], strict=True)
        ratios = [beside / alone for beside, alone in pairs]
        note = f"rounds {' '.join(f'{ratio:.2f}' for ratio in ratios)}"
        figures.append(Figure(f"CPU of the {role}, with / without a recorder", median(ratios), note=note))
    rows = [[name, spread(values)] for name, values in sorted(found.cpu.items())]
    return Result(figures, table(["process", "CPU %"], rows))


def _record(group: Group, fleet: Fleet, fleet_file: Path, recordings: Path) -> None:
    for robot in fleet.ids:
        command = [sys.executable, "-P", "-m", "handfast.agent.recorder", "--fleet", str(fleet_file)]
        command += ["--robot", str(robot), "--folder", str(recordings / str(robot)), "--exit-with-parent"]
        group.start(robot, RECORDER, command, {})


def _cpu(robots: Group, recorders: Group) -> dict[str, float]:
    used = {role: sum(map(cpu_s, robots.pids(role))) for role in ROLES}
    return used | {RECORDER: sum(map(cpu_s, recorders.pids(RECORDER)))}


def _stored(fleet: Fleet, recordings: Path) -> int:
    folders = [recordings / str(robot) for robot in fleet.ids]
    return sum(path.stat().st_size for each in folders if each.is_dir() for path in recording_files(each))


def _read(found: _Found, fleet: Fleet, recordings: Path) -> None:
    """Bytes of keys and payloads to bytes on the disk, and messages a second, of each robot."""
    for robot in fleet.ids:
        for path in recording_files(recordings / str(robot)):
            received = list(McapFile(path).read())
            heard = sum(len(key) + len(encode(message)) for _, key, message in received)
            found.heard.append(heard / path.stat().st_size)
            found.messages.append(len(received) / (received[-1][0] - received[0][0]) * 1e9)
