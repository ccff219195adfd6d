"""`handfast run` of a fleet that asks for real time: what its processes have and what it says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from handfast.agent.messages.key_expressions import ROLES
from tests.process.harness import Command, environment, last_lines
from tests.realtime_here import need_realtime, without

pytestmark = [pytest.mark.long, pytest.mark.alone]
ROBOTS = (1, 2)
OPTIONS = ("--no-report", "--set", "network.base_port=21560", "--set", "process.realtime=true")


def policy(thread: int) -> tuple[int, int]:
    """Policy and priority of a thread or process."""
    found = os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK
    return found, os.sched_getparam(thread).sched_priority


@pytest.mark.realtime
def test_loops_and_links_are_before_everything_else_and_it_is_said_once(tmp_path: Path) -> None:
    need_realtime()
    core = min(os.sched_getaffinity(0))
    with Command(
        tmp_path, "run", "pair", "--duration", "2", "--out", str(tmp_path / "out"),
        "--set", f"process.cpus=[{core}]", *OPTIONS,
    ) as command:  # fmt: skip
        command.wait_for_line(r"realtime plant: ")
        for robot in ROBOTS:
            for role, priority in zip(ROLES, (41, 42), strict=True):
                pid = command.child(robot, role)
                assert policy(pid) == (os.SCHED_FIFO, priority)
                assert os.sched_getaffinity(pid) == {core}
                tasks = Path(f"/proc/{pid}/task")
                links = [task for task in tasks.iterdir() if (task / "comm").read_text().startswith("app-")]
                assert links
                for task in links:
                    assert policy(int(task.name)) == (os.SCHED_FIFO, 40)
                    assert os.sched_getaffinity(int(task.name)) == {core}
        assert policy(command.process.pid) == (os.SCHED_OTHER, 0), "the command is no robot"
        command.wait()
    for role, priority in zip(ROLES, (41, 42), strict=True):
        said = f"realtime {role}: SCHED_FIFO {priority}, core {core}"
        assert command.err.count(said) == 1, command.told()
    assert "warning: robots" not in command.err


def test_what_is_refused_is_said_once_and_it_drives(tmp_path: Path) -> None:
    words = [
        *without("sys_nice", "ipc_lock", "sys_resource"),
        sys.executable,
        "-P",
        "-m",
        "handfast.deploy.cli",
        "run",
    ]
    words += ["pair", "--duration", "1", "--out", str(tmp_path / "out"), *OPTIONS]
    done = subprocess.run(
        ["prlimit", "--rtprio=0:0", "--memlock=65536:65536", *words],
        capture_output=True, text=True, timeout=120, env=environment(),
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    (warning,) = [line for line in done.stderr.splitlines() if "realtime" in line]
    assert warning.startswith("warning: robots 1 and 2: realtime: core")
    assert "SCHED_FIFO refused: RLIMIT_RTPRIO is 0, 42 is needed" in warning
    assert "memory not locked: RLIMIT_MEMLOCK is 64 kB" in warning
    logs = tmp_path / "out" / "logs"
    for robot in ROBOTS:
        for role in ROLES:
            lines = last_lines(logs / f"robot-{robot}-{role}.log", 20)
            assert sum("realtime: core" in line for line in lines) == 1, lines
            assert any(line.endswith(("running", "driving")) for line in lines), lines


def test_nobody_has_it_who_did_not_ask(tmp_path: Path) -> None:
    with Command(
        tmp_path, "run", "pair", "--duration", "1", "--out", str(tmp_path / "out"), *OPTIONS[:-2]
    ) as command:
        command.wait_for_line(r"all 4 processes alive")
        assert policy(command.child(1, "agent")) == (os.SCHED_OTHER, 0)
        command.wait()
    assert "realtime" not in command.err
