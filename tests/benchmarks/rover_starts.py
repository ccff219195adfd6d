"""How soon the bundled rovers are in formation: from their own starts, and from random starts and headings.

Simulated rovers with the measured lags in virtual time; distances are the true ones of the hand points, not
those by the rovers' own estimates. Random starts are over the rectangle of the bundled ones, no two nearer
than 1.5 safe distances; places are not assigned, so that ways cross.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from agent.fleet.loading import load_fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.rover_drive import LATE_S, driven, started_anywhere

COUNT: Final = 50
COUNT_QUICK: Final = 5
BUNDLED_S: Final = 60.0
RANDOM_S: Final = 60.0
WITHIN_S: Final = 45.0
"""So soon all should be in formation, from random starts."""
GAP: Final = 1.5
"""Of the safe distance, between any two starts."""
BUNDLED_TARGET_S: Final = 13.0
MEDIAN_TARGET_S: Final = 20.0
LATE_TARGET_M: Final = 0.05


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    fleet = load_fleet(fleet_path("rovers"))
    safe_m = fleet.formation.safe_distance_m
    own = driven(resolved(replace(fleet, fleet=replace(fleet.fleet, duration_s=BUNDLED_S))))
    shorter = replace(fleet, fleet=replace(fleet.fleet, duration_s=RANDOM_S))
    runs = [driven(started_anywhere(shorter, seed, GAP * safe_m)) for seed in range(count)]
    settled = np.array([each.settled for each in runs])
    closest = np.array([each.pairs.min() for each in runs])
    late = np.array([each.late for each in runs if each.settled < RANDOM_S - LATE_S - 10.0])
    result = Result(
        [
            Figure("its own starts: settled after", own.settled, "s", BUNDLED_TARGET_S),
            Figure("its own starts: worst edge, last 15 s", own.late, "m", LATE_TARGET_M),
            Figure("its own starts: closest pair", float(own.pairs.min()), "m", safe_m, at_most=False),
            Figure("random starts: settled after, median", float(np.median(settled)), "s", MEDIAN_TARGET_S),
            Figure("random starts: settled after, 90 %", float(np.percentile(settled, 90)), "s"),
            Figure("random starts: settled after, slowest", float(settled.max()), "s"),
            Figure(
                f"random starts that settle within {WITHIN_S:g} s",
                100.0 * float(np.mean(settled <= WITHIN_S)),
                "%",
                100.0,
                at_most=False,
            ),
            Figure(
                "random starts: worst edge, last 15 s of those settled 10 s before",
                float(late.max()) if len(late) else float("nan"),
                "m",
                LATE_TARGET_M,
            ),
            Figure("random starts: closest pair", float(closest.min()), "m", safe_m, at_most=False),
            Figure(
                "random starts that stay safe",
                100.0 * float((closest >= safe_m).mean()),
                "%",
                100.0,
                at_most=False,
            ),
        ]
    )
    lines = [
        [
            str(seed),
            f"{each.settled:.1f}" if each.stays else "-",
            f"{each.pairs.min():.2f}",
            f"{1000.0 * each.late:.0f}",
        ]
        for seed, each in enumerate(runs)
    ]
    result.details = table(("start", "settled s", "closest pair m", "worst edge late mm"), lines)
    result.details.append(f"{count} starts, {RANDOM_S:g} s each")
    return result
