"""Ctrl-C and its like, as something to look at instead of an exception."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class Interrupt:
    """Counts Ctrl-C (and SIGTERM, SIGHUP) instead of raising: a run is ended in order."""

    def __init__(self) -> None:
        self.count = 0
        self.number = 0

    def _on_signal(self, number: int, _frame: object) -> None:
        self.count += 1
        self.number = number

    @contextmanager
    def caught(self) -> Iterator[Interrupt]:
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = {number: signal.signal(number, self._on_signal) for number in numbers}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
