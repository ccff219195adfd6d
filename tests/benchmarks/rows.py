"""Many runs in virtual time, on all cores, for benchmarks: `handfast sweep` without its folder."""

from __future__ import annotations

import sys
import time
from typing import Final

from deploy.pool import Pool, cores
from deploy.sweep import Plan
from deploy.sweep_run import Row, Runs

TIMEOUT_S: Final = 300.0
TELL_S: Final = 20.0


def drive(name: str, plan: Plan) -> list[Row]:
    """The rows of all runs, in their order; says from time to time how far it is."""
    begun = told = time.monotonic()
    rows = []
    with Pool(Runs(plan), cores(), TIMEOUT_S) as pool:
        for row in pool.results(range(plan.runs), lambda: True):
            rows.append(row)
            if time.monotonic() - told > TELL_S:
                told = time.monotonic()
                left_s = (told - begun) * (plan.runs - len(rows)) / len(rows)
                text = f"  {name}: {len(rows)} of {plan.runs} runs, {left_s / 60.0:.1f} min left"
                print(text, file=sys.stderr, flush=True)
    unfinished = [row for row in rows if not row.numbers]
    if unfinished:
        print(f"  {name}: {len(unfinished)} not finished, such as: {unfinished[0].reason}", file=sys.stderr)
    return sorted(rows, key=lambda row: row.run)


def share(part: int, whole: int) -> str:
    """In percent."""
    return f"{100.0 * part / whole:.1f}"
