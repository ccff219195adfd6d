"""The stop latch: how both processes of a robot take a stop and a resume (PURE)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from agent.messages.types import Resume, Stop

AWAITED: Final = "waiting to be told to resume"
"""How a reason ends where only a resume is missing."""

_NEVER: Final = -1


class StopLatch:
    """The last stop and the last resume. A stop holds until a later resume for this robot.

    What comes first does not matter, nor how often: only versions decide. So whoever missed one takes it
    from anybody that says both again.

    Args:
        robot: whose process this is.
        on_resume: called when a resume names this robot or all, stopped or not.

    Attributes:
        version: of the last stop or resume that is known, 0 when there was none.
    """

    def __init__(self, robot: int, on_resume: Callable[[], None]) -> None:
        self._robot, self._on_resume = robot, on_resume
        self._stop: Stop | None = None
        self._resume: Resume | None = None
        self._resumed = _NEVER
        self.version = 0

    def accept_stop(self, stop: Stop) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        if self._stop is not None and stop.version <= self._stop.version:
            return None if stop.version == self._stop.version else "out_of_order"
        self._stop = stop
        self.version = max(self.version, stop.version)
        return None

    def accept_resume(self, resume: Resume) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        # Of resumes for single robots, the greatest may be another's: what counts here is the own greatest.
        mine = (not resume.robots or self._robot in resume.robots) and resume.version > self._resumed
        if mine:
            self._resumed = resume.version
            self._on_resume()
        if self._resume is not None and resume.version <= self._resume.version:
            return None if mine or resume.version == self._resume.version else "out_of_order"
        self._resume = resume
        self.version = max(self.version, resume.version)
        return None

    @property
    def stopped(self) -> str:
        """Why the robot must stand, "" when it need not. Of equal versions the stop holds."""
        if self._stop is None or self._stop.version < self._resumed:
            return ""
        return f"stop: {self._stop.reason}" if self._stop.reason else "stop"

    @property
    def mark(self) -> tuple[int, int]:
        """What is known here, to compare: versions of the last stop and of the last resume, -1 for none."""
        return (
            -1 if self._stop is None else self._stop.version,
            -1 if self._resume is None else self._resume.version,
        )

    @property
    def latest(self) -> tuple[Stop | Resume, ...]:
        """What to say again to somebody that missed it, the stop first."""
        return tuple(message for message in (self._stop, self._resume) if message is not None)
