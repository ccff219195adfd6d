"""Questions for tests of sweeps, and rows that answer them."""

from __future__ import annotations

from typing import Any

import numpy as np

from handfast.deploy.console.arguments import fleet_text
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep.folder import SweepFolder
from handfast.deploy.sweep.plan import Plan, Question
from handfast.deploy.sweep.run import FAILED, PASSED, Row
from handfast.deploy.sweep.varied import Axis, Range, parse_over


def ask(*over: str, fleet: str = "delta", **rest: Any) -> Question:
    path = FLEETS / f"{fleet}.toml"
    varied = [parse_over(each) for each in over]
    return Question(
        str(path),
        fleet_text(path),
        axes=tuple(each for each in varied if isinstance(each, Axis)),
        ranges=tuple(each for each in varied if isinstance(each, Range)),
        **rest,
    )


def made(plan: Plan, run: int, **numbers: float) -> Row:
    """A row of a run that was safe and settled, but for what is given."""
    known = {
        "settling_time_s": 5.0, "min_distance_m.edge": 0.6, "min_distance_m.any": 0.5,
        "rms_distance_error_m": 0.25, "final_distance_error_m": 1e-3, "final_tracking_error_m": 1e-2,
        "age_p50_ms": 20.0, "age_p99_ms": 20.0, "age_max_ms": 40.0,
    } | numbers  # fmt: skip
    known = {name: value for name, value in known.items() if np.isfinite(value)}
    safe, settled = known["min_distance_m.any"] >= 0.22, "settling_time_s" in known
    verdict, reason = (PASSED, "") if safe and settled else (FAILED, "Something, and\nmore.")
    return Row(run, plan.run_seed(run), verdict, reason.replace("\n", " "), safe, settled, known, 0.125)


NEVER = float("nan")


def fill(folder: SweepFolder, runs: range) -> None:
    for run in runs:
        folder.add(made(folder.plan, run, **{"settling_time_s": NEVER} if run == 2 else {}))
