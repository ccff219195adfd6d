"""A large fleet on a small machine: `lattice45`, 90 processes; how many ticks are missed."""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import median

from agent.fleet.loading import load_fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.processes import ROLES, measure, start_handfast


def run(options: Options) -> Result:
    fleet = resolved(load_fleet(fleet_path("lattice45")))
    window_s = 15.0 if options.quick else 60.0
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        cost = measure(
            fleet, Path(folder) / "run", start_handfast, drive=True, settle_s=3.0, window_s=window_s
        )
    traffic = cost.traffic
    ticks = len(fleet.robots) * fleet.fleet.rate_hz * window_s
    at = f"{2 * len(fleet.robots)} processes at {fleet.fleet.rate_hz:.0f} Hz"
    return Result(
        [
            Figure("ticks missed by agents", 100.0 * traffic.agents_missed / ticks, "%", note=at),
            Figure("ticks missed by plants", 100.0 * traffic.plants_missed / ticks, "%"),
            Figure("tick of an agent, median", median(traffic.tick_us), "us"),
            *(Figure(f"CPU per {role}", 100.0 * cost.cpu[role], "% of a core") for role in ROLES),
            *(Figure(f"memory per {role}", cost.pss[role], "MB") for role in ROLES),
        ]
    )
