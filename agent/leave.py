"""Leave to drive again, as both processes of a robot take it (PURE)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from agent.messages import Resume

AWAITED: Final = "waiting to be told to resume"
"""How a reason ends to which nothing is left but this leave."""


class Leave:
    """Takes each version once, and only greater ones than before.

    Args:
        robot: whose process this is.
        grant: called when leave is given to it.
    """

    def __init__(self, robot: int, grant: Callable[[], None]) -> None:
        self._robot, self._grant = robot, grant
        self._version = -1

    def accept(self, resume: Resume) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        if resume.version < self._version:
            return "out_of_order"
        if resume.version > self._version and (not resume.robots or self._robot in resume.robots):
            self._version = resume.version
            self._grant()
        return None
