"""One run of a sweep: driven in virtual time, only what its metrics need is looked at, one row is left."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from agent import keys
from agent.fleet import Fleet
from agent.formation import resolve
from agent.messages import decode
from deploy import metrics
from deploy.recording import RunData
from deploy.simulation import Simulation
from deploy.sweep import Plan

PASSED: Final = "passed"
FAILED: Final = "failed"
CRASHED: Final = "crashed"
TIMED_OUT: Final = "timed out"
NUMBERS: Final[Mapping[str, tuple[str, ...]]] = {
    "settling_time_s": ("settling_time_s",),
    "min_distance_m.edge": ("min_distance_m", "edge"),
    "min_distance_m.any": ("min_distance_m", "any"),
    "rms_distance_error_m": ("rms_distance_error_m",),
    "final_distance_error_m": ("final_distance_error_m",),
    "final_tracking_error_m": ("final_tracking_error_m",),
    "age_p50_ms": ("age_of_information_ms", "p50"),
    "age_p99_ms": ("age_of_information_ms", "p99"),
    "age_max_ms": ("age_of_information_ms", "max"),
}
"""Columns of a row -> where `deploy.metrics.compute` has them."""


@dataclass(frozen=True, slots=True)
class Row:
    """What came of one run.

    Attributes:
        run: its number in the plan.
        seed: its `fleet.seed`.
        verdict: `PASSED`, `FAILED` (it was driven, and something was wrong), `CRASHED` or `TIMED_OUT` (it
            was not driven to the end: there are no numbers).
        reason: the first of the verdict's reasons, one line, empty when it passed.
        safe: no two robots of an edge came below the safe distance; None when not known.
        settled: every edge was within 5 % of its distance at the end; None when not known.
        numbers: those of `NUMBERS` that are known.
        wall_s: real time that it took.
    """

    run: int
    seed: int
    verdict: str
    reason: str
    safe: bool | None = None
    settled: bool | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    wall_s: float = 0.0

    @property
    def good(self) -> bool:
        """Safe and settled."""
        return self.safe is True and self.settled is True


class Abandoned(Exception):
    """The run was told not to go on."""


def measure(fleet: Fleet, go_on: Callable[[], bool]) -> dict[str, Any]:
    """Drives `fleet` (resolved); its metrics (`deploy.metrics.compute`) but for what they say of links.

    Raises:
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    name = fleet.fleet.name
    data = RunData(fleet, mode="simulate")
    # Hand states, wrenches and link traces are most of the messages, and no column is made of them.
    wanted = {keys.mission(name), keys.stop(name)}.union(
        *(
            (keys.plant_state(name, robot), keys.plant_truth(name, robot), keys.status(name, robot))
            for robot in fleet.ids
        )
    )

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        if key in wanted:
            data.feed(received_ns, key, decode(payload))

    def progress(_: float) -> bool:
        if not go_on():
            raise Abandoned
        return True

    simulation = Simulation(fleet, sink)
    simulation.run(progress)
    return metrics.compute(
        data.recording(reasons=simulation.reasons),
        fleet,
        resolve(fleet),
        mode="simulate",
        seed=fleet.fleet.seed,
        reasons=simulation.reasons,
    )


def execute(plan: Plan, run: int, go_on: Callable[[], bool] = lambda: True) -> Row:
    """Drives one run; whatever goes wrong in it becomes its row.

    Raises:
        Abandoned: as `measure`.
    """
    begun = time.perf_counter()
    try:
        fleet = plan.fleet(run)
        found = measure(fleet, go_on)
    except Abandoned:
        raise
    except Exception as error:
        return unfinished(plan, run, CRASHED, _told(error), time.perf_counter() - begun)
    numbers = {}
    for column, path in NUMBERS.items():
        value: Any = found
        for key in path:
            value = value[key]
        if value is not None:
            numbers[column] = float(value)
    least = numbers.get("min_distance_m.edge")
    return Row(
        run,
        plan.run_seed(run),
        PASSED if found["verdict"]["passed"] else FAILED,
        next(iter(found["verdict"]["reasons"]), ""),
        None if least is None else least >= fleet.formation.safe_distance_m,
        found["settling_time_s"] is not None,
        numbers,
        time.perf_counter() - begun,
    )


def unfinished(plan: Plan, run: int, verdict: str, reason: str, wall_s: float) -> Row:
    """The row of a run that was not driven to its end."""
    return Row(run, plan.run_seed(run), verdict, reason, wall_s=wall_s)


def _told(error: Exception) -> str:
    """An exception on one line, with the place that it comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({frames[-1].filename.rpartition('/')[2]}, line {frames[-1].lineno})" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300] + where
