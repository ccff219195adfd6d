"""One run of a sweep: driven in virtual time, only what its metrics need is looked at, one row is left."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from handfast.deploy.console.wording import error_text
from handfast.deploy.simulate import judged
from handfast.deploy.simulate.worker_pool import Abandoned
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.run_result import RunResult

PASSED: Final = "passed"
FAILED: Final = "failed"
CRASHED: Final = "crashed"
TIMED_OUT: Final = "timed out"
VERDICTS: Final = (PASSED, FAILED, CRASHED, TIMED_OUT)


@dataclass(frozen=True, slots=True)
class Row:
    """The result of one run.

    Attributes:
        run: its number in the plan.
        seed: its `fleet.seed`.
        verdict: `PASSED`, `FAILED` (it was driven, and something was wrong), `CRASHED` or `TIMED_OUT` (it
            was not driven to the end: there are no numbers).
        reason: the first of the verdict's reasons, one line, empty when it passed.
        safe: the oracle `separation` found nothing: no two robots came below the safe distance; None when
            not known.
        settled: every edge was within 5 % of its distance at the end, and every robot at its place, or soon
            there (`deploy.verdict.tracking`); None when not known.
        numbers: by the names of `deploy.verdict.metrics.columns`, those that are known.
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


@dataclass(frozen=True, slots=True)
class Runs:
    """The runs of a plan, as `deploy.simulate.worker_pool.Pool` drives them."""

    plan: Plan

    def execute(self, number: int, go_on: Callable[[], bool]) -> Row:
        return execute(self.plan, number, go_on)

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> Row:
        return unfinished(self.plan, number, TIMED_OUT if timed_out else CRASHED, reason, wall_s)


def execute(plan: Plan, run: int, go_on: Callable[[], bool] = lambda: True) -> Row:
    """Drives one run; whatever goes wrong in it becomes its row.

    Raises:
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    begun = time.perf_counter()
    try:
        fleet = plan.fleet(run)
        result = RunResult(judged.drive(fleet, go_on))
        numbers = {name: metric.value(result) for name, (metric, _) in metrics.columns().items()}
        separation = result.violations["separation"]
        return Row(
            run,
            plan.run_seed(run),
            PASSED if result.passed else FAILED,
            next(iter(result.reasons), ""),
            not separation,  # None: one robot has nobody to come near
            result.analysis.settling_s is not None and not result.tracking.reasons,
            {name: float(value) for name, value in numbers.items() if value is not None},
            time.perf_counter() - begun,
        )
    except Abandoned:
        raise
    except (Exception, KeyboardInterrupt) as error:  # a Ctrl-C is not sent here: a plugin has raised it
        return unfinished(plan, run, CRASHED, error_text(error), time.perf_counter() - begun)


def unfinished(plan: Plan, run: int, verdict: str, reason: str, wall_s: float) -> Row:
    """The row of a run that was not driven to its end."""
    return Row(run, plan.run_seed(run), verdict, reason, wall_s=wall_s)
