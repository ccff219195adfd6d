"""Puts a vehicle into GUIDED and arms it, where the fleet file says so (`mavlink.arm`)."""

from __future__ import annotations

from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.runtime.loop import Log
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.bridge.authority import Holder
from handfast.bridges.mavlink.session.session import Session

PERIOD_NS: Final = 3 * NS_PER_S
"""Between two attempts: the vehicle's own checks may refuse the first ones."""


class Takeover:
    """Takes a vehicle over once: from when it obeys, or its operator undoes a step, its operator decides.

    Args:
        wanted: whether to take it over at all (`mavlink.arm`).

    Attributes:
        armed_here: whether its being armed is the bridge's doing.
    """

    def __init__(self, link: Session, log: Log, *, wanted: bool) -> None:
        self._link, self._log, self._wanted = link, log, wanted
        self._asked_ns: int | None = None
        self._was_guided = False
        self.armed_here = False

    def begin_again(self) -> None:
        """The vehicle has begun a new life, or the connection has: no mode of before says anything."""
        self._was_guided = False

    def step(self, now_ns: int, holder: Holder, trouble: str) -> None:
        """A tick. What its operator does counts while there is `trouble`, too; then nothing is asked for."""
        link = self._link
        if holder is Holder.RELEASED and not link.armed:
            self.armed_here = False  # whoever arms it from now on is its operator
        if not self._wanted:
            return
        if holder is Holder.BRIDGE:
            self._wanted = False
            return
        if link.mode == constants.MODE_GUIDED:
            self._was_guided = True
        elif self._was_guided:
            self._wanted = False
            self._log("its operator has taken it out of GUIDED again: it is asked no more")
            return
        due = self._asked_ns is None or now_ns - self._asked_ns >= PERIOD_NS
        if trouble or holder is not Holder.OPERATOR or not due:
            return
        if link.mode == constants.MODE_GUIDED:
            self._log("arming it (mavlink.arm = true)")
            link.command_arm(True)
            self.armed_here = True
        elif not link.armed:  # else somebody drives it
            self._log("asking for GUIDED (mavlink.arm = true)")
            link.command_mode(constants.MODE_GUIDED)
        self._asked_ns = now_ns
