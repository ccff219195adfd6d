"""What a page's server runs beside a fleet: the page of a drive, and drives that are started from a page."""

from __future__ import annotations

import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from handfast.agent.messages.types import Message
from handfast.deploy.console.data_files import handfast
from handfast.deploy.console.interrupt import Interrupt

OVER: Final = b"over\n"
"""Says that the drive is over, and its recording not complete yet."""
RECORDED: Final = b"recorded\n"
"""Says that the recording is complete."""
END_S: Final = 5.0
POLL_S: Final = 0.1


class PageBeside:
    """``handfast view`` of the run in `folder`, from its start on. A context manager; it ends with this
    process, however that ends.

    Args:
        wanted: whether there is to be one at all.
        interrupt: whose Ctrl-C ends it, once the run is over; one that has ended the drive has ended it, too.
    """

    def __init__(self, folder: Path, interrupt: Interrupt, *, wanted: bool) -> None:
        self._folder, self._interrupt, self._is_wanted = folder, interrupt, wanted
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> PageBeside:
        if self._is_wanted:
            self._process = subprocess.Popen(
                handfast("view", str(self._folder), "--beside"),
                stdin=subprocess.PIPE,
                start_new_session=True,  # a Ctrl-C is for the drive, which goes on to its end in order
            )
        return self

    def __exit__(self, *_: object) -> None:
        process = self._process
        if process is None or process.stdin is None:
            return
        with suppress(OSError):
            process.stdin.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def over(self) -> None:
        """The drive is over: pages keep what they have until there is a recording."""
        self._say(OVER)

    def recorded(self) -> None:
        """The recording is complete: pages show that, until Ctrl-C."""
        self._say(RECORDED)
        while self._process is not None and self._process.poll() is None and not self._interrupt.count:
            time.sleep(POLL_S)

    def _say(self, what: bytes) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # it has ended, and that is no matter of the drive
                self._process.stdin.write(what)
                self._process.stdin.flush()


LINES_MAX: Final = 20


class StartUnderWay:
    """The command in a process of its own: it has links of its own, and says what it waits for.

    Args:
        fleet: the fleet file that the robots read, or the fleet's name.
        resume: lifts a stop that somebody has ordered.
    """

    what: Final = "start the mission"

    def __init__(self, fleet: str, robots: int, *, resume: bool) -> None:
        self._process = subprocess.Popen(
            handfast("drive", fleet, "--detach", *(["--resume"] * resume)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # a Ctrl-C is for the page's server, and leaves what is ordered as it is
        )
        self._robots = robots
        self._lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as said:
            for line in said:
                self._lines = [*self._lines, line.strip()][-LINES_MAX:]

    @property
    def is_over(self) -> bool:
        return self._process.poll() is not None and not self._reader.is_alive()

    @property
    def done(self) -> bool:
        return self.is_over and self._process.returncode == 0

    @property
    def count(self) -> tuple[int, int]:
        return (self._robots if self.done else 0), self._robots

    def lines(self) -> list[str]:
        return list(self._lines)

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Nothing: it hears for itself."""

    def step(self, now_ns: int) -> None:
        """Nothing: it goes on by itself."""
