"""Time in integer nanoseconds of the wall clock (Unix epoch), and clocks that are wrong on purpose (PURE)."""

from __future__ import annotations

from math import floor
from typing import Final, NamedTuple, Protocol

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000


class LocalTime(NamedTuple):
    """A clock that is wrong on purpose: ahead by `skew_ns` (ns), and faster by the share `drift`.

        local = true + skew_ns + round(drift * max(0, true - epoch_ns))

    True is the operator's time. `epoch_ns` is the mission's epoch, the one time that every process, a
    simulation and a recording agree on: the skew is that at the epoch, and drift counts from there. While
    it is not known (None) nothing drifts, so a clock that gets it beforehand does not jump.
    """

    skew_ns: int = 0
    drift: float = 0.0
    epoch_ns: int | None = None

    def local_ns(self, true_ns: int) -> int:
        """What the clock shows at a true time."""
        skew_ns, drift, epoch_ns = self
        if not drift or epoch_ns is None or true_ns <= epoch_ns:
            return true_ns + skew_ns
        return true_ns + skew_ns + round(drift * (true_ns - epoch_ns))

    def true_ns(self, local_ns: int) -> int:
        """The first true time at which the clock shows `local_ns` or more."""
        skew_ns, drift, epoch_ns = self
        true_ns = local_ns - skew_ns
        if not drift or epoch_ns is None or true_ns <= epoch_ns:
            return true_ns
        true_ns = epoch_ns + floor((true_ns - epoch_ns) / (1.0 + drift))
        # Never the other way: what is cut off is more than is rounded.
        while self.local_ns(true_ns) < local_ns:
            true_ns += 1
        return true_ns


class MachineClock(NamedTuple):
    """How a process's wall time comes from the monotonic clock that all processes of its machine share.

    Attributes:
        boot: names that clock: the machine and its boot.
        offset_ns: wall time minus it, as the process read both at its start, ns.
    """

    boot: int
    offset_ns: int


class Clock(Protocol):
    """The clock of a process's loop: wall time in ns, read and slept until."""

    def now_ns(self) -> int:
        """The present, wall time in ns."""
        ...

    def sleep_until(self, time_ns: int) -> None:
        """Returns at `time_ns` or, when that is past, at once."""
        ...

    def begin(self, epoch_ns: int) -> None:
        """Sets the mission's epoch (wall time, ns), from which the clock drifts. Only the first counts."""
        ...
