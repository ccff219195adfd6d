"""Random starts on bad links: does the formation stay safe, settle, and how exactly does it end.

The delta with the joint law, slots assigned, the whole chain (plants, messages, links, agents) in virtual
time, on all cores; the same starts in every arm: `handfast sweep delta --random-starts`, for chosen cells.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from handfast.deploy.console.arguments import fleet_path, fleet_text
from handfast.deploy.console.data_files import SCENARIOS
from handfast.deploy.sweep.plan import Plan, Question, make_plan
from handfast.deploy.sweep.run import Row
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.rows import drive, share

COUNT: Final = 100
COUNT_QUICK: Final = 10
DURATION_S: Final = 40.0
SIDE_M: Final = 4.0

MIDDLING: Final = ("faults.delay=500ms", "faults.loss=30%")
BAD: Final = ("faults.delay=1s", "faults.loss=50%")
NOISE: Final = ("robot_defaults.position_noise_m=1cm", "robot_defaults.heading_noise_rad=0.5deg")
ARMS: Final[dict[str, tuple[str, ...]]] = {
    "no faults": (),
    "500 ms, 30 %": MIDDLING,
    "1 s, 50 %": BAD,
    "500 ms, 30 %, not predicted": (*MIDDLING, "control.prediction=false"),
    "1 s, 50 %, not predicted": (*BAD, "control.prediction=false"),
    "500 ms, 30 %, jitter and noise": (*MIDDLING, *NOISE),
    "1 s, 50 %, jitter and noise": (*BAD, *NOISE),
}
FINAL_MM: Final = {"500 ms, 30 %": 2.0, "1 s, 50 %": 5.0}


def plan_of(arm: str, count: int) -> Plan:
    """The runs of one arm."""
    path = fleet_path("delta")
    overrides = (f"fleet.duration_s={DURATION_S}", *ARMS[arm])
    text = fleet_text(path, SCENARIOS / "jitter.toml" if "jitter" in arm else None)
    return make_plan(Question(str(path), text, "joint", overrides, (), count, SIDE_M))


def row(arm: str, rows: Sequence[Row]) -> list[str]:
    settled = sorted(each.numbers["settling_time_s"] for each in rows if each.settled)
    final_mm = sorted(1e3 * each.numbers["final_distance_error_m"] for each in rows if each.numbers)
    times = [number(float(np.percentile(settled, share))) for share in (50, 95)] if settled else ["-", "-"]
    return [
        arm,
        share(sum(each.safe is True for each in rows), len(rows)),
        share(len(settled), len(rows)),
        *times,
        number(float(np.median(final_mm))) if final_mm else "-",
        number(final_mm[-1]) if final_mm else "-",
        f"{min(each.numbers['min_distance_m.any'] for each in rows if each.numbers):.3f}",
    ]


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    result = Result()
    lines = []
    begun = time.monotonic()
    for arm in ARMS:
        rows = drive(arm, plan_of(arm, count))
        lines.append(row(arm, rows))
        if "not predicted" in arm:
            continue  # there to compare
        bad = sorted(each.run for each in rows if not each.good)
        if bad:
            result.details.append(f"{arm}: runs not safe or not settled: {', '.join(map(str, bad[:20]))}")
        safe = 100.0 * sum(each.safe is True for each in rows) / count
        result.figures.append(Figure(f"{arm}: safe", safe, "%", 100.0, at_most=False))
        if "noise" in arm:
            continue
        settled = 100.0 * sum(each.settled is True for each in rows) / count
        result.figures.append(Figure(f"{arm}: settled", settled, "%", 100.0, at_most=False))
        final_mm = [1e3 * each.numbers["final_distance_error_m"] for each in rows if each.numbers]
        if final_mm:
            median_mm = float(np.median(final_mm))
            name = f"{arm}: final distance error, median"
            result.figures.append(Figure(name, median_mm, "mm", FINAL_MM.get(arm)))
    heading = [
        "delay, loss", "safe %", "settled %", "median s", "p95 s", "final mm", "max mm", "closest m",
    ]  # fmt: skip
    result.details += table(heading, lines)
    result.details.append(
        f"{count} starts each, {SIDE_M:g} m square, {DURATION_S:g} s; {time.monotonic() - begun:.0f} s in all"
    )
    return result
