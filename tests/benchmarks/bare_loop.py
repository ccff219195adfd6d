"""What a machine itself misses: one loop on each processor that does nothing but wake up, in SCHED_FIFO above
all robots. ``python -m tests.benchmarks.bare_loop --core 0 --rate-hz 200`` counts until its input ends.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from tests.benchmarks.processes import END_TIMEOUT_S, environment

PRIORITY: Final = 60
LATE_NS: Final = 1_000_000


class Wakes(NamedTuple):
    """How often a loop woke up, how often it had missed a whole period by then, how often it came more than
    `LATE_NS` late, and by how much at worst, ns."""

    made: int
    missed: int
    late: int
    worst_ns: int

    def plus(self, other: Wakes) -> Wakes:
        """Both counts as one."""
        return Wakes(
            self.made + other.made,
            self.missed + other.missed,
            self.late + other.late,
            max(self.worst_ns, other.worst_ns),
        )


@contextmanager
def bare_loops(rate_hz: int) -> Iterator[list[Wakes]]:
    """One on each processor meanwhile; afterwards the list has what each of them counted."""
    found: list[Wakes] = []
    words = [sys.executable, "-m", "tests.benchmarks.bare_loop", "--rate-hz", str(rate_hz), "--core"]
    loops = [
        subprocess.Popen(
            [*words, str(core)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
        )
        for core in sorted(os.sched_getaffinity(0))
    ]
    try:
        yield found
    finally:
        for loop in loops:
            said, _ = loop.communicate(timeout=END_TIMEOUT_S)
            found.append(Wakes(*json.loads(said)))


def count(core: int, rate_hz: float) -> Wakes:
    """What a loop at that rate counts on one processor, until this process's input ends.

    Raises:
        PermissionError: this machine grants no SCHED_FIFO.
    """
    os.sched_setaffinity(0, {core})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    period_ns = round(NS_PER_S / rate_hz)
    found = Wakes(0, 0, 0, 0)
    due_ns = time.monotonic_ns() + period_ns
    while True:
        left_s = max(0.0, (due_ns - time.monotonic_ns()) / NS_PER_S)
        if select.select([sys.stdin], [], [], left_s)[0]:
            return found
        late_ns = time.monotonic_ns() - due_ns
        missed = max(0, late_ns // period_ns)
        found = found.plus(Wakes(1, missed, int(late_ns > LATE_NS), late_ns))
        due_ns += (1 + missed) * period_ns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--core", type=int, required=True)
    parser.add_argument("--rate-hz", type=float, required=True)
    options = parser.parse_args()
    print(json.dumps(count(options.core, options.rate_hz)))
