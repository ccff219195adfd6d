"""Commands for a fleet on 300 hosts, each of which answers over ssh after 0 to 2 s: how long they take.

The hosts are simulated (`tests.benchmarks.simulated_hosts`), with a ``systemctl`` that says what it is told.
There is no bus: what is seen is the way over ssh alone.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import tomli_w

from agent.common.time import NS_PER_S
from agent.fleet.loading import digest, parse_fleet, to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.key_expressions import ROLES
from agent.messages.types import Mission, PlantState
from agent.recorder.recorder import RobotRecorder, order_keys
from agent.recorder.segment_folder import SegmentFolder
from agent.recorder.segments import About, Received
from deploy.hosts.artifacts.systemd_units import roles, unit_name
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.processes import BenchmarkError, environment, handfast
from tests.benchmarks.simulated_hosts import DELAY, SSH

HOSTS: Final = 300
QUICK: Final = 60
SLOWEST_S: Final = 2.0
STEP: Final = 101
"""Coprime to the number of hosts: delays are spread evenly, and not in the order of the file."""
TIMEOUT_S: Final = 240.0
INTERRUPTED_AFTER_S: Final = 3.0
NAME: Final = "many"
CLOSED_PORT: Final = 9
RECORDED: Final = 50
# Its robots take a stop as soon as they are asked after it lies there.
FAKE_SYSTEMCTL: Final = f"""#!/bin/sh
orders="$HOME/.local/share/handfast/fleets/{NAME}/orders"
case "$*" in
  *is-system-running*) echo running ;;
  *stop*) : > "$HOME/shown" ;;
  *show*)
    cat "$HOME/shown"
    [ -f "$orders/stop.json" ] && while read -r name; do cp "$orders/stop.json" "$orders/$name.json"; done \\
      < "$HOME/processes" ;;
