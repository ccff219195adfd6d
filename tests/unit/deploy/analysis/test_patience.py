"""handfast.deploy.analysis.patience: code of others that never returns does not hold up the rest."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from handfast.agent.control.own_law import LawError
from handfast.deploy.analysis import patience
from handfast.deploy.analysis.patience import answer

ROOT = Path(__file__).parents[4]


class OfOthers(Exception):
    """Survives no pickle: it cannot be made of its one argument, for which Dask, once imported, makes up,
    and it holds what no pickle does."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(one + two)
        self.lock = threading.Lock()


def test_what_returns_or_raises_does_so() -> None:
    assert answer("it", lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        answer("it", lambda: 1 // 0)


def test_what_does_not_return_is_not_waited_for() -> None:
    hangs = threading.Event()
    with pytest.raises(TimeoutError, match=r"^modes\(\) did not return within 0.01 s$"):
        answer("modes()", hangs.wait, seconds=0.01)
    hangs.set()


def test_one_that_holds_the_interpreter_is_not_waited_for() -> None:
    with pytest.raises(TimeoutError):
        answer("it", lambda: sum(range(10**9)), seconds=0.05)


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


def test_what_it_changes_stays_with_it() -> None:
    changed: list[int] = []
    answer("it", lambda: changed.append(1))
    assert changed == []


def test_exceptions_come_back_in_one_line() -> None:
    def raises(error: Exception) -> None:
        raise error

    with pytest.raises(LawError, match=r"^law a:B: what it did$"):
        answer("it", lambda: raises(LawError("law a:B: what it did")))
    with pytest.raises(RuntimeError, match=r"^OfOthers: one two \(.*test_patience.py:\d+\)$"):
        answer("it", lambda: raises(OfOthers("one ", "two")))
    with pytest.raises(RuntimeError, match="pickle"):
        answer("it", lambda: lambda: 1)


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


def test_what_is_printed_is_printed_once() -> None:
    code = "from handfast.deploy.analysis.patience import answer; "
    code += "print(1); answer('it', lambda: print(2)); print(3)"
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert printed.stdout.split() == ["1", "2", "3"]


def test_where_processes_cannot_be_copied_it_is_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "_FORKS", False)
    test_what_returns_or_raises_does_so()
    test_what_does_not_return_is_not_waited_for()
