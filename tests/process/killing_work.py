"""Runs for an engine that do what no run should: one kills the worker that it is on, one never ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Final

KILLS: Final = 0
HANGS: Final = 1


class KillingWork:
    """A `deploy.simulate.worker_pool.Work`: each run gives its number."""

    def execute(self, number: int, _go_on: Callable[[], bool]) -> str:
        if number == KILLS:
            os.kill(os.getppid(), signal.SIGKILL)
        while number in (KILLS, HANGS):
            time.sleep(0.1)
        return f"done {number}"

    def unfinished(self, number: int, reason: str, _wall_s: float, *, timed_out: bool) -> str:
        return f"{'timed out' if timed_out else 'crashed'} {number}: {reason}"
