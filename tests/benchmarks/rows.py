"""Many runs in virtual time, on all cores, for benchmarks: `handfast sweep` without its folder."""

from __future__ import annotations

import sys
import time
from typing import Final, TypeVar

from handfast.deploy.simulate.worker_pool import Pool, Work, cores
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.sweep.run import Row, Runs

TIMEOUT_S: Final = 300.0
TELL_S: Final = 20.0

T = TypeVar("T")


def drive(name: str, plan: Plan) -> list[Row]:
    """The rows of all runs, in their order; says from time to time how far it is."""
    rows = results(name, Runs(plan), plan.runs)
    unfinished = [row for row in rows if not row.numbers]
    if unfinished:
        print(f"  {name}: {len(unfinished)} not finished, such as: {unfinished[0].reason}", file=sys.stderr)
    return sorted(rows, key=lambda row: row.run)


def results(name: str, work: Work[T], runs: int) -> list[T]:
    """What came of all runs of `work`, as they ended."""
    begun = told = time.monotonic()
    found = []
    with Pool(work, cores(), TIMEOUT_S) as pool:
        for result in pool.results(range(runs), lambda: True):
            found.append(result)
            if time.monotonic() - told > TELL_S:
                told = time.monotonic()
                left_s = (told - begun) * (runs - len(found)) / len(found)
                text = f"  {name}: {len(found)} of {runs} runs, {left_s / 60.0:.1f} min left"
                print(text, file=sys.stderr, flush=True)
    return found


def share(part: int, whole: int) -> str:
    """In percent."""
    return f"{100.0 * part / whole:.1f}"
