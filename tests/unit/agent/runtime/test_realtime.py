"""What a process asks the system for that wants real time; each time in a process of its own."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from types import SimpleNamespace

import pytest

from handfast.agent.runtime import realtime
from handfast.agent.runtime.realtime_granted import Granted, from_json
from tests.process.harness import ROOT
from tests.realtime_here import need_realtime, without

ASKS = [sys.executable, "-P", "-m", "handfast.agent.runtime.realtime"]
BEGIN = """
import os, subprocess, sys, threading, time
from handfast.agent.fleet.hosts import ProcessSection
from handfast.agent.runtime.realtime import RealTime
def policy(thread):
    return os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(thread).sched_priority
def thread(call):
    made = threading.Thread(target=call); made.start(); made.join()
"""


def run(text: str, *before: str) -> str:
    """What a Python program prints, whose log is its standard error."""
    done = subprocess.run(
        [*before, sys.executable, "-P", "-c", BEGIN + text],
        capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def asked(*arguments: str, before: tuple[str, ...] = ()) -> Granted:
    done = subprocess.run(
        [*before, *ASKS, *arguments],
        capture_output=True, text=True, timeout=60, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    found = from_json(json.loads(done.stdout))
    assert found is not None
    return found


@pytest.mark.realtime
def test_it_is_granted_as_it_was_asked_for() -> None:
    need_realtime()
    core = min(os.sched_getaffinity(0))
    found = asked("--role", "plant", "--cpus", str(core))
    assert (found.fifo, found.cpus) == (42, (core,))
    assert asked("--role", "agent").fifo == 41


@pytest.mark.slow
def test_what_is_refused_ends_nothing_and_is_said() -> None:
    """The real system refuses: no capability, and limits that do not allow it."""
    limits = ("prlimit", "--rtprio=0:0", "--memlock=65536:65536")
    refused = (*limits, *without("sys_nice", "ipc_lock", "sys_resource"))
    found = asked("--role", "agent", "--cpus", "1000", before=refused)
    assert (found.fifo, found.locked, found.rtprio, found.memlock) == (0, False, 0, 65536)
    assert found.cpus == tuple(sorted(os.sched_getaffinity(0)))
    said = run(
        "RealTime(ProcessSection(realtime=True), 'agent', lambda text: print('log:', text)).lead()", *refused
    )
    assert "log: realtime: cores" in said
    assert "RLIMIT_RTPRIO is 0, 42 is needed" in said
    assert "RLIMIT_MEMLOCK is 64 kB" in said


@pytest.mark.parametrize(
    ("limit", "capable", "locks"),
    [(resource.RLIM_INFINITY, False, True), (8 << 30, True, True), (8 << 30, False, False)],
)
def test_memory_is_not_locked_up_to_a_limit(
    limit: int, capable: bool, locks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It could be: and whatever the process got beyond that would be refused to it."""
    called: list[int] = []
    monkeypatch.setattr(realtime.resource, "getrlimit", lambda _: (0, limit))
    monkeypatch.setattr(realtime.resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(realtime, "is_capable", lambda _: capable)
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda _: SimpleNamespace(mlockall=called.append))
    realtime._lock_memory()
    assert len(called) == locks


@pytest.mark.realtime
def test_threads_that_carry_messages_get_it_and_what_starts_later_does_not() -> None:
    need_realtime()
    told = run(
        """
real = RealTime(ProcessSection(realtime=True), 'agent', lambda _: None)
go = threading.Event()
thread(lambda: print('links', policy(threading.get_native_id())))
real.lead()
print('loop', policy(0))
thread(lambda: print('later', policy(threading.get_native_id())))
print('child', subprocess.run(['chrt', '-p', '0'], capture_output=True, text=True).stdout.split()[5])
"""
    )
    fifo, other = os.SCHED_FIFO, os.SCHED_OTHER
    assert told == f"links ({fifo}, 40)\nloop ({fifo}, 41)\nlater ({other}, 0)\nchild SCHED_OTHER\n"


@pytest.mark.realtime
def test_one_that_runs_on_end_gives_it_up_and_goes_on() -> None:
    """With the time of a few ticks of the scheduler, and without the right to take it back."""
    need_realtime()
    told = run(
        """
from handfast.agent.runtime import realtime
realtime.OVERRUN_S = 0.1
RealTime(ProcessSection(realtime=True), 'agent', lambda text: print('log:', text)).lead()
end = time.monotonic() + 10
while policy(0)[0] == os.SCHED_FIFO and time.monotonic() < end:
    pass
print('loop', policy(0))
"""
    )
    assert "log: realtime given up: a thread has run for 0.1 s without waiting" in told
    assert told.endswith(f"loop ({os.SCHED_OTHER}, 0)\n")


@pytest.mark.slow
@pytest.mark.realtime
def test_one_that_hears_no_signal_is_killed_by_the_kernel() -> None:
    need_realtime()
    done = subprocess.run(
        [
            sys.executable, "-P", "-c",
            BEGIN + "from handfast.agent.runtime import realtime\n"
            "realtime.OVERRUN_S, realtime.KILLED_S = 0.1, 0.3\n"
            "RealTime(ProcessSection(realtime=True), 'agent', print).lead()\n"
            "sum(range(10 ** 12))\n",
        ],
        capture_output=True, timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == -9, done.stderr
