"""Drive a scenario, in virtual time or with real processes, and judge it by the oracles."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.analysis.places import caught
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import error_text
from handfast.deploy.drive.display.live_view import make_view
from handfast.deploy.drive.local import LocalRun
from handfast.deploy.processes.placement import place
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.run_folder import RunFolder
from handfast.deploy.simulate.worker_pool import Abandoned, GoOn
from handfast.deploy.sweep.run import drive as simulate
from handfast.deploy.verdict.oracles_drive import RECOVERED_S, last_trouble_s
from handfast.deploy.verdict.run_result import RunResult
from handfast.deploy.verdict.violations import Violation

CRASH: Final = "crash"
"""Violation: the program failed."""
READY: Final = "ready"
"""Violation: the fleet did not begin."""
ORDERS: Final = "orders"
"""Violation: an order was refused."""
IN_FORMATION: Final = "in formation"
CAUGHT: Final = "at rest in another shape"
SOON: Final = "elsewhere, too soon to judge"
ELSEWHERE: Final = "elsewhere"
ENDS: Final = (IN_FORMATION, CAUGHT, SOON, ELSEWHERE)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one scenario.

    Attributes:
        violations: violations of oracles, `CRASH`, `READY` and `ORDERS`.
        checked: oracles that had something to judge.
        transitions: how often robots took each row of the state machine's table.
        limits: number of ticks in which the safety filter changed the law's command.
        ended: `IN_FORMATION`; `CAUGHT` (at rest in another shape, see `deploy.analysis.balance`); `SOON`
            (elsewhere, within 20 s of the last fault or change); or `ELSEWHERE`.
        driven_s: fleet time. wall_s: real time.
    """

    violations: tuple[Violation, ...] = ()
    checked: frozenset[str] = frozenset()
    transitions: Mapping[str, int] = field(default_factory=dict)
    limits: int = 0
    ended: str = ""
    driven_s: float = 0.0
    wall_s: float = 0.0

    @property
    def oracles(self) -> frozenset[str]:
        """Names of the oracles that found violations."""
        return frozenset(violation.oracle for violation in self.violations)


def drive(text: str, go_on: GoOn = lambda: True) -> Outcome:
    """Drive a scenario in virtual time and judge it. An exception of the program is a violation.

    Raises:
        handfast.agent.fleet.model.FleetError: the text is not a valid fleet file.
        Abandoned: `go_on`, which is called a few times for each second of fleet time, returned False.
    """
    begun_s = time.perf_counter()
    fleet = resolved(parse_fleet(text, source="scenario"))
    try:
        outcome = judged(RunResult(simulate(fleet, go_on)))
    except Abandoned:
        raise
    except Exception as error:
        outcome = Outcome((Violation(CRASH, 0.0, error_text(error, "The program failed: ")),))
    return replace(outcome, wall_s=time.perf_counter() - begun_s)


def drive_real(text: str, folder: Path, interrupt: Interrupt) -> Outcome:
    """Drive a scenario with real processes on this machine, and judge its recording in `folder`."""
    begun_s = time.perf_counter()
    placed = place(resolved(parse_fleet(text, source=str(folder))))
    try:
        kept = RunFolder(folder, placed.fleet, "run")
        run = LocalRun(placed.fleet, kept, make_view(quiet=True), interrupt, placed.vehicles)
        try:
            run.run()
        finally:
            kept.close(run.reasons, interrupted=interrupt.count > 0)
    finally:
        placed.ports.close()
    return replace(judged(RunResult(read_run(folder))), wall_s=time.perf_counter() - begun_s)


def judged(result: RunResult) -> Outcome:
    """Judge a drive. Violations that nobody could have avoided do not count."""
    recording, found = result.recording, result.violations
    kind = READY if recording.epoch_ns is None else ORDERS
    wrong = [Violation(kind, 0.0, reason) for reason in recording.reasons]
    wrong += [broken for each in found.values() for broken in each or () if broken.avoidable]
    transitions, limits = _exercised(recording)
    checked = frozenset(name for name, each in found.items() if each is not None)
    return Outcome(tuple(wrong), checked, transitions, limits, _ended(result), recording.end_s)


def _exercised(recording: Recording) -> tuple[dict[str, int], int]:
    """Count transitions, and ticks in which the safety filter changed the command."""
    transitions: Counter[str] = Counter()
    limits = 0
    for robot in recording.robots.values():
        limits += robot.status.totals().get("filtered.any", 0)
        transitions.update(change.row for change in robot.status.changes())
    return dict(transitions), limits


def _ended(result: RunResult) -> str:
    recording, analysis = result.recording, result.analysis
    if analysis.counts[-1].any() and not analysis.off[-1].any():
        return IN_FORMATION
    if caught(analysis, result.fleet):
        return CAUGHT
    recovers_s = (last_trouble_s(recording, analysis) or 0.0) + RECOVERED_S
    return SOON if recovers_s >= recording.end_s else ELSEWHERE
