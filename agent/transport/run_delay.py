"""How long the threads of this process were ready to run and had no processor."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

_TASKS: Final = Path("/proc/self/task")


def run_delay_ns() -> int:
    """Of all its threads that run now together, since each began, ns: the second figure of
    ``/proc/PID/task/TID/schedstat`` (Documentation/scheduler/sched-stats.rst of Linux). 0 where the kernel
    does not say."""
    found = 0
    with suppress(OSError):
        for thread in os.listdir(_TASKS):
            # It has ended meanwhile, or the kernel says something else there.
            with suppress(OSError, IndexError, ValueError):
                found += int((_TASKS / thread / "schedstat").read_text().split()[1])
    return found
