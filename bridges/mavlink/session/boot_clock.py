"""Converts times of a vehicle's boot clock to the wall clock (PURE).

A vehicle stamps what it sends with the time since its boot. With o = wall clock - boot clock,

- a TIMESYNC exchange, asked at the wall time s, answered at the boot time v, its answer here at r, says
  s - v <= o <= r - v (D. Mills, RFC 5905, section 8: the middle is NTP's offset, half the width its error);
- any stamp v that arrives at r says o <= r - v.

All of these hold at once, so o lies in the intersection, which is let grow for the drift of the two clocks.
An empty one means that a clock was set, or that the vehicle's does not keep time: a simulated autopilot on a
busy machine runs slower than real time. Then only what is new counts, and the clock's rate is taken from the
exchanges and reckoned with. (`agent.control.peers.lateness` does the same between two robots, without
exchanges.)
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Final

from handfast.agent.common.time import NS_PER_S

DRIFT: Final = 100e-6
"""s/s: what an autopilot's crystal and a computer's part by at most."""
REBOOT_NS: Final = NS_PER_S
"""A boot clock that goes back further than this began anew; less is messages out of order."""
EXCHANGES: Final = 8
"""That the rate and the round trip are taken from."""
RATE_UNCERTAINTY: Final = 0.03
"""Share of it by which a rate that is not 1 is taken to be wrong."""
JUMP: Final = 0.3
"""Of a change of the offset: exchanges further than this from a line have seen a clock set, not its rate."""
RATE_MIN: Final = 0.1
RATE_MAX: Final = 2.0
"""No boot clock runs at less or more of the wall clock: then the wall clock was set."""
RATE_NOTED: Final = 0.01
"""A rate further than this from 1 is noted."""
_NS_PER_MS: Final = 1_000_000
_WRAP_NS: Final = 2**32 * _NS_PER_MS


class BootClock:
    """One vehicle's boot clock against the own wall clock. Until something has come, nothing is known.

    Attributes:
        reboots: how often the boot clock went back: the vehicle forgot what it was asked for.
    """

    def __init__(self) -> None:
        self.reboots = 0
        self._latest_ns: int | None = None  # newest boot time seen
        self._wraps_ns = 0
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=EXCHANGES)
        self._forget()

    def _forget(self) -> None:
        self._low_ns: int | None = None  # bounds of the offset at `_at_ns`
        self._high_ns: int | None = None
        self._at_ns = 0
        self._slope = 0.0  # of the offset, s/s
        self._exchanges.clear()

    def exchange(self, sent_ns: int, vehicle_ns: int, received_ns: int) -> None:
        """Takes a TIMESYNC exchange: asked and received by the wall clock, answered by the boot clock, ns."""
        if received_ns < sent_ns:  # the wall clock was set in between
            return
        self._see(vehicle_ns)
        low, high = sent_ns - vehicle_ns, received_ns - vehicle_ns
        self._exchanges.append((received_ns, (low + high) // 2, received_ns - sent_ns))
        self._advance(received_ns)
        self._slope = self._found_slope()
        if self._low_ns is not None:
            low = max(low, self._low_ns)
        if self._high_ns is not None:
            high = min(high, self._high_ns)
        if low > high:
            low, high = sent_ns - vehicle_ns, received_ns - vehicle_ns
        self._low_ns, self._high_ns, self._at_ns = low, high, received_ns

    def take(self, stamp_ms: int, arrival_ns: int) -> int:
        """Takes a message's stamp (ms since boot); returns its wall time (ns), never after its arrival."""
        vehicle_ns = stamp_ms * _NS_PER_MS + self._wraps_ns
        while self._latest_ns is not None and vehicle_ns < self._latest_ns - _WRAP_NS // 2:
            self._wraps_ns += _WRAP_NS  # every 49.7 days; an exchange may tell of several
            vehicle_ns += _WRAP_NS
        self._see(vehicle_ns)
        self._advance(arrival_ns)
        high = arrival_ns - vehicle_ns
        if self._high_ns is None or high < self._high_ns:
            self._high_ns = high
            if self._low_ns is not None and high < self._low_ns:
                # Clocks that do not fit the last exchange: it says only how far off this stamp can be.
                self._low_ns = high - self._exchanges[-1][2]
        offset = self._high_ns if self._low_ns is None else (self._low_ns + self._high_ns) // 2
        return vehicle_ns + offset

    @property
    def round_trip_ns(self) -> int | None:
        """Median of the last exchanges, ns."""
        return round(median(trip for _, _, trip in self._exchanges)) if self._exchanges else None

    @property
    def rate(self) -> float:
        """Seconds of the boot clock in one of the wall clock, where it is proven not to be 1."""
        return 1.0 - self._slope

    @property
    def note(self) -> str:
        """What to tell of the clock; "" when it is fine."""
        if abs(self._slope) < RATE_NOTED:
            return ""
        return f"its clock runs at {self.rate:.2f} of ours"

    def _see(self, vehicle_ns: int) -> None:
        if self._latest_ns is not None and vehicle_ns < self._latest_ns - REBOOT_NS:
            self.reboots += 1
            vehicle_ns -= self._wraps_ns
            self._wraps_ns = 0
            self._latest_ns = vehicle_ns
            self._forget()
        self._latest_ns = vehicle_ns if self._latest_ns is None else max(self._latest_ns, vehicle_ns)

    def _advance(self, now_ns: int) -> None:
        """Brings the bounds to a wall time: they move with the rate, and part with the drift."""
        elapsed = now_ns - self._at_ns
        if elapsed <= 0:
            return
        self._at_ns = now_ns
        moved = round(self._slope * elapsed)
        parted = round(max(DRIFT, RATE_UNCERTAINTY * abs(self._slope)) * elapsed)
        if self._high_ns is not None:
            self._high_ns += moved + parted
        if self._low_ns is not None:
            self._low_ns += moved - parted

    def _found_slope(self) -> float:
        """Slope of the offset over the last exchanges; 0 while their widths and drift explain it."""
        begun_ns, first, first_trip = self._exchanges[0]
        ended_ns, last, last_trip = self._exchanges[-1]
        elapsed, change = ended_ns - begun_ns, last - first
        unsure = 0.5 * (first_trip + last_trip) + DRIFT * abs(elapsed)
        if abs(change) <= unsure:
            return 0.0
        slope = change / elapsed if elapsed > 0 else 1.0
        astray = any(
            abs(offset - first - slope * (then_ns - begun_ns)) > JUMP * abs(change) + 0.5 * trip
            for then_ns, offset, trip in self._exchanges
        )
        if not 1.0 - RATE_MAX < slope < 1.0 - RATE_MIN or astray:
            newest = self._exchanges[-1]
            self._exchanges.clear()
            self._exchanges.append(newest)
            return 0.0
        return slope if elapsed >= NS_PER_S // 2 else 0.0
