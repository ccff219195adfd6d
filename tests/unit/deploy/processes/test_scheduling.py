"""Who shares processors how: asked of the kernel."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from typing import Final

import pytest

from handfast.deploy.processes import attributes
from handfast.deploy.processes.attributes import (
    MANY,
    MANY_YIELDING,
    STARTING,
    YIELDING,
    interrupting_nobody,
    niceness,
)

TELL: Final = "import os; print(os.sched_getscheduler(0), os.nice(0))"


def started() -> tuple[int, ...]:
    """The policy and niceness of a process that is started now."""
    return tuple(map(int, subprocess.check_output([sys.executable, "-c", TELL]).split()))


def test_what_is_started_meanwhile_interrupts_nobody() -> None:
    policy, nice = os.sched_getscheduler(0), os.nice(0)
    seen: list[int] = []
    with interrupting_nobody():
        thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        assert started() == (os.SCHED_BATCH, nice)
    assert seen == [os.SCHED_BATCH]
    assert started() == (policy, nice), "a notebook goes on as it was"


def test_who_yields_is_nicer_once() -> None:
    code = "from handfast.deploy.processes.attributes import yield_at_start; "
    code += f"yield_at_start(); yield_at_start(); {TELL}"
    told = subprocess.check_output([sys.executable, "-c", code]).split()
    assert tuple(map(int, told)) == (os.SCHED_BATCH, max(os.nice(0), STARTING))


THREADS: Final = """
import os, threading
from handfast.deploy.processes.attributes import YIELDING, yield_at_start, yield_once_started
yield_at_start()
done = threading.Event()
thread = threading.Thread(target=done.wait)
thread.start()
yield_once_started(YIELDING)
print(os.nice(0), os.getpriority(os.PRIO_PROCESS, thread.native_id))
done.set()
"""


def test_who_has_started_is_nicer_with_all_its_threads() -> None:
    least = max(os.nice(0), STARTING) + YIELDING - STARTING
    told = subprocess.check_output([sys.executable, "-c", THREADS]).split()
    assert list(map(int, told)) == [min(19, least)] * 2


def test_more_than_a_hundred_leave_a_router_still_more() -> None:
    assert [niceness(robots) for robots in (30, MANY, MANY + 1)] == [YIELDING, YIELDING, MANY_YIELDING]


def test_a_system_that_has_no_such_thing_or_forbids_it_goes_without(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = os.sched_getscheduler(0)

    def forbidden(*_: object) -> None:
        raise PermissionError

    with monkeypatch.context() as patch:
        patch.setattr(os, "sched_setscheduler", forbidden)
        with interrupting_nobody():
            assert os.sched_getscheduler(0) == policy
    monkeypatch.setattr(attributes, "_BATCH", 0)
    with interrupting_nobody():
        assert os.sched_getscheduler(0) == policy
