"""Relayed orders: a robot repeats the mission, the last stop and the last resume to who lacks them (PURE).

Any robot that has an order relays it: there is no coordinator. Who lacks it shows in beacons, or
asks. Each says it on its own key (`agent.messages.key_expressions.relayed`), and mostly one does, since all
other agents hear that. Who may hear this robot alone, such as its plant, is told in any case, and so is what
it has just learnt; but of a large fleet, which learns a mission or a resume at once, only the first say that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.codec import Mark

AGAIN_NS: Final = NS_PER_S // 2
"""What was said is not said again for so long."""
LACKING_NS: Final = 2 * AGAIN_NS
"""To somebody who lacks it for so long it is said whoever else says it: he may not hear them, or one of them
lies to be heard by all but him."""
SPREAD_NS: Final = NS_PER_S // 50
"""Robots wait for different times, in steps of this: mostly one says it and the others hear it. Who ticks
more seldom than that needs longer ones."""
STEPS: Final = 8


class Gossip:
    """When robot `robot` says one thing again.

    Args:
        known: what this robot has of the thing; it is relayed to who has less.
        step_ns: robots wait for different times, in steps of this.
        is_shared: so many learn it at once that it is left to the first of them to say it at once; who lacks
            it then will show it.
    """

    def __init__(
        self, robot: int, known: Callable[[], Mark], step_ns: int = SPREAD_NS, *, is_shared: bool = False
    ) -> None:
        self._wait_ns, self._is_shared = step_ns * (robot % STEPS), is_shared
        self._known = known
        self._due_ns: int | None = None
        self._is_last_moment = False
        """Whether that is for somebody who has lacked it for so long that what others say does not count."""
        self._lacked_ns: int | None = None
        self._lacked_last_ns = 0
        self._said_ns = -AGAIN_NS
        self._insists = False

    def insist(self) -> None:
        """Somebody may hear this robot and nobody else: it is said here, whoever else says it."""
        self._insists = True

    def learnt(self, now_ns: int) -> None:
        """This robot has it from now on."""
        if self._is_shared:
            self.asked(now_ns)
        else:
            self.insist()

    def lacks(self, now_ns: int, mark: Mark) -> None:
        """Somebody has acknowledged only this much of it."""
        if mark >= self._known():
            return
        if self._lacked_ns is None or now_ns > self._lacked_last_ns + AGAIN_NS:
            self._lacked_ns = now_ns
        self._lacked_last_ns = now_ns
        if self._due_ns is None:
            last_ns = self._lacked_ns + LACKING_NS
            from_ns = max(now_ns, min(self._said_ns + AGAIN_NS, last_ns))
            self._due_ns, self._is_last_moment = from_ns + self._wait_ns, from_ns >= last_ns

    def asked(self, now_ns: int) -> None:
        """Somebody asks for it, who may not hear what others have said."""
        if self._due_ns is None:
            self._due_ns, self._is_last_moment = now_ns + self._wait_ns, False

    def said(self, now_ns: int, mark: Mark) -> None:
        """Somebody has said as much of it, maybe this robot."""
        if mark < self._known():
            return
        self._said_ns = now_ns
        if not self._is_last_moment:
            self._due_ns = None

    def due(self, now_ns: int) -> bool:
        """Whether to say it now."""
        if not self._insists and (self._due_ns is None or now_ns < self._due_ns):
            return False
        self._said_ns, self._insists = now_ns, False
        self._due_ns = self._lacked_ns = None
        self._is_last_moment = False
        return True
