"""Ticks missed in an hour at 200 Hz in real time, beside ``stress-ng --cpu 1``.

`handfast run delta` in drives of `DRIVE_MINUTES`, by what `make compiled` makes, for two cores do not carry
it as Python: ``.venv-compiled/bin/python -m tests.benchmarks realtime_hour``. Hand states are sent at events:
one every 5 ms says nothing new. Beside it, in the same minutes, what loops that do nothing miss on the same
processors.
"""

from __future__ import annotations

import subprocess
from functools import reduce
from typing import Final

from tests.benchmarks.bare_loop import Wakes, bare_loops
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.processes import NotHereError, handfast
from tests.benchmarks.realtime import REALTIME, measured, needs_realtime

RATE_HZ: Final = 200
SETTINGS: Final = ("control.send=event",)
MINUTES: Final = 60.0
QUICK_MINUTES: Final = 1.0
DRIVE_MINUTES: Final = 20.0


def run(options: Options) -> Result:
    if "(compiled)" not in subprocess.run(handfast("--version"), capture_output=True, text=True).stdout:
        raise NotHereError("needs what `make compiled` makes: .venv-compiled/bin/python")
    needs_realtime()
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    with bare_loops(RATE_HZ) as bare:
        result = measured([(RATE_HZ, REALTIME)], minutes, DRIVE_MINUTES, SETTINGS)
    wakes = reduce(Wakes.and_, bare)
    of = wakes.made + wakes.missed
    note = f"{wakes.missed} of {of}; {100 * wakes.late / of:.2f} % late by > 1 ms, "
    note += f"{wakes.worst_ns / 1e6:.1f} ms at worst"
    result.figures.append(Figure("missed by loops that do nothing", 100 * wakes.missed / of, "%", note=note))
    return result
