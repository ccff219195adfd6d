"""How far a neighbour's clock is from the own one, from the stamps of the messages that come anyway.

Pure. With theta the neighbour's clock minus the own, a message that took the time T seems to have
taken

    own clock when it is taken - stamp = T - theta,

and the neighbour echoes (`HandState.heard`) what it sees of the other direction, T' + theta. Both T
and T' are at least 0, so theta lies between minus the own least apparent delay and the neighbour's
least (C1): the middle is the offset of NTP (D. Mills, RFC 5905, section 8), half the width is its error.
"""

from __future__ import annotations

from typing import Final

DRIFT_MAX: Final = 500e-6
"""Two clocks part by no more than this (s/s): crystals are within 100e-6 each over temperature, and
adjtime(3) and NTP slew a clock that they correct by at most 500e-6."""
LEAK_NS: Final = 100_000
"""The least apparent delay grows in steps of this size (ns), one in `LEAK_NS` / `DRIFT_MAX` = 0.2 s."""
CONFIRM_PERIODS: Final = 50
"""A smaller delay than the least counts when a second one comes within so many periods."""

_LEAK_PERIOD_NS: Final = round(LEAK_NS / DRIFT_MAX)
_UNKNOWN: Final = 2**62


class ClockOffset:
    """The offset of one neighbour's clock.

    Times are those of ticks and of stamps, and ticks come once a period: nothing here is finer than about
    one period. A message that is taken at a tick may have waited for it, which only widens the
    interval; it may also have come while the tick was late to wake, which would make it too narrow.
    So one message alone never lowers the least delay.

    Args:
        period_ns: time between two ticks of a node.

    Attributes:
        used_ns: the offset to use, neighbour's clock minus own; 0 while it is not proven.
        offset_us: the estimate, neighbour's clock minus own; 0 while nothing is known.
        error_us: half of the estimate's uncertainty; -1 while nothing is known.
        least_us: the own least apparent delay, to echo; None until two messages have come.
    """

    __slots__ = (
        "_candidate",
        "_candidate_ns",
        "_echo_us",
        "_leak_ns",
        "_least",
        "_period_ns",
        "error_us",
        "least_us",
        "offset_us",
        "used_ns",
    )

    def __init__(self, period_ns: int) -> None:
        self.used_ns = 0
        self.offset_us = 0
        self.error_us = -1
        self.least_us: int | None = None
        self._period_ns = period_ns
        self._least = self._candidate = _UNKNOWN
        self._candidate_ns = -_UNKNOWN
        self._leak_ns = 0
        self._echo_us: int | None = None

    def take(self, now_ns: int, stamp_ns: int, echo_us: int | None) -> bool:
        """Takes what one message brings: its stamp, and its echo of the own messages' least delay.

        Args:
            now_ns: the own clock.
            echo_us: what the neighbour says of the own messages; None when it says nothing this time.

        Returns whether `least_us` has changed.
        """
        apparent = now_ns - stamp_ns
        if echo_us is None:
            echo_us = self._echo_us
        if apparent == self._least:  # what nearly every message is on a good link
            self._leak_ns = now_ns + _LEAK_PERIOD_NS
            if echo_us != self._echo_us:
                self._echo_us = echo_us
                self._estimate()
            return False
        before = self.least_us
        if self._least != _UNKNOWN and now_ns >= self._leak_ns:
            steps = (now_ns - self._leak_ns) // _LEAK_PERIOD_NS + 1
            self._set_least(self._least + steps * LEAK_NS, self._leak_ns + (steps - 1) * _LEAK_PERIOD_NS)
        if apparent < self._least:
            if now_ns - self._candidate_ns <= CONFIRM_PERIODS * self._period_ns:
                self._set_least(max(apparent, self._candidate), now_ns)
                self._candidate = min(apparent, self._candidate)
            else:
                self._candidate = apparent
            self._candidate_ns = now_ns
        if echo_us != self._echo_us or self.least_us != before:
            self._echo_us = echo_us
            if not self._estimate():
                # One of the two has another clock since. The own past is forgotten, but not the newest
                # message: its echo makes the neighbour forget its own past, if that is what is wrong.
                self._set_least(apparent, now_ns)
                self._estimate()
        return self.least_us != before

    def _set_least(self, delay_ns: int, since_ns: int) -> None:
        self._least = delay_ns
        self.least_us = -(-delay_ns // 1000)  # rounded up: a bound stays one
        self._leak_ns = since_ns + _LEAK_PERIOD_NS

    def _estimate(self) -> bool:
        """Finds the estimate from both least delays; False when they contradict each other."""
        self.used_ns, self.offset_us, self.error_us = 0, 0, -1
        if self._echo_us is None or self._least == _UNKNOWN:
            return True
        upper = self._echo_us * 1000
        width = upper + self._least  # of the interval [-least, upper]; the least round trip, too
        if width < -self._period_ns:
            return False
        width = max(width, self._period_ns)
        twice = upper - self._least
        self.offset_us = (twice + 1000) // 2000
        self.error_us = -(-width // 2000)
        # Fleets keep time by NTP or GPS, and a link that is slow one way looks like an offset. So nothing is
        # used while the interval holds 0, all of it beyond twice the error, and between them just so much
        # that for no offset in the interval it is worse than 0: (C2) in docs/theory.md.
        proven = abs(twice) - width
        if proven >= width:
            self.used_ns = twice // 2
        elif proven > 0:
            self.used_ns = twice * proven // (2 * width)
        return True
