"""The timer that says when to repeat a message, and sequence numbers (PURE).

The timer is that of Trickle (RFC 6206) without its suppression: it fires at once after a change, and again
after intervals that double, so that a robot that missed the message hears it soon. The message says how long
the next interval is at most, so that silence within it means nothing.

After a change that concerns many robots, all would repeat at the same times. Each robot therefore has its own
shares of its intervals until they reach their maximum (RFC 6206 draws a time from their second half).
"""

from __future__ import annotations

from typing import Final


class TrickleTimer:
    """When one thing is to be said.

    Args:
        least_ns: nothing is said sooner after the last time (Imin).
        most_ns: it is said so long after it at the latest (Imax), whatever happens.
        shares: both above 0 and at most 1, others for each who says such a thing: intervals that grow are so
            far between their half and their whole, and the first of the longest is so much of it. Where the
            two have nothing to do with each other, the times at which all say it spread evenly.

    Attributes:
        next_ns: so long after the last time it was said the next one comes at the latest; `least_ns` at
            first.
    """

    __slots__ = (
        "_again_ns", "_interval_ns", "_is_spread", "_said_ns", "_shares", "least_ns", "most_ns", "next_ns",
    )  # fmt: skip

    def __init__(self, least_ns: int, most_ns: int, shares: tuple[float, float] = (1.0, 1.0)) -> None:
        if not all(0.0 < share <= 1.0 for share in shares):
            raise ValueError(f"shares = {shares}: must be above 0 and at most 1")
        if not 0 < least_ns <= most_ns:
            raise ValueError(f"least_ns = {least_ns}: must be above 0 and at most most_ns = {most_ns}")
        self.least_ns: Final = least_ns
        self.most_ns: Final = most_ns
        self.next_ns = self._interval_ns = least_ns
        self._shares, self._is_spread = shares, False
        self._said_ns: int | None = None
        self._again_ns: int | None = None

    def changed(self, again_ns: int = 0) -> None:
        """What is to be said is not what was said last, or somebody seems to have missed it.

        Args:
            again_ns: the first interval after it, where that may be longer than `least_ns`.
        """
        self._again_ns = again_ns if self._again_ns is None else min(again_ns, self._again_ns)

    def is_due(self, now_ns: int, again_ns: int = 0) -> bool:
        """Whether it is to be said at `now_ns`; whoever says it calls `said`.

        Args:
            again_ns: so much later this is asked again, if that is known: what was promised is kept.
        """
        if self._said_ns is None:
            return True
        since_ns = now_ns - self._said_ns
        if since_ns >= self.next_ns or since_ns + again_ns > self.next_ns:
            return True
        return self._again_ns is not None and since_ns >= self.least_ns

    def said(self, now_ns: int, *, most_ns: int | None = None, growth: int = 2) -> int:
        """It is said at `now_ns`: returns within how long it is said again, ns.

        Args:
            most_ns: a longest interval for this time that is shorter than the usual; None: the usual.
            growth: an interval that follows another is so many times as long.
        """
        most_ns = self.most_ns if most_ns is None else max(self.least_ns, min(most_ns, self.most_ns))
        if self._again_ns is not None or self._said_ns is None:
            self._interval_ns = max(self.least_ns, min(self._again_ns or 0, most_ns))
            self._is_spread = False
        else:
            self._interval_ns = min(growth * self._interval_ns, most_ns)
        share = 1.0
        if not self._is_spread:
            self._is_spread = self._interval_ns == most_ns
            growing, longest = self._shares
            share = longest if self._is_spread else 0.5 * (1.0 + growing)
        steps = max(1, round(share * self._interval_ns / self.least_ns))
        self.next_ns = min(steps * self.least_ns, self._interval_ns) if share < 1.0 else self._interval_ns
        self._said_ns, self._again_ns = now_ns, None
        return self.next_ns


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
