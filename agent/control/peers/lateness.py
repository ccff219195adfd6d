"""How late a robot's messages usually are, and how far its clock is from the own one (PURE).

A robot whose messages are late as always is not silent.

Two things make what is known of a robot old. Its messages take their time: of that the mean and the mean
deviation are kept, as for a timer of retransmission (RFC 6298). And some do not come: of that the share p of
messages that are missed before one comes, and how many are missed in a row, b + 1 on average. With

    q = b / (1 + b),    k = ln(p / `RARE`) / ln(1 / q)

more than k in a row are missed once in 1 / `RARE` messages, if losses come as they came. Independent losses
have q = p, which is the least; bursts a larger q.

A robot may promise when its next message comes at the latest (`take_promised`), and be silent until then.
News come as often as ever meanwhile: so no more is forgiven than the promise and what would be without it.

A neighbour's clock offset follows from the stamps of the messages that come anyway. With theta the
neighbour's clock minus the own, a message that took the time T seems to have taken

    own clock when it is taken - stamp = T - theta,

and the neighbour echoes (`HandState.heard`) what it sees of the other direction, T' + theta. Both T
and T' are at least 0, so theta lies between minus the own least apparent delay and the neighbour's
least (C1): the middle is the offset of NTP (D. Mills, RFC 5905, section 8), half the width is its error.
"""

from __future__ import annotations

from math import log, log2
from typing import Final

from handfast.agent.common.time import NS_PER_S

