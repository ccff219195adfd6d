"""When to say again what others know already: seldom while nothing changes, at once when it does (PURE).

The timer of Trickle (RFC 6206), without its suppression: after a change a thing is said at once, and again
after intervals that double, so that who has missed it hears it soon. What is said tells how long the next
interval is at most, so that silence within it means nothing.
"""

from __future__ import annotations

from typing import Final


class TrickleTimer:
    """When one thing is to be said.

    Args:
        least_ns: nothing is said sooner after the last time (Imin).
        most_ns: it is said so long after it at the latest (Imax), whatever happens.

    Attributes:
        next_ns: so long after the last time it was said the next one comes at the latest; `least_ns` at
            first.
    """

    __slots__ = ("_changed", "_said_ns", "least_ns", "most_ns", "next_ns")

    def __init__(self, least_ns: int, most_ns: int) -> None:
        if not 0 < least_ns <= most_ns:
            raise ValueError(f"least_ns = {least_ns}: must be above 0 and at most most_ns = {most_ns}")
        self.least_ns: Final = least_ns
        self.most_ns: Final = most_ns
        self.next_ns = least_ns
        self._said_ns: int | None = None
        self._changed = False

    def changed(self) -> None:
        """What is to be said is not what was said last, or somebody seems to have missed it."""
        self._changed = True

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
        return self._changed and since_ns >= self.least_ns

    def said(self, now_ns: int, *, most_ns: int | None = None) -> int:
        """It is said at `now_ns`: returns within how long it is said again, ns.

        Args:
            most_ns: a longest interval for this time that is shorter than the usual; None: the usual.
        """
        most_ns = self.most_ns if most_ns is None else max(self.least_ns, min(most_ns, self.most_ns))
        self.next_ns = self.least_ns if self._changed or self._said_ns is None else 2 * self.next_ns
        self.next_ns = min(self.next_ns, most_ns)
        self._said_ns, self._changed = now_ns, False
        return self.next_ns
