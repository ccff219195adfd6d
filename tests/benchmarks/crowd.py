"""45 robots whose places are not assigned: from random starts, and across a field of ten obstacles.

The whole chain (plants, messages, agents) in virtual time, on all cores. Slots are not assigned, so the
robots have to cross the whole crowd. Safe means that no two hands, neighbours or not, were ever nearer than
the safe distance (`deploy.verdict.oracles`). Who did not settle is listed with the reason. Beside them ORCA's
points on the same starts, which keep no formation (`tests.benchmarks.arrival`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.analysis.places import caught
from handfast.deploy.console.arguments import fleet_path, fleet_text
from handfast.deploy.simulate.worker_pool import GoOn
from handfast.deploy.sweep.plan import Plan, Question, make_plan
from handfast.deploy.sweep.run import Row, Runs, drive, execute
from tests.benchmarks import arrival
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.random_starts import HEADING, line
from tests.benchmarks.rows import results

SIDE_M: Final = 9.0
COUNT: Final = 50
COUNT_QUICK: Final = 4
AWAY_M: Final = 0.1
WORST: Final = 4
"""Of a run that did not settle so many robots are told of, those that are farthest off their places."""
STILL: Final = ("formation.assign=false", "trajectory.kind=hold", "fleet.duration_s=90")
ACROSS: Final = (
    "formation.assign=false",
    "trajectory.kind=waypoints",
    "trajectory.waypoints_m=[[0, 0], [24, 0]]",
    "trajectory.speed_mps=0.4",
    "fleet.duration_s=120",
)
OBSTACLES: Final = (
    (7.0, 0.4, 0.4), (7.6, -3.4, 0.3), (8.2, 3.6, 0.5), (9.8, -1.4, 0.35), (10.4, 1.9, 0.25),
    (11.6, 4.6, 0.4), (12.2, -4.0, 0.5), (13.0, 0.2, 0.45), (14.8, 2.4, 0.3), (15.2, -2.0, 0.4),
)  # fmt: skip
"""x, y, radius, m: gaps that single robots pass, and the formation does not."""


def field() -> str:
    """The obstacles as a fleet file has them."""
    return "".join(f"\n[[obstacle]]\ncentre_m = [{x}, {y}]\nradius_m = {r}\n" for x, y, r in OBSTACLES)


@dataclass(frozen=True, slots=True)
class Told:
    """The runs of a plan, each with the reason why it is not good; "" when it is."""

    plan: Plan

    def execute(self, number: int, go_on: GoOn) -> tuple[Row, str]:
        row = execute(self.plan, number, go_on)
        return row, "" if row.good or not row.numbers else why(self.plan.fleet(number), go_on)

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> tuple[Row, str]:
        row = Runs(self.plan).unfinished(number, reason, wall_s, timed_out=timed_out)
        return row, row.reason


def why(fleet: Fleet, go_on: GoOn) -> str:
    """What keeps a formation from its shape at the end, and which robots: drives it once more."""
    recording = drive(fleet, go_on)
    a = analyse(recording, resolve(fleet))
    off = int(a.off[-1].sum())
    shape = "at rest in another shape" if caught(a, fleet) else "on its way"
    away = np.hypot(*(a.hands[-1] - a.desired[-1]).T)
    order = np.argsort(-away)[:WORST]
    told = []
    for index in order[away[order] > AWAY_M].tolist():
        state, reason = recording.robots[a.ids[index]].status.at(recording.end_s) or ("", "")
        words = f"{state}, {reason}" if reason else state
        told.append(f"robot {a.ids[index]} {away[index]:.2f} m off its place ({words})")
    return f"{shape}, {off} of {int(a.counts[-1].sum())} edges off; " + ", ".join(told)


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    path = fleet_path("lattice45")
    result = Result()
    lines, beside = [], []
    for name, text, overrides in (
        ("free", fleet_text(path), STILL),
        ("ten obstacles", fleet_text(path) + field(), ACROSS),
    ):
        plan = make_plan(Question(str(path), text, "joint", overrides, (), count, SIDE_M))
        found = sorted(results(name, Told(plan), plan.runs), key=lambda each: each[0].run)
        rows = [row for row, _ in found]
        lines.append(line(name, rows))
        safe = sum(each.safe is True for each in rows)
        result.figures.append(
            Figure(f"{name}: runs without a pair below r_s", 100.0 * safe / count, "%", 100.0, at_most=False)
        )
        settled = sum(each.settled is True for each in rows)
        result.figures.append(Figure(f"{name}: runs that settle", 100.0 * settled / count, "%"))
        result.details += [f"{name}: run {row.run}: {reason}" for row, reason in found if reason]
        if arrival.has_orca():
            went = results(f"{name}, ORCA", arrival.Runs(plan.fleet, arrival.orca), count)
            beside.append(arrival.line(f"{name}, ORCA", went))
    result.details += table(("crowd", *HEADING), lines)
    if beside:
        result.details += ["", *table(("crowd", *arrival.HEADING), beside)]
    result.details.append(f"{count} starts each, {SIDE_M:g} m square")
    return result
