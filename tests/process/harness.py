"""Real processes under a test's eyes, `handfast` among them, and how to wait for what they do.

Nothing here sleeps for luck: `wait_for` and its users wait for a condition, with a deadline that
only a fault reaches, and then say what the processes said last.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

ROOT: Final = Path(__file__).parents[2]
ADDRESS: Final = "127.0.0.1"
PATIENCE_S: Final = 60.0
"""How long a test waits for whatever it waits for: only a fault takes so long, on any busy machine."""
POLL_S: Final = 0.002
BUSY_SETTINGS: Final = ("fleet.rate_hz=25", "control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5")
"""For a busy machine: its robots shall be judged, not the scheduler."""
BUSY: Final = tuple(word for setting in BUSY_SETTINGS for word in ("--set", setting))
"""The same as options of a command, where the verdict on a run counts."""
TROUBLE: Final = ("Traceback", "Error:", "Exception", "panicked", "Warning:")
"""What no process of ours ever prints."""
T = TypeVar("T")


def wait_for(
    look: Callable[[], T], what: str, timeout_s: float = PATIENCE_S, report: Callable[[], str] | None = None
) -> T:
    """Calls `look` until it gives something true, and returns that; fails the test after `timeout_s`.

    Args:
        what: what is waited for, for the failure's text.
        report: more for that text, such as the last lines of the processes.
    """
    deadline = time.monotonic() + timeout_s
    while not (found := look()):
        if time.monotonic() > deadline:
            more = f"\n{report()}" if report is not None else ""
            raise AssertionError(f"{what}: not within {timeout_s:g} s{more}")
        time.sleep(POLL_S)
    return found


def measured(what: str, value: float) -> float:
    """Leaves a number in the test's output (``pytest -rP`` shows it); returns it."""
    print(f"measured {what}: {value:.3g}")
    return value


def environment() -> dict[str, str]:
    """For a process of this source tree, whichever is installed."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1"}


def running(pid: int) -> bool:
    """Whether a process runs; a zombie, which only waits for its parent to ask, does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X")


def children(pid: int) -> dict[int, str]:
    """The processes that `pid` has started, or those that it started, and that run: pid -> command line."""
    found, parents = {}, [pid]
    while parents:
        for listing in Path(f"/proc/{parents.pop()}/task").glob("*/children"):
            try:
                for child in map(int, listing.read_text().split()):
                    parents.append(child)
                    if running(child):
                        found[child] = _command(child)
            except OSError:
                continue
    return found


def last_lines(path: Path, count: int = 8) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()[-count:]
    except OSError:
        return []


def no_trouble(text: str, source: str) -> None:
    """Fails the test when `text` holds a traceback or a warning."""
    for line in text.splitlines():
        assert not any(word in line for word in TROUBLE), f"{source} says:\n{text[-3000:]}"


def no_trouble_in_logs(folder: Path) -> None:
    logs = sorted((folder / "logs").glob("*.log"))
    assert logs, f"{folder} has no logs"
    for log in logs:
        no_trouble(log.read_text(errors="replace"), log.name)


# ---------------------------------------------------------------------- the command


class Command:
    """`handfast ARGUMENTS` as a process; leaving it ends whatever is left. Its output is read by file.

    Args:
        folder: where its output goes, and its working directory.
        tty: open file descriptor of a terminal to give it instead, as its controlling terminal.
    """

    _TAKE_TERMINAL: Final = (
        "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
        "os.execv(sys.argv[1], sys.argv[1:])"
    )

    def __init__(self, folder: Path, *arguments: str, tty: int | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.arguments = arguments
        self.out_file, self.err_file = folder / "stdout", folder / "stderr"
        command = [sys.executable, "-P", "-m", "handfast.deploy.cli", *arguments]
        self.begun = time.monotonic()
        with open(self.out_file, "wb") as out, open(self.err_file, "wb") as err:
            if tty is None:
                streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": err}
            else:
                streams = {"stdin": tty, "stdout": tty, "stderr": tty}
                command = [sys.executable, "-c", self._TAKE_TERMINAL, *command]
            self.process = subprocess.Popen(
                command, cwd=folder, env=environment(), start_new_session=True, **streams
            )
        self.alive_s = float("nan")
        """How long after the command all were alive, when the test has looked."""
        self.seen: dict[int, str] = {}

    def __enter__(self) -> Command:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        left = self.children()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for pid in {*left, *self.seen}:
            if running(pid) and "--robot" in _command(pid):
                os.kill(pid, signal.SIGKILL)

    @property
    def out(self) -> str:
        return self.out_file.read_text(errors="replace")

    @property
    def err(self) -> str:
        return self.err_file.read_text(errors="replace")

    def children(self) -> dict[int, str]:
        """The processes of its robots that run now; remembered, to be ended in any case."""
        found = {pid: text for pid, text in children(self.process.pid).items() if "--robot" in text}
        self.seen |= found
        return found

    def child(self, robot: int, role: str) -> int:
        """pid of one robot's agent or plant."""
        wanted = f"-m handfast.{role} "
        for pid, text in self.children().items():
            if wanted in text and f"--robot {robot} " in f"{text} ":
                return pid
        raise AssertionError(f"no {role} of robot {robot} among {self.children()}")

    def told(self) -> str:
        return (
            f"handfast {' '.join(self.arguments)}: status {self.process.poll()}\n"
            f"--- stdout\n{self.out[-2000:]}\n--- stderr\n{self.err[-2000:]}"
        )

    def wait_for_line(self, pattern: str, timeout_s: float = PATIENCE_S) -> re.Match[str]:
        """Waits until standard error has `pattern`; fails when the command ends without."""

        def look() -> re.Match[str] | None:
            ended = self.process.poll() is not None
            found = re.search(pattern, self.err)
            assert found or not ended, f"ended without a line like {pattern!r}\n{self.told()}"
            return found

        found = wait_for(look, f"a line like {pattern!r}", timeout_s, self.told)
        assert found is not None
        return found

    def wait_until_driving(self) -> None:
        """Waits until the fleet has driven for 2 s at least: its robots are fast then."""
        self.wait_for_line(r"(?m)^ +(?:[2-9]|\d\d)\.\d s .* all running(, faults: .*)?$")
        self.children()

    def wait_until_gone(self, pids: Sequence[int], timeout_s: float = PATIENCE_S) -> float:
        """Waits until none of `pids` runs; returns how long that took, s."""
        begun = time.monotonic()
        wait_for(
            lambda: not any(map(running, pids)),
            f"{len(pids)} processes gone",
            timeout_s,
            lambda: "\n".join([f"{pid}: {_command(pid)}" for pid in pids if running(pid)] + [self.told()]),
        )
        return time.monotonic() - begun

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Waits for its end; returns its exit status. No traceback is allowed, nor a process left."""
        try:
            status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout_s:g} s\n{self.told()}") from None
        for source, text in (("stdout", self.out), ("stderr", self.err)):
            no_trouble(text, f"handfast {' '.join(self.arguments)} ({source})")
        left = [f"{pid}: {_command(pid)}" for pid in self.seen if running(pid)]
        assert not left, f"left running: {left}\n{self.told()}"
        return status


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""
