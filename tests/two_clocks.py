"""Two nodes that only exchange stamps, each with a clock of its own, in true time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from handfast.agent.control.peers.lateness import ClockOffset

PERIOD = 20_000_000
MS = 1_000_000
S = 1_000_000_000

Delay = Callable[[int], int | None]
"""True delay (ns) of the message sent at a true time (ns), None for a lost one."""


class Side:
    """A node whose clock shows (true time) * (1 + drift) + offset."""

    def __init__(self, offset_ns: int = 0, drift: float = 0.0, period_ns: int = PERIOD) -> None:
        self.offset_ns, self.drift, self.period_ns = offset_ns, drift, period_ns
        self.estimate = ClockOffset(period_ns)
        self.inbox: list[tuple[int, int, int | None]] = []
        self.newest = -1
        self.next_ns = offset_ns // period_ns * period_ns + period_ns

    def clock(self, true_ns: int) -> int:
        return true_ns + round(true_ns * self.drift) + self.offset_ns

    def due(self) -> int:
        """True time of the next tick: the first at which the clock shows it."""
        return -int(-(self.next_ns - self.offset_ns) // (1.0 + self.drift))

    def tick(self, true_ns: int, delay: Delay, other: Side) -> None:
        """Takes what has come, in the order in which it came, then sends."""
        now, self.next_ns = self.next_ns, self.next_ns + self.period_ns
        arrived = sorted(message for message in self.inbox if message[0] <= true_ns)
        self.inbox = [message for message in self.inbox if message[0] > true_ns]
        for _, stamp, echo in arrived:
            if stamp > self.newest:
                self.newest = stamp
                self.estimate.take(now, stamp, echo)
        took = delay(true_ns)
        if took is not None:
            other.inbox.append((true_ns + took, now, self.estimate.least_us))

    def set_clock(self, true_ns: int, offset_ns: int) -> None:
        """Starts again with another clock, and knows nothing."""
        self.offset_ns, self.inbox, self.newest = offset_ns, [], -1
        self.estimate = ClockOffset(self.period_ns)
        self.next_ns = self.clock(true_ns) // self.period_ns * self.period_ns + self.period_ns


def exchange(one: Side, other: Side, there: Delay, back: Delay, until_ns: int) -> Iterator[int]:
    """Every tick of both up to the true time `until_ns`; yields the true time after each."""
    while True:
        side, peer, delay = min((one, other, there), (other, one, back), key=lambda turn: turn[0].due())
        true_ns = side.due()
        if true_ns > until_ns:
            return
        side.tick(true_ns, delay, peer)
        yield true_ns


def run(one: Side, other: Side, there: Delay, back: Delay, until_ns: int) -> None:
    for _ in exchange(one, other, there, back, until_ns):
        pass
