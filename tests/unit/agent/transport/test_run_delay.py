"""handfast.agent.transport.run_delay: what the kernel says, and where it says nothing."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import pytest

from handfast.agent.transport.run_delay import run_delay_ns

HERE = "handfast.agent.transport.run_delay._TASKS"


def test_it_is_that_of_all_threads_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for thread, text in {"7": "5000 300 2\n", "8": "1 40 1\n"}.items():
        (tmp_path / thread).mkdir()
        (tmp_path / thread / "schedstat").write_text(text)
    monkeypatch.setattr(HERE, tmp_path)
    assert run_delay_ns() == 340


def test_what_has_ended_or_says_something_else_is_left_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for thread, text in {"7": "5000 300 2\n", "8": "", "9": "a b c\n", "10": None}.items():
        (tmp_path / thread).mkdir()
        if text is not None:
            (tmp_path / thread / "schedstat").write_text(text)
    monkeypatch.setattr(HERE, tmp_path)
    assert run_delay_ns() == 300


def test_a_system_that_does_not_say_is_one_without_delay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(HERE, tmp_path / "none")
    assert run_delay_ns() == 0


@pytest.mark.skipif(sys.platform != "linux" or not Path("/proc/self/schedstat").exists(), reason="Linux only")
def test_threads_that_share_one_core_wait_for_it() -> None:
    allowed = os.sched_getaffinity(0)
    waited_ns = run_delay_ns()
    try:
        os.sched_setaffinity(0, {min(allowed)})
        ended = threading.Event()

        def works() -> None:
            # Without the interpreter's lock, so that both are ready to run.
            while not ended.is_set():
                sum(os.urandom(1 << 20)[:1])

        thread = threading.Thread(target=works)
        thread.start()
        until_s = time.monotonic() + 20.0
        while time.monotonic() < until_s and run_delay_ns() - waited_ns < 20_000_000:
            sum(os.urandom(1 << 20)[:1])
        found_ns = run_delay_ns() - waited_ns  # a thread that has ended is not counted
        ended.set()
        thread.join()
        assert found_ns >= 20_000_000
    finally:
        os.sched_setaffinity(0, allowed)
