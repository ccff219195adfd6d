"""handfast.deploy.analysis.patience: code of others that never returns does not hold up the rest."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from handfast.deploy.analysis.patience import answer


def test_what_returns_or_raises_does_so() -> None:
    assert answer("it", lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        answer("it", lambda: 1 // 0)


def test_what_does_not_return_is_not_waited_for() -> None:
    hangs = threading.Event()
    with pytest.raises(TimeoutError, match=r"^modes\(\) did not return within 0.01 s$"):
        answer("modes()", hangs.wait, seconds=0.01)
    hangs.set()


@pytest.mark.parametrize(
    ("end", "how"),
    [
        (lambda: os._exit(7), "status 7"),
        (lambda: os._exit(0), "status 0"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "SIGKILL"),
    ],
)
def test_one_that_ends_its_process_ends_no_other(end: object, how: str) -> None:
    with pytest.raises(ChildProcessError, match=rf"^it ended its process \({how}\)$"):
        answer("it", end)  # type: ignore[arg-type]


def test_an_interrupt_ends_both(tmp_path: Path) -> None:
    place = tmp_path / "pid"

    def hangs() -> None:
        (tmp_path / "new").write_text(str(os.getpid()))
        (tmp_path / "new").rename(place)
        time.sleep(60.0)

    def interrupt() -> None:
        while not place.exists():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            answer("it", hangs)
    finally:
        signal.signal(signal.SIGINT, before)
    with pytest.raises(ProcessLookupError):
        os.kill(int(place.read_text()), 0)
