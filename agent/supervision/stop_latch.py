"""The stop latch: how both processes of a robot take a stop and a resume (PURE)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from handfast.agent.messages.types import Resume, Stop

AWAITED: Final = "waiting to be told to resume"
"""How a reason ends where only a resume is missing."""


class StopLatch:
    """The last stop and the last resume. A stop holds until a later resume for this robot.

    What comes first does not matter, nor how often: only versions decide. So whoever missed one takes it
    from anybody that says both again.

    Args:
        robot: whose process this is.
        on_resume: called when a resume names this robot or all, stopped or not.

    Attributes:
        version: of the last stop or resume that is known, 0 when there was none.
        lasting: what a process that starts again has to know of them; another object when it has changed.
    """

    def __init__(self, robot: int, on_resume: Callable[[], None]) -> None:
        self._robot, self._on_resume = robot, on_resume
        self._stop: Stop | None = None
        self._resume: Resume | None = None
        self._own: Resume | None = None
        """Of the resumes that name this robot or all: the greatest of all may be another's."""
        self._ahead: Stop | None = None
        """The last that came from ahead of time: it is said more than once, and may be replayed."""
        self._ahead_version = -1
        """As which version it holds here, -1 for none."""
        self._reason = ""
        """Of the stop that came last."""
        self.version = 0
        self.lasting: tuple[Stop | Resume, ...] = ()

    def accept_stop(self, stop: Stop) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        if self._stop is not None and stop.version <= self._stop.version:
            return None if stop.version == self._stop.version else "out_of_order"
        self._stop, self._reason = stop, stop.reason
        self._changed(stop)
        return None

    def accept_resume(self, resume: Resume) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        mine, known = self._is_mine(resume), self._resume
        if mine:
            self._own = resume
            self._on_resume()
        newest = known is None or resume.version > known.version
        if newest:
            self._resume = resume
        if mine or newest:
            self._changed(resume)
            return None
        return None if known is not None and resume.version == known.version else "out_of_order"

    def accept_ahead(self, order: Stop | Resume, now_ns: int) -> str:
        """Takes an order that cannot have been given yet; returns why it is refused.

        An operator's clock, or this one, is wrong by more than a day. A stop is a stop: it holds as one that
        is given now, after all that is known, so that the next resume of right clocks ends it. It is none of
        what is acknowledged, kept and said again: others have their own now. The operator learns the time
        from who hears it, and says it again as of that.
        """
        if isinstance(order, Stop) and order != self._ahead:
            self._ahead, self._reason = order, order.reason
            self._ahead_version = max(now_ns // 1_000, self.version)
        return "future"

    def recall(self, order: Stop | Resume) -> None:
        """Takes an order that this robot had taken before its process started again: of what a resume did
        then, nothing is done once more."""
        if isinstance(order, Stop):
            self.accept_stop(order)
            return
        if self._is_mine(order):
            self._own = order
        if self._resume is None or order.version > self._resume.version:
            self._resume = order
        self._changed(order)

    def _is_mine(self, resume: Resume) -> bool:
        """Whether a resume is for this robot, and later than those that it has had."""
        is_for_it = not resume.robots or self._robot in resume.robots
        return is_for_it and (self._own is None or resume.version > self._own.version)

    def _changed(self, by: Stop | Resume) -> None:
        self.version = max(self.version, by.version)
        own = self._own if self._own is not self._resume else None
        self.lasting = tuple(order for order in (self._stop, self._resume, own) if order is not None)

    @property
    def stopped(self) -> str:
        """Why the robot must stand, "" when it need not. Of equal versions the stop holds."""
        version = max(self._ahead_version, -1 if self._stop is None else self._stop.version)
        if version < 0 or (self._own is not None and version < self._own.version):
            return ""
        return f"stop: {self._reason}" if self._reason else "stop"

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
