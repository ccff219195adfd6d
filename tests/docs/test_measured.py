"""Figures that documents give of drives in virtual time, the same every time until code changes them.

Only some of each table: all of them take minutes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.console.arguments import fleet_path, fleet_text, scenario_path
from handfast.deploy.sweep import run
from handfast.deploy.sweep.plan import Question, make_plan
from handfast.deploy.sweep.run import execute
from handfast.deploy.sweep.varied import parse_axis

DOCS = Path(__file__).parents[2] / "docs"

pytestmark = pytest.mark.long


def driven(scenario: str) -> Analysis:
    """The delta, driven."""
    fleet = resolved(load_fleet(fleet_path("delta"), scenario=scenario_path(scenario)))
    return analyse(run.drive(fleet), resolve(fleet))


def nearest_m(a: Analysis, since_s: float) -> float:
    """How near two robots come, whether they share an edge or not, m."""
    hands = a.hands[a.grid >= since_s]
    i, j = np.triu_indices(len(a.ids), 1)
    return float(np.nanmin(np.linalg.norm(hands[:, i] - hands[:, j], axis=-1)))


def page() -> str:
    return " ".join((DOCS / "faults.md").read_text(encoding="utf-8").split())


def test_two_halves_cut_off_from_each_other() -> None:
    a = driven("partition")
    off_m = float(np.nanmax(np.abs(a.distances - a.wanted)[a.grid >= 12.0]))
    assert a.settling_s is not None
    assert (
        f"Edges are up to {off_m:.2f} m off, the closest pair is {nearest_m(a, 12.0):.2f} m apart, "
        f"and {a.settling_s - 17.0:.1f} s after the end of the cut the formation is within 5 % again."
    ) in page()


def test_an_agent_killed_and_a_plant_frozen() -> None:
    nearest = nearest_m(driven("crash"), 10.0)
    assert f"Least distance of any pair since the first fault: {nearest:.2f} m." in page()


@pytest.mark.parametrize(("delay", "loss"), [("500 ms", "30 %"), ("1 s", "50 %")])
def test_late_and_fast(delay: str, loss: str) -> None:
    (table,) = re.findall(
        r"^\| delay \| no loss \|.*\n\|-.*\n((?:\|.*\n)+)", (DOCS / "faults.md").read_text(), re.M
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    column = {"no loss": 1, "10 %": 2, "30 %": 3, "50 %": 4}[loss]
    (told,) = (row[column] for row in rows if row[0] == delay)
    path = fleet_path("delta")
    wanted = f"faults.delay={delay}".replace(" ", ""), f"faults.loss={loss}".replace(" ", "")
    fields = tuple(map(parse_axis, wanted))
    given = ("trajectory.velocity_mps=[1.0, 0.0]", "fleet.duration_s=60")
    row = execute(make_plan(Question(str(path), fleet_text(path), None, given, fields, 1, None)), 0)
    assert told == f"{row.numbers['settling_time_s']:.1f} s"
    assert f"pair came closer than {row.numbers['min_distance_m.any']:.3f} m" in page()
