"""The tables of random starts: which law keeps six robots apart, how soon it brings them into formation, and
whether the law that is shipped does so at every scale.

Six robots of the delta, uniform in a square, the formation turned at random, slots assigned; the
whole chain (plants, messages, agents) in virtual time, on all cores. The same starts for every law. Where
laws are compared avoidance is switched off: it would keep robots apart whatever the law. Scales are driven
with every default, the square and the safe distance as large as the formation makes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console.arguments import fleet_path, fleet_text
from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import Row
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.rows import drive, share

SCALES_M: Final = (0.3, 0.5, 1.0, 3.0, 10.0)
"""Lengths of the edges."""
SAFE_SHARE: Final = 0.22
"""r_s / d, as the delta has it."""
LAWS: Final = ("joint", "edge", "paper", "penalty")
REPAIRED: Final = ("joint", "edge")
SIDE_M: Final = 4.0
DURATION_S: Final = 40.0
COUNT: Final = 1000
COUNT_QUICK: Final = 60
SETTLING_TARGET_S: Final = 8.5
HEADING: Final = (
    "above r_s %", "settled %", "median s", "p95 s", "max s", "closest edge m", "closest pair m",
)  # fmt: skip
"""Of what `line` gives after the name."""


def line(law: str, rows: Sequence[Row]) -> list[str]:
    settled = [each.numbers["settling_time_s"] for each in rows if each.settled]
    times = [number(float(np.percentile(settled, at))) for at in (50, 95, 100)] if settled else ["-"] * 3
    driven = [each for each in rows if each.numbers]
    return [
        law,
        share(sum(each.safe is True for each in rows), len(rows)),
        share(len(settled), len(rows)),
        *times,
        f"{min(each.numbers['min_distance_m.edge'] for each in driven):.4f}",
        f"{min(each.numbers['min_distance_m.any'] for each in driven):.4f}",
    ]


def of_edges(row: Row, safe_m: float) -> Row:
    """The row, safe where no two robots of an edge came below `safe_m`: of others the law says nothing."""
    nearest = row.numbers.get("min_distance_m.edge")
    return row if nearest is None else replace(row, safe=nearest >= safe_m)


def scaled(distance_m: float) -> str:
    """The text of a fleet file: the delta with edges that long, at rest, and no gain given.

    Speed limits do not grow with it: larger ones have longer.
    """
    delta = load_fleet(fleet_path("delta"))
    places = [[distance_m * x, distance_m * y] for x, y in delta.formation.offsets or ()]
    robots = "".join(
        f"[[robot]]\nid = {each.id}\nx_m = {each.x_m}\ny_m = {each.y_m}\n" for each in delta.robots
    )
    return (
        f'[fleet]\nname = "scale"\nduration_s = {20.0 + 2.0 * distance_m}\n[formation]\n'
        f"edges = {[list(edge) for edge in delta.formation.edges]}\noffsets = {places}\n"
        f"safe_distance_m = {SAFE_SHARE * distance_m}\n{robots}"
    )


def run_scales(result: Result, count: int) -> None:
    """Adds the table of scales to `result`."""
    lines = []
    for distance_m in SCALES_M:
        name = f"d = {distance_m:g} m"
        question = Question(name, scaled(distance_m), None, (), (), count, SIDE_M * distance_m)
        rows = drive(name, make_plan(question))
        lines.append(line(name, rows))
        for what, good in (("settle", "settled"), ("stay safe", "safe")):
            share_of = 100.0 * sum(getattr(each, good) is True for each in rows) / count
            result.figures.append(Figure(f"{name}: starts that {what}", share_of, "%", 100.0, at_most=False))
        bad = [str(each.run) for each in rows if not (each.safe and each.settled)]
        if bad:
            result.details.append(f"{name}: runs not safe or not settled: {', '.join(bad[:20])}")
    result.details += table(("edges", *HEADING), lines)


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    path = fleet_path("delta")
    result = Result()
    lines = []
    for law in LAWS:
        overrides = (f"fleet.duration_s={DURATION_S}", "avoidance.enabled=false")
        question = Question(str(path), fleet_text(path), law, overrides, (), count, SIDE_M)
        plan = make_plan(question)
        safe_m = plan.cells[0].formation.safe_distance_m
        rows = [of_edges(each, safe_m) for each in drive(law, plan)]
        lines.append(line(law, rows))
        if law not in REPAIRED:
            continue
        settled = [each.numbers["settling_time_s"] for each in rows if each.settled]
        safe = sum(each.safe is True for each in rows)
        result.figures += [
            Figure(f"{law}: starts that stay above r_s", 100.0 * safe / count, "%", 100.0, at_most=False),
            Figure(f"{law}: starts that settle", 100.0 * len(settled) / count, "%", 100.0, at_most=False),
        ]
        if settled:
            result.figures.append(
                Figure(f"{law}: settling time, median", float(np.median(settled)), "s", SETTLING_TARGET_S)
            )
        bad = sorted(each.run for each in rows if not each.good)
        if bad:
            result.details.append(f"{law}: runs not safe or not settled: {', '.join(map(str, bad[:20]))}")
    result.details += table(("law", *HEADING), lines)
    run_scales(result, count)
    result.details.append(f"{count} starts each, {SIDE_M:g} d wide square, {DURATION_S:g} s")
    return result
