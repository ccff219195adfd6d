"""Sequence numbers of messages, which count rounds from the mission's epoch (PURE)."""

from __future__ import annotations

from typing import Final

FIRST_ROUND: Final = 1 << 20
"""Number of the message of the mission's first round."""


class SequenceNumbers:
    """Sequence numbers of one topic: they count rounds (ticks of the grid) from the mission's epoch.

    So the messages of a run and of its simulation bear the same numbers, a process that starts again goes on
    with those of its place, and a skipped tick leaves a gap. Before a mission is known they count from 0.

    Args:
        period_ns, phase_ns: of the sender's ticks (`Node`); a late one has the number of its round.
    """

    def __init__(self, period_ns: int, phase_ns: int = 0) -> None:
        self._period_ns, self._phase_ns = period_ns, phase_ns
        self._epoch_ns: int | None = None
        self._count = 0

    def begin(self, epoch_ns: int) -> None:
        """Sets the mission's epoch (wall time, ns), from which rounds count."""
        self._epoch_ns = epoch_ns

    def next(self, stamp_ns: int) -> int:
        """Number of a message whose content holds at `stamp_ns`; at most one a round."""
        if self._epoch_ns is None:
            self._count += 1
            return self._count - 1
        return self.at(stamp_ns)

    def at(self, stamp_ns: int) -> int:
        """The number that belongs to a time, 0 while no mission is known."""
        if self._epoch_ns is None:
            return 0
        return max(0, FIRST_ROUND + (stamp_ns - self._epoch_ns - self._phase_ns) // self._period_ns)
