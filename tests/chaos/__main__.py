"""``python -m tests.chaos``: drive random scenarios and hold each to the oracles.

Scenarios run in virtual time on all cores. One that fails is made smaller and written as a fleet file. Exit
status: 0 no oracle was violated, 1 one was, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Final

from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.simulate.worker_pool import Abandoned
from handfast.deploy.verdict.violations import Violation
from tests.chaos.presets import PRESETS
from tests.chaos.report import Driven, Tally, lines
from tests.chaos.run import CRASH, Outcome, drive, drive_real
from tests.chaos.scenario import draw, name_of, seeds_of
from tests.chaos.shrink import shrink
from tests.chaos.text import scenario_text

TIMEOUT_S: Final = 900.0
"""Real time that one scenario may take, shrinking included."""


def drive_seed(seed: int, *, shrinks: bool) -> Driven:
    """Drive a seed's scenario, and shrink it if it fails."""
    begun_s, tables = time.monotonic(), draw(seed)
    outcome: Outcome | None = None

    def go_on() -> bool:
        return time.monotonic() < begun_s + TIMEOUT_S

    try:
        outcome = drive(scenario_text(tables), go_on)
        small = shrink(tables, outcome, go_on) if shrinks and outcome.violations else None
    except Abandoned:
        late = Violation(CRASH, 0.0, f"The scenario took more than {TIMEOUT_S:g} s.")
        return Driven(seed, tables, outcome or Outcome((late,)))
    return Driven(seed, tables, outcome, small)


def virtual(seeds: Sequence[int], jobs: int, *, shrinks: bool) -> Iterator[Driven]:
    """Drive seeds in virtual time, in whatever order they end."""
    with ProcessPoolExecutor(
        jobs, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        drives = [pool.submit(drive_seed, seed, shrinks=shrinks) for seed in seeds]
        try:
            for each in as_completed(drives):
                yield each.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def real(seeds: Sequence[int], out: Path) -> Iterator[Driven]:
    """Drive seeds with real processes, one after the other, and keep the run folders of those that fail."""
    interrupt = Interrupt()
    with interrupt.caught():
        for seed in seeds:
            tables, folder = draw(seed), out / f"{name_of(seed)}-run"
            shutil.rmtree(folder, ignore_errors=True)
            outcome = drive_real(scenario_text(tables), folder, interrupt)
            if interrupt.count:
                raise KeyboardInterrupt
            if not outcome.violations:
                shutil.rmtree(folder)
            yield Driven(seed, tables, outcome)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__.partition("\n")[0])
    parser.add_argument("--scenarios", type=int, default=100, metavar="N", help="how many (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--preset", choices=PRESETS, help="only seeds of this preset")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="default: all cores")
    parser.add_argument("--no-shrink", action="store_true", help="leave scenarios that fail as drawn")
    parser.add_argument("--out", type=Path, default=Path("chaos"), help="folder for those (default: chaos)")
    parser.add_argument("--real", action="store_true", help="with real processes, one scenario at a time")
    parser.add_argument("--write", action="store_true", help="only write the scenarios")
    options = parser.parse_args(arguments)
    seeds, out, tally = seeds_of(options.preset, options.seed, options.scenarios), options.out, Tally()
    if options.write:
        for seed in seeds:
            print(Driven(seed, draw(seed), Outcome()).write(out))
        return 0
    driven = real(seeds, out) if options.real else virtual(seeds, options.jobs, shrinks=not options.no_shrink)
    try:
        for each in driven:
            tally.add(each)
            if each.outcome.violations:
                first = each.outcome.violations[0]
                print(f"seed {each.seed}: {first.oracle}: {first.message} -> {each.write(out)}", flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    print("\n".join(lines(tally)))
    if tally.scenarios < len(seeds):
        return 130
    return 1 if tally.violations else 0


if __name__ == "__main__":
    sys.exit(main())
