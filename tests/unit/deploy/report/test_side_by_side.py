"""Things that are done at once: all of them are, whatever becomes of the processes that do them."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from deploy.report import side_by_side as module
from deploy.report.side_by_side import side_by_side

pytestmark = pytest.mark.skipif(
    threading.active_count() > 1 or "zenoh" in sys.modules, reason="this process cannot be forked"
)


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


def test_two_that_wait_for_each_other_are_done_at_once(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    side_by_side([partial(waits_for, a, b), partial(waits_for, b, a)], processes=2)
    assert len({by(a), by(b)}) == 2
    assert os.getpid() in (by(a), by(b))


def test_one_process_does_all_in_order() -> None:
    done: list[int] = []
    side_by_side([partial(done.append, number) for number in range(4)], processes=1)
    assert done == [0, 1, 2, 3]


def test_a_process_with_other_threads_is_not_forked(tmp_path: Path) -> None:
    paths = [tmp_path / str(number) for number in range(4)]
    waiting = threading.Event()
    thread = threading.Thread(target=waiting.wait)
    thread.start()
    try:
        side_by_side([partial(writes, path) for path in paths], processes=4)
    finally:
        waiting.set()
        thread.join()
    assert {by(path) for path in paths} == {os.getpid()}


@pytest.mark.parametrize("how", [lambda: os.kill(os.getpid(), signal.SIGKILL), lambda: 1 // 0])
def test_what_a_fork_does_not_finish_is_done_here(tmp_path: Path, how: Callable[[], object]) -> None:
    here, begun = os.getpid(), tmp_path / "begun"

    def task(path: Path) -> None:
        if os.getpid() != here:
            begun.touch()
            how()
        waits_for(path, begun)  # so the fork has taken the other one

    paths = [tmp_path / "a", tmp_path / "b"]
    side_by_side([partial(task, path) for path in paths], processes=2)
    assert {by(path) for path in paths} == {here}


def test_what_is_raised_is_raised_here_and_no_process_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    forks: list[int] = []
    real = module._fork
    monkeypatch.setattr(module, "_fork", lambda *about: forks.append(real(*about)) or forks[-1])
    here = os.getpid()

    def task() -> None:
        if os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(60.0)

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        side_by_side([task, task], processes=2)
    assert time.monotonic() - begun < 30.0
    (fork,) = forks
    with pytest.raises(ProcessLookupError):
        os.kill(fork, 0)