UNSURE_NS: Final = NS_PER_S // 4
"""A robot that is late by so much may have stopped: it is looked for where it may stand."""
LATE_MAX_NS: Final = 2 * NS_PER_S
"""No more than this is forgiven a link for being late as usual."""
STOOD_KEPT_NS: Final = 10 * NS_PER_S
"""Who stood is likely to stand again within so long."""
RARE: Final = 1e-5
OUTAGE_NS: Final = NS_PER_S
OUTAGE_PERIODS: Final = 12
"""Longer than either of these nothing came: that is an outage, and says nothing of what is usual."""
_SHARE_WEIGHT: Final = 1.0 / 64.0
_BURST_WEIGHT: Final = 1.0 / 8.0
_HEEDED: Final = 1e-3
_LOSSY: Final = 1e-2
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
        missed_ns: for so long promised messages are missed in a row, as usual.
    """

    __slots__ = (
        "_burst", "_mean_ns", "_scatter_ns", "_share", "_taken_ns", "forgiven_ns", "heeds", "missed_ns",
        "most_ns", "usual_ns",
    )  # fmt: skip

    def __init__(self) -> None:
        self.forgiven_ns = self.usual_ns = self.missed_ns = 0
        self._mean_ns = self._scatter_ns = -1
        self._taken_ns = 0
        self._share = self._burst = 0.0
        self.heeds = True
        self.most_ns = LATE_MAX_NS

    @property
    def delay_ns(self) -> int:
        """How long a message takes, give or take its scatter."""
        return max(0, self._mean_ns + 2 * self._scatter_ns)

    def take(self, now_ns: int, age_ns: int | None, gap_ns: int | None, expected_ns: int) -> None:
        """Takes a message.

        Of those that come at once, in a burst, the first says how old what was known had got.

        Args:
            now_ns: when it was taken.
            age_ns: its age then, None where it waited for the own process.
            gap_ns: between its stamp and that of the one before, None where that was not awaited.
            expected_ns: between two messages.
        """
        self._age(now_ns, age_ns)
        if gap_ns is not None and gap_ns < max(OUTAGE_NS, OUTAGE_PERIODS * expected_ns):
            self._miss(max(0, (gap_ns + (expected_ns >> 1)) // expected_ns - 1))
        self.expect(expected_ns)

    def expect(self, expected_ns: int) -> None:
        """From now on so much is between two messages."""
        mean_ns = self._mean_ns
        if mean_ns < 0 and expected_ns > UNSURE_NS:  # all were in time: of those nothing is kept
            mean_ns = IN_TIME_NS
        share, scatter_ns, most_ns = self._share, self._scatter_ns, self.most_ns
        aged_ns = mean_ns + (expected_ns if share <= RARE else self._run_ns(expected_ns))
        allowed_ns = aged_ns + 4 * scatter_ns - UNSURE_NS
        forgiven_ns = allowed_ns if allowed_ns < most_ns else most_ns
        if forgiven_ns > 0:
            self.forgiven_ns = forgiven_ns
            self.usual_ns = min(aged_ns + scatter_ns, forgiven_ns + UNSURE_NS)
        else:
            self.forgiven_ns = 0
            self.usual_ns = min(aged_ns + scatter_ns, 0)
        self.heeds = allowed_ns > 0 or share > _HEEDED

    @property
    def loses(self) -> bool:
        """Whether the link loses messages all the time."""
        return self._share > _LOSSY

    @property
    def missed(self) -> float:
        """How many messages are missed in a row, k, on a link that loses some all the time; else 0."""
        return self._run() if self.loses else 0.0

    def take_promised(
        self,
        now_ns: int,
        age_ns: int | None,
        gap_ns: int | None,
        promised_ns: int,
        most_ns: int,
    ) -> None:
        """Takes a message before which none was due for `promised_ns`; other arguments as of `take`.

        Promises of one that has nothing new to say double up to `most_ns`.
        """
        self._age(now_ns, age_ns)
        if gap_ns is None or gap_ns >= max(OUTAGE_NS, OUTAGE_PERIODS * promised_ns):
            return
        if promised_ns < most_ns:
            self._miss(missed_at_least(gap_ns, promised_ns))
        else:
            self._miss(max(0, (gap_ns + (promised_ns >> 1)) // promised_ns - 1))

    def expect_promised(self, period_ns: int, due_ns: int, promised_ns: int) -> None:
        """From now on a message is due within `due_ns`, and one of those that promise within `promised_ns`.

        Args:
            period_ns: between two messages of a robot that has news all the time.
        """
        self.expect(due_ns)
        forgiven_ns = self.forgiven_ns
        self.expect(period_ns)
        self.forgiven_ns = min(forgiven_ns, self.forgiven_ns + promised_ns)
        self.usual_ns = 0
        if self.forgiven_ns:
            aged_ns = self._mean_ns + self._run_ns(period_ns) + self._scatter_ns
            self.usual_ns = min(aged_ns, self.forgiven_ns + UNSURE_NS)
        self.missed_ns = min(self._run_ns(promised_ns) - promised_ns, OUTAGE_PERIODS * promised_ns)

    def _age(self, now_ns: int, age_ns: int | None) -> None:
        if age_ns is None:
            return
        if self._mean_ns < 0:
            self._mean_ns, self._scatter_ns = max(0, age_ns), max(0, age_ns) >> 1
        elif now_ns != self._taken_ns:
            off_ns = age_ns - self._mean_ns
            self._mean_ns += off_ns >> 3
            self._scatter_ns += (abs(off_ns) - self._scatter_ns) >> 2
        self._taken_ns = now_ns

    def _miss(self, missed: int) -> None:
        self._share += _SHARE_WEIGHT * ((missed > 0) - self._share)
        if missed:
            self._burst += _BURST_WEIGHT * (missed - 1 - self._burst)

    def _run_ns(self, expected_ns: int) -> int:
        """Longest time without a message that is to be expected."""
        if self._share <= RARE:
            return expected_ns
        return round(expected_ns * (1.0 + self._run()))

    def _run(self) -> float:
        tail = max(self._share, self._burst / (1.0 + self._burst))
        return max(1.0, log(self._share / RARE) / -log(tail))


def missed_at_least(gap_ns: int, promised_ns: int) -> int:
    """How many messages are missing between two that are `gap_ns` apart, if the first promised the next one
    within `promised_ns`, and each missing one a next one within twice as long as the one before it."""
    return max(0, int(log2(gap_ns / promised_ns + 1.0) - 0.5))


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
