"""Things that are done at once: all of them are, whatever becomes of the processes that do them.

What forks is tried in a process that has just begun: that of a test may have threads, and is not forked then.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from handfast.deploy.report import plotting as module
from handfast.deploy.report.plotting import side_by_side

TIMEOUT_S = 60.0


def tried(scenario: Callable[..., None], *about: object) -> None:
    """Has a scenario tried in a process of its own."""
    process = multiprocessing.get_context("spawn").Process(target=scenario, args=about)
    process.start()
    process.join(TIMEOUT_S)
    if process.exitcode is None:
        process.kill()
        process.join()
    assert process.exitcode == 0


def by(path: Path) -> int:
    """Which process has written a file."""
    return int(path.read_text())


def writes(path: Path) -> None:
    path.write_text(str(os.getpid()))


def waits_for(path: Path, other: Path) -> None:
    """Writes a file, and waits until another is there."""
    writes(path)
    until = time.monotonic() + 20.0
    while not other.exists():
        assert time.monotonic() < until
        time.sleep(0.005)


def wait_for_each_other(folder: Path) -> None:
    a, b = folder / "a", folder / "b"
    side_by_side([partial(waits_for, a, b), partial(waits_for, b, a)], processes=2)
    assert len({by(a), by(b)}) == 2
    assert os.getpid() in (by(a), by(b))


def test_two_that_wait_for_each_other_are_done_at_once(tmp_path: Path) -> None:
    tried(wait_for_each_other, tmp_path)


def test_one_process_does_all_in_order() -> None:
    done: list[int] = []
    side_by_side([partial(done.append, number) for number in range(4)], processes=1)
    assert done == [0, 1, 2, 3]


def with_a_thread(folder: Path) -> None:
    paths = [folder / str(number) for number in range(4)]
    waiting = threading.Event()
    thread = threading.Thread(target=waiting.wait)
    thread.start()
    try:
        side_by_side([partial(writes, path) for path in paths], processes=4)
    finally:
        waiting.set()
        thread.join()
    assert {by(path) for path in paths} == {os.getpid()}


def test_a_process_with_other_threads_is_not_forked(tmp_path: Path) -> None:
    tried(with_a_thread, tmp_path)


def is_killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fails() -> None:
    raise ZeroDivisionError


def fork_ends(folder: Path, how: Callable[[], None]) -> None:
    here, begun = os.getpid(), folder / "begun"

    def task(path: Path) -> None:
        if os.getpid() != here:
            begun.touch()
            how()
        waits_for(path, begun)  # so the fork has taken the other one

    paths = [folder / "a", folder / "b"]
    side_by_side([partial(task, path) for path in paths], processes=2)
    assert {by(path) for path in paths} == {here}


@pytest.mark.slow
@pytest.mark.parametrize("how", [is_killed, fails])
def test_what_a_fork_does_not_finish_is_done_here(tmp_path: Path, how: Callable[[], None]) -> None:
    tried(fork_ends, tmp_path, how)


def is_interrupted() -> None:
    forks: list[int] = []
    real = module._fork

    def fork(*about: object) -> int:
        forks.append(real(*about))  # type: ignore[arg-type]
        return forks[-1]

    module._fork = fork
    here = os.getpid()

    def task() -> None:
        if os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(60.0)

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        side_by_side([task, task], processes=2)
    assert time.monotonic() - begun < 30.0
    (number,) = forks
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


@pytest.mark.slow
def test_what_is_raised_is_raised_here_and_no_process_stays() -> None:
    tried(is_interrupted)
