"""What a robot says again so that others catch up: the mission, and the last stop and leave to drive (PURE).

Any robot that knows tells one that does not: there is no coordinator. Who does not know shows in beacons, or
asks. It is said on the keys on which operators say it, so everybody hears it, and is not said twice at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from agent.clock import NS_PER_S

AGAIN_NS: Final = NS_PER_S // 2
"""What was said is not said again for so long."""
SPREAD_NS: Final = NS_PER_S // 50
"""Robots wait for different times, in steps of this: mostly one says it and the others hear it."""
STEPS: Final = 8


Mark = tuple[int, int]
"""What somebody knows of a thing, such as its version and what tells those of one version apart."""


class Gossip:
    """When robot `robot` says one thing again.

    Args:
        known: what is known of the thing here; who knows less is told.
    """

    def __init__(self, robot: int, known: Callable[[], Mark]) -> None:
        self._wait_ns = SPREAD_NS * (robot % STEPS)
        self._known = known
        self._due_ns: int | None = None
        self._said_ns = -AGAIN_NS

    def lacks(self, now_ns: int, mark: Mark) -> None:
        """Somebody knows only this much of it."""
        if mark < self._known() and self._due_ns is None:
            self._due_ns = max(now_ns, self._said_ns + AGAIN_NS) + self._wait_ns

    def asked(self, now_ns: int) -> None:
        """Somebody asks for it, who may not hear what others have said."""
        if self._due_ns is None:
            self._due_ns = now_ns + self._wait_ns

    def said(self, now_ns: int, mark: Mark) -> None:
        """Somebody has said as much of it, maybe this robot."""
        if mark >= self._known():
            self._said_ns, self._due_ns = now_ns, None

    def due(self, now_ns: int) -> bool:
        """Whether to say it now."""
        if self._due_ns is None or now_ns < self._due_ns:
            return False
        self._said_ns, self._due_ns = now_ns, None
        return True
