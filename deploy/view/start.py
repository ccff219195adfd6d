"""A mission that is started from a page, as ``handfast drive --detach`` does it."""

from __future__ import annotations

import subprocess
import threading
from typing import Final

from handfast.agent.messages.types import Message
from handfast.deploy.console.program import handfast

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
