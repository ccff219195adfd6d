"""Ticks missed in an hour at 200 Hz in real time, beside ``stress-ng --cpu 1``.

`handfast run delta` in drives of `DRIVE_MINUTES`, by what `make compiled` makes, for two cores do not carry
it as Python: ``.venv-compiled/bin/python -m tests.benchmarks realtime_hour``. Hand states are sent at events:
one every 5 ms says nothing new. Beside it, in the same minutes, what loops that do nothing miss on the same
processors.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from functools import reduce
from typing import Final

from tests.benchmarks.bare_loop import Wakes, bare_loops
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.processes import BenchmarkError, NotHereError, handfast
from tests.benchmarks.realtime import REALTIME, measured, needs_realtime

RATE_HZ: Final = 200
SETTINGS: Final = ("control.send=event",)
MINUTES: Final = 60.0
QUICK_MINUTES: Final = 1.0
DRIVE_MINUTES: Final = 20.0
NOTHING: Final = "loops that do nothing"


def run(options: Options) -> Result:
    if "(compiled)" not in subprocess.run(handfast("--version"), capture_output=True, text=True).stdout:
        raise NotHereError("needs what `make compiled` makes: .venv-compiled/bin/python")
    needs_realtime()
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    bare: list[Wakes] = []
    try:
        with bare_loops(RATE_HZ) as bare:
            result = measured([(RATE_HZ, REALTIME)], minutes, DRIVE_MINUTES, SETTINGS)
    except BenchmarkError as error:  # robots that get too little leave the command nothing to end them by
        raise BenchmarkError(f"{error}; {NOTHING}: {_told(bare)}") from error
    whole = reduce(Wakes.plus, bare)
    percent = 100 * whole.missed / (whole.made + whole.missed)
    result.figures.append(Figure(f"missed by {NOTHING}", percent, "%", note=_told(bare)))
    return result


def _told(bare: Sequence[Wakes]) -> str:
    whole = reduce(Wakes.plus, bare)
    of = whole.made + whole.missed
    late = f"{100 * whole.late / of:.2f} % late by > 1 ms, {whole.worst_ns / 1e6:.1f} ms at worst"
    return f"{whole.missed} of {of}; {late}"
