"""One scenario driven in virtual time, and what the oracles say of it.

A scenario is the text of a fleet file, with its faults and orders. Whether somebody wrote it, it was drawn
from a seed (`deploy.chaos.draw`) or made smaller (`deploy.chaos.shrink`) makes no difference.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import tomli_w

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.analysis.balance import caught
from deploy.console.wording import error_text
from deploy.recording.recording import Recording
from deploy.simulate.judged import drive as simulate
from deploy.simulate.worker_pool import Abandoned, GoOn
from deploy.verdict.oracles_drive import RECOVERED_S, last_trouble_s
from deploy.verdict.run_result import RunResult
from deploy.verdict.violations import Violation

CRASH: Final = "crash"
READY: Final = "ready"
ORDERS: Final = "orders"
"""What can be wrong beside the oracles: the program failed, the fleet did not begin, an order was refused."""
IN_FORMATION: Final = "in formation"
CAUGHT: Final = "at rest in another shape"
SOON: Final = "elsewhere, too soon to judge"
ELSEWHERE: Final = "elsewhere"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one scenario.

    Attributes:
        violations: of oracles, in time for each; or what went wrong beside them.
        checked: oracles that had something to look at.
        states, transitions: how often robots came into each state, and by which row of the table.
        limits: ticks in which the safety filter changed what the law asked for.
        ended: `IN_FORMATION`, `CAUGHT` (at rest in another shape, `deploy.analysis.balance`), `SOON` (within
        20 s of
            the last fault or change, or of the start without one: on the way, stopped) or `ELSEWHERE` (held
            up).
        driven_s: of fleet time.
        wall_s: real time that it took.
    """

    violations: tuple[Violation, ...] = ()
    checked: frozenset[str] = frozenset()
    states: Mapping[str, int] = field(default_factory=dict)
    transitions: Mapping[str, int] = field(default_factory=dict)
    limits: int = 0
    ended: str = ""
    driven_s: float = 0.0
    wall_s: float = 0.0

    @property
    def oracles(self) -> frozenset[str]:
        """Names of those that were violated."""
        return frozenset(violation.oracle for violation in self.violations)


def scenario_text(tables: Mapping[str, Any]) -> str:
    """The fleet file of these tables, with arrays of numbers on one line."""
    return re.sub(r"\[\s+([^\[\]{}\"]*?),?\s+\]", _on_one_line, tomli_w.dumps(tables))


def _on_one_line(match: re.Match[str]) -> str:
    return f"[{', '.join(match[1].replace(',', ' ').split())}]"


def drive(text: str, go_on: GoOn = lambda: True, source: str = "scenario") -> Outcome:
    """Drives a scenario and judges it. A program that fails is a violation.

    Raises:
        agent.fleet.model.FleetError: the text is not a valid fleet file.
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    begun_s = time.perf_counter()
    fleet = resolved(parse_fleet(text, source=source))
    try:
        outcome = judged(RunResult(simulate(fleet, go_on)))
    except Abandoned:
        raise
    except Exception as error:
        outcome = Outcome((Violation(CRASH, 0.0, error_text(error, "The program failed: ")),))
    return replace(outcome, wall_s=time.perf_counter() - begun_s)


def judged(result: RunResult) -> Outcome:
    """What a drive came to, whether of real processes or in virtual time: what nobody could have avoided is
    no fault of the system's."""
    recording, found = result.recording, result.violations
    beside = READY if recording.epoch_ns is None else ORDERS
    wrong = [Violation(beside, 0.0, reason) for reason in recording.reasons]
    states, transitions, limits = _exercised(recording)
    return Outcome(
        (*wrong, *(broken for each in found.values() for broken in each or () if broken.avoidable)),
        frozenset(name for name, each in found.items() if each is not None),
        states,
        transitions,
        limits,
        _ended(result),
        recording.end_s,
    )


def _exercised(recording: Recording) -> tuple[dict[str, int], dict[str, int], int]:
    """How often each state was come into, by which transitions, and what the safety filter did."""
    states: Counter[str] = Counter()
    transitions: Counter[str] = Counter()
    limits = 0
    for robot in recording.robots.values():
        limits += robot.status.totals().get("filtered.any", 0)
        states.update(robot.status.states[:1])
        for change in robot.status.changes():
            states[change.state] += 1
            transitions[change.row] += 1
    return dict(states), dict(transitions), limits


def _ended(result: RunResult) -> str:
    recording, analysis = result.recording, result.analysis
    if analysis.counts[-1].any() and not analysis.off[-1].any():
        return IN_FORMATION
    if caught(analysis, result.fleet):
        return CAUGHT
    return (
        SOON if (last_trouble_s(recording, analysis) or 0.0) + RECOVERED_S >= recording.end_s else ELSEWHERE
    )
