"""How robots' clocks stand to this machine's, any of which may be wrong, or lied about (PURE)."""

from __future__ import annotations

from typing import Final

from handfast.agent.common.time import NS_PER_S

OFF_NS: Final = 60 * NS_PER_S
"""Clocks that agree to within this are right enough for an operator's orders."""


class RobotClocks:
    """From the times that robots show, whichever way they come."""

    def __init__(self) -> None:
        self._ahead_ns: dict[int, int] = {}

    def show(self, robot: int, now_ns: int, there_ns: int) -> None:
        """Takes a time that a robot's clock showed before `now_ns`: the one that was the shortest on its way
        counts."""
        ahead_ns = there_ns - now_ns
        self._ahead_ns[robot] = max(ahead_ns, self._ahead_ns.get(robot, ahead_ns))

    def at(self, robot: int, now_ns: int) -> int | None:
        """What a robot's clock shows at a time of this machine's; None where that is not known."""
        ahead_ns = self._ahead_ns.get(robot)
        return None if ahead_ns is None else now_ns + ahead_ns

    def newest(self, now_ns: int) -> int:
        """What the clock shows that is the furthest ahead: one alone may be behind."""
        return now_ns + max(self._ahead_ns.values(), default=0)

    def usual(self, now_ns: int) -> int:
        """What the one in the middle shows, of two the one that is behind: no few can push it ahead."""
        ordered = sorted(self._ahead_ns.values())
        return now_ns + (ordered[(len(ordered) - 1) // 2] if ordered else 0)

    @property
    def behind_s(self) -> float:
        """How far this machine's clock is behind that of each robot; 0.0 where it is right enough for one."""
        least_ns = min(self._ahead_ns.values(), default=0)
        return least_ns / NS_PER_S if least_ns > OFF_NS else 0.0
