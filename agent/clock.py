"""Time, in integer nanoseconds of the wall clock (Unix epoch)."""

from __future__ import annotations

import time
from typing import Final, Protocol

NS_PER_S: Final = 1_000_000_000


class Clock(Protocol):
    """What the loop of a process needs of time."""

    def now_ns(self) -> int:
        """The present, ns."""
        ...

    def sleep_until(self, time_ns: int) -> None:
        """Returns at `time_ns` or, when that is past, at once."""
        ...


class RealClock:
    """The machine's clock: wall time at the start of the process, carried on by the monotonic clock.

    A wall clock that is set while robots drive must not move them: it is read once.
    """

    def __init__(self) -> None:
        # The reading of the wall clock lies between two of the monotonic one: the closest of a
        # few pairs keeps a preempted process from starting with an offset.
        samples = []
        for _ in range(5):
            before = time.monotonic_ns()
            wall = time.time_ns()
            after = time.monotonic_ns()
            samples.append((after - before, wall - (before + after) // 2))
        self._offset_ns = min(samples)[1]

    def now_ns(self) -> int:
        return time.monotonic_ns() + self._offset_ns

    def sleep_until(self, time_ns: int) -> None:
        remaining = time_ns - self.now_ns()
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)


class VirtualClock:
    """A clock that stands still until it is told to move; sleeping moves it."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until(self, time_ns: int) -> None:
        self._now_ns = max(self._now_ns, time_ns)
