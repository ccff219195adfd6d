"""How late a robot's messages usually are: what is late as always is not silent (PURE).

Two things make what is known of a robot old. Its messages take their time: of that the mean and the mean
deviation are kept, as for a timer of retransmission (RFC 6298). And some do not come: of that the share p of
messages that are missed before one comes, and how many are missed in a row, b + 1 on average. With

    q = b / (1 + b),    k = ln(p / `RARE`) / ln(1 / q)

more than k in a row are missed once in 1 / `RARE` messages, if losses come as they came. Independent losses
have q = p, which is the least; bursts a larger q.
"""

from __future__ import annotations

from math import log
from typing import Final

from agent.common.time import NS_PER_S

UNSURE_NS: Final = NS_PER_S // 4
"""A robot that is late by so much may have stopped: it is looked for where it may stand."""
LATE_MAX_NS: Final = 2 * NS_PER_S
"""No more than this is forgiven a link for being late as usual."""
RARE: Final = 1e-5
OUTAGE_NS: Final = NS_PER_S
OUTAGE_PERIODS: Final = 12
"""Longer than either of these nothing came: that is an outage, and says nothing of what is usual."""
_SHARE_WEIGHT: Final = 1.0 / 64.0
_BURST_WEIGHT: Final = 1.0 / 8.0
_HEEDED: Final = 1e-3
IN_TIME_NS: Final = NS_PER_S // 10
"""A message that is no older, and before which none is missed, is in time."""


class Lateness:
    """What is usual on the link from one robot.

    Attributes:
        usual_ns: how old what is known of it usually gets, give or take its scatter; 0 where nothing is
            forgiven.
        forgiven_ns: how old it may get, beyond `UNSURE_NS`, before its sender counts as silent.
        heeds: whether a message that comes in time has anything to say.
        most_ns: no more is forgiven, whatever is usual.
    """

    __slots__ = (
        "_burst", "_expected_ns", "_mean_ns", "_scatter_ns", "_share", "_taken_ns", "forgiven_ns", "heeds",
        "most_ns", "usual_ns",
    )  # fmt: skip

    def __init__(self) -> None:
        self.forgiven_ns = self.usual_ns = 0
        self._mean_ns = self._scatter_ns = -1
        self._expected_ns = self._taken_ns = 0
        self._share = self._burst = 0.0
        self.heeds = True
        self.most_ns = LATE_MAX_NS

    def take(self, now_ns: int, age_ns: int, gap_ns: int | None, expected_ns: int) -> None:
        """Takes a message.

        Of those that come at once, in a burst, the first says how old what was known had got.

        Args:
            now_ns: when it was taken.
            age_ns: its age then.
            gap_ns: between its stamp and that of the one before, None where that was not awaited.
            expected_ns: between two messages.
        """
        if self._mean_ns < 0:
            self._mean_ns, self._scatter_ns = max(0, age_ns), max(0, age_ns) >> 1
        elif now_ns != self._taken_ns:
            off_ns = age_ns - self._mean_ns
            self._mean_ns += off_ns >> 3
            self._scatter_ns += (abs(off_ns) - self._scatter_ns) >> 2
        self._taken_ns = now_ns
        if gap_ns is not None and gap_ns < max(OUTAGE_NS, OUTAGE_PERIODS * expected_ns):
            missed = max(0, (gap_ns + (expected_ns >> 1)) // expected_ns - 1)
            self._share += _SHARE_WEIGHT * ((missed > 0) - self._share)
            if missed:
                self._burst += _BURST_WEIGHT * (missed - 1 - self._burst)
        self.expect(expected_ns)

    def expect(self, expected_ns: int) -> None:
        """From now on so much is between two messages."""
        self._expected_ns = expected_ns
        aged_ns = self._mean_ns + self._run_ns()
        allowed_ns = aged_ns + 4 * self._scatter_ns - UNSURE_NS
        self.forgiven_ns = max(0, min(allowed_ns, self.most_ns))
        most_ns = self.forgiven_ns + UNSURE_NS if self.forgiven_ns else 0
        self.usual_ns = min(aged_ns + self._scatter_ns, most_ns)
        self.heeds = allowed_ns > 0 or self._share > _HEEDED

    def _run_ns(self) -> int:
        """Longest time without a message that is to be expected."""
        if self._share <= RARE:
            return self._expected_ns
        tail = max(self._share, self._burst / (1.0 + self._burst))
        return round(self._expected_ns * (1.0 + max(1.0, log(self._share / RARE) / -log(tail))))
