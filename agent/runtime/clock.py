"""The machine's clock."""

from __future__ import annotations

import os
import socket
import time
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Final

from handfast.agent.common.time import NS_PER_S, LocalTime, MachineClock

_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_TIME_NAMESPACE: Final = Path("/proc/self/ns/time")


def boot() -> int:
    """Names the monotonic clock of this process: other processes with the same number read the same clock.

    It is made of the boot's id and the time namespace where the system tells them, else of the host's name.
    """
    parts = [socket.gethostname()]
    with suppress(OSError):
        parts = [_BOOT_ID.read_text().strip()]
    with suppress(OSError):
        parts.append(os.readlink(_TIME_NAMESPACE))
    return int.from_bytes(blake2b(" ".join(parts).encode(), digest_size=7).digest(), "big")


class RealClock:
    """The machine's clock: wall time at the start of the process, carried on by the monotonic clock.

    A wall clock that is set while robots drive must not move them: it is read once.

    Args:
        skew_ns, drift: by how much it is to be wrong (`agent.common.time.LocalTime`).

    Attributes:
        machine: how it comes from the machine's own clock.
    """

    def __init__(self, skew_ns: int = 0, drift: float = 0.0) -> None:
        # The reading of the wall clock lies between two of the monotonic one: the closest of a
        # few pairs keeps a preempted process from starting with an offset.
        samples = []
        for _ in range(5):
            before = time.monotonic_ns()
            wall = time.time_ns()
            after = time.monotonic_ns()
            samples.append((after - before, wall - (before + after) // 2))
        self._offset_ns = min(samples)[1]
        self.machine: Final = MachineClock(boot(), self._offset_ns)
        self._local = LocalTime(skew_ns, drift)
        self._ahead_ns = self._offset_ns + skew_ns
        self._drifts = bool(drift)

    def begin(self, epoch_ns: int) -> None:
        """See `agent.common.time.Clock`."""
        if self._local.epoch_ns is None:
            self._local = self._local._replace(epoch_ns=epoch_ns)

    def now_ns(self) -> int:
        """The present, wall time in ns."""
        if self._drifts:
            return self._local.local_ns(time.monotonic_ns() + self._offset_ns)
        return time.monotonic_ns() + self._ahead_ns

    def sleep_until(self, time_ns: int) -> None:
        """Returns at `time_ns` (wall time) or, when that is past, at once."""
        if self._drifts:
            remaining = self._local.true_ns(time_ns) - time.monotonic_ns() - self._offset_ns
        else:
            remaining = time_ns - time.monotonic_ns() - self._ahead_ns
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)
