"""The operators' orders that outlive a process, and which of them are where they outlast it (PURE).

A robot acknowledges an order to operators when it is kept: on its disk, where it has one to keep orders on.
It obeys at once.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.agent.supervision.stop_latch import StopLatch

Orders = tuple[bytes, ...]
"""Encoded orders: the last stop and resume, then the mission. Compared by identity, tick by tick."""


class LastingOrders:
    """What one process has to keep of the orders that `latch` and its mission are.

    Attributes:
        current: what is to be kept now; another object when it has changed.
        trouble: why what was to be kept is not, "" when it is.
        acknowledged: versions of the mission, and of the last stop or resume, that are kept; 0 for none.
    """

    def __init__(self, latch: StopLatch) -> None:
        self._latch: Final = latch
        self._mission: Mission | None = None
        self._of: tuple[tuple[Stop | Resume, ...], Mission | None] = latch.lasting, None
        self._has_disk = False
        self._versions = 0, 0
        self.current: Orders = ()
        self.trouble = ""
        self.acknowledged = 0, 0

    def has_disk(self) -> None:
        """From now on an order is kept when `kept` says so, and not as soon as it has come."""
        self._has_disk = True

    def look(self, mission: Mission | None) -> None:
        """Takes what holds at a tick."""
        latest = self._latch.lasting
        if latest is self._of[0] and mission is self._of[1]:
            return
        self._of = latest, mission
        orders: list[Stop | Resume | Mission] = [*latest, *([] if mission is None else [mission])]
        self.current = tuple(map(encode, orders))
        self._versions = 0 if mission is None else mission.version, self._latch.version
        if not self._has_disk:
            self.kept(self.current, "")

    def kept(self, orders: Orders, trouble: str) -> None:
        """Takes that `orders`, which were `current`, are kept, or why they cannot be.

        In that case the robot has done what it could: it acknowledges them, and says what is wrong.
        """
        self.trouble = trouble
        if orders is self.current:
            self.acknowledged = self._versions