esac
"""
FAKE_JOURNALCTL: Final = """#!/bin/sh
read -r line < "$HOME/journal"
echo "$line"
"""


def delay_s(index: int, count: int) -> float:
    """How long the host of that index takes to answer, s."""
    return SLOWEST_S * (index * STEP % count) / (count - 1)


def many(count: int) -> dict[str, Any]:
    """The tables of a fleet with a robot on each of so many hosts; all but two are reserves."""
    return {
        "fleet": {"name": NAME},
        "formation": {"edges": [[1, 2]], "distance_m": 1.0, "safe_distance_m": 0.2},
        "trajectory": {"kind": "hold"},
        "network": {"security": "off", "routers": [f"127.0.0.1:{CLOSED_PORT}"]},
        "host": {f"host{k}": {"address": f"127.1.{k // 200}.{k % 200 + 1}"} for k in range(count)},
        "robot": [
            {"id": k + 1, "x_m": 1.0 * (k % 20), "y_m": 1.0 * (k // 20), "host": f"host{k}", "reserve": k > 1}
            for k in range(count)
        ],
    }


def heard(fleet: Fleet, robot: int) -> list[Received]:
    """What a robot recorded: the mission, and a plant that stands."""
    begun_ns = 1_700_000_000 * NS_PER_S
    mission = Mission(1, begun_ns, begun_ns, NS_PER_S, digest(fleet))
    state = PlantState(
        robot,
        1,
        begun_ns,
        1.0 * robot,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        False,
        healthy=True,
        obeying=True,
        note="",
    )
    rows = [(begun_ns, key_expressions.relayed(NAME, robot), encode(mission))]
    key = key_expressions.plant_state(NAME, robot)
    for k in range(RECORDED):
        at_ns = begun_ns + k * NS_PER_S // RECORDED
        rows.append((at_ns, key, encode(state._replace(sequence=k + 1, time_ns=at_ns))))
    return rows


class Simulated:
    """Hosts of a fleet in a folder. A context manager: they answer within it."""

    def __init__(self, folder: Path, count: int) -> None:
        self._folder, self._count = folder, count
        self.file = folder / "fleet.toml"
        self.file.write_text(tomli_w.dumps(many(count)), encoding="utf-8")
        self._fleet = resolved(parse_fleet(self.file.read_text(), source="many"))
        text = tomli_w.dumps(to_dict(self._fleet))
        tools = folder / "tools"
        tools.mkdir()
        scripts = (("ssh", SSH), ("systemctl", FAKE_SYSTEMCTL), ("journalctl", FAKE_JOURNALCTL))
        for name, script in scripts:
            (tools / name).write_text(script)
            (tools / name).chmod(0o755)
        for index, robot in enumerate(self._fleet.ids):
            home = self._home(index)
            home.mkdir()
            (home / DELAY).write_text(f"{delay_s(index, count):.3f}\n")
            (home / "processes").write_text("".join(f"robot-{robot}-{role}\n" for role in ROLES))
            (home / "journal").write_text(
                f'{{"__REALTIME_TIMESTAMP": "{time.time_ns() // 1000}", "MESSAGE": "robot {robot}"}}\n'
            )
            about = About(NAME, digest(self._fleet), robot, "0.1.0", "boot", 0, 0, text)
            kept = home / f".local/share/handfast/fleets/{NAME}/recordings/robot-{robot}"
            with SegmentFolder(kept, 1_000_000_000, 0) as segments:
                recorder = RobotRecorder(segments, about, order_keys(NAME, robot), (), lambda _: None)
                rows = heard(self._fleet, robot)
                for row in rows:
                    recorder.add(*row)
                recorder.flush(rows[-1][0])
        self.reset()

    def _home(self, index: int) -> Path:
        return self._folder / f"host{index}"

    def reset(self) -> None:
        """Has all units run, as after `up`."""
        says = {"agent": "stopped: stop", "plant": "braking: stop", "recorder": "records"}
        for index, robot in enumerate(self._fleet.ids):
            blocks = [
                f"Id={unit_name(NAME, robot, role)}\nActiveState=active\nResult=success\nMainPID=0\n"
                f"NRestarts=0\nStatusText={says[role]}\n"
                for role in roles(self._fleet)
            ]
            (self._home(index) / "shown").write_text("\n".join(blocks))

    def environment(self) -> dict[str, str]:
        """Of a command: it finds these hosts by its ssh, and nothing of this user's."""
        private = {name: str(self._folder / name.lower()) for name in ("XDG_STATE_HOME", "XDG_CACHE_HOME")}
        path = f"{self._folder / 'tools'}:/usr/bin:/bin"
        return environment(
            {"PATH": path, "SIMULATED": str(self._folder), "HOME": str(self._folder), **private}
        )

    def __enter__(self) -> Simulated:
        words = [sys.executable, "-P", "-m", "tests.benchmarks.simulated_hosts", str(self._folder)]
        self._hosts = subprocess.Popen(
            words,
            env=self.environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._hosts.stdout is not None
        if not self._hosts.stdout.readline():
            raise BenchmarkError("the simulated hosts did not start")
        return self

    def __exit__(self, *_: object) -> None:
        self._hosts.communicate()

    def out(self) -> Path:
        """A place for another run's folder."""
        return Path(tempfile.mkdtemp(dir=self._folder)) / "run"


class Took(NamedTuple):
    """What a command took, s (CPU with that of ssh, without that of hosts), and how many lines it said."""

    wall_s: float
    cpu_s: float
    lines: int
    status: int
    said: str


def command(there: Simulated, *words: str, interrupt_after_s: float | None = None) -> Took:
    """Runs a command of `handfast`; with `interrupt_after_s` `wall_s` is from Ctrl-C to its end."""
    before = os.times()
    begun = time.perf_counter()
    with subprocess.Popen(
        handfast(*words),
        env=there.environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            if interrupt_after_s is not None:
                time.sleep(interrupt_after_s)
                process.send_signal(signal.SIGINT)
                begun = time.perf_counter()
            said, _ = process.communicate(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise BenchmarkError(f"handfast {words[0]} did not end within {TIMEOUT_S:.0f} s") from None
        finally:
            process.kill()
    took_s, after = time.perf_counter() - begun, os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return Took(took_s, cpu_s, len(said.splitlines()), process.returncode, said)


def run(options: Options) -> Result:
    count = options.count or (QUICK if options.quick else HOSTS)
    result, rows = Result(), []
    with (
        tempfile.TemporaryDirectory(prefix="handfast-many-") as folder,
        Simulated(Path(folder), count) as there,
    ):
        file = str(there.file)
        commands: Sequence[tuple[str, tuple[str, ...]]] = (
            ("status", ("status", file)),
            ("logs", ("logs", file, "--lines", "1")),
            ("fetch", ("fetch", file, "--no-report", "--all", "--out", str(there.out()))),
            ("stop", ("stop", file)),
            ("down", ("down", file)),
        )
        for name, words in commands:
            took = command(there, *words)
            rows.append([name, *map(number, (took.wall_s, took.cpu_s, took.lines, took.status))])
            result.figures.append(Figure(f"{name} of {count} hosts", took.wall_s, "s"))
        there.reset()
        for name in ("status", "logs", "fetch", "down"):
            words = next(words for each, words in commands if each == name)
            if name == "fetch":
                words = (*words[:-1], str(there.out()))
            took = command(there, *words, interrupt_after_s=INTERRUPTED_AFTER_S)
            rows.append([f"{name}, Ctrl-C", *map(number, (took.wall_s, took.cpu_s, took.lines, took.status))])
            result.figures.append(
                Figure(f"{name} of {count} hosts: from Ctrl-C to its end", took.wall_s, "s")
            )
    result.details += table(("command", "s", "CPU s", "lines", "exit status"), rows)
    return result
