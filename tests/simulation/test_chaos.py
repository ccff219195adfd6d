"""How a scenario ends, and how one that fails is made smaller."""

from __future__ import annotations

import pytest

from agent.control import constraint_assembly
from deploy.chaos.draw import draw
from deploy.chaos.report import parts
from deploy.chaos.run import ELSEWHERE, IN_FORMATION, SOON, drive, scenario_text
from deploy.chaos.shrink import shrink
from deploy.console.arguments import fleet_path, fleet_text

WALL = "\n[[obstacle]]\npoints_m = [[-0.45, -0.2], [0.45, -0.2], [0.45, 0.2], [-0.45, 0.2]]\n"


@pytest.mark.parametrize(
    ("duration_s", "more", "ended"),
    [(3, "", SOON), (20, "", IN_FORMATION), (20, WALL, SOON), (21, WALL, ELSEWHERE)],
)
def test_how_a_scenario_ended(duration_s: int, more: str, ended: str) -> None:
    text = fleet_text(fleet_path("pair")).replace("duration_s = 20", f"duration_s = {duration_s}") + more
    assert drive(text).ended == ended


def test_the_same_scenario_ends_the_same() -> None:
    text = scenario_text(draw(53))
    first, again = drive(text), drive(text)
    assert first.driven_s > 20.0
    assert (first.violations, first.states, first.transitions, first.limits) == (
        again.violations,
        again.states,
        again.transitions,
        again.limits,
    )


@pytest.mark.slow
@pytest.mark.patches
def test_a_fault_of_the_program_is_found_and_made_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constraint_assembly.ConstraintAssembly, "_keep_away", lambda *args, **options: None)
    tables = draw(BROKEN)
    outcome = drive(scenario_text(tables))
    assert "separation" in outcome.oracles
    small, again = shrink(tables, outcome, lambda: True, runs_max=60)
    assert outcome.violations[0].oracle in again.oracles
    assert sum(parts(small).values()) <= 4 < sum(parts(tables).values())
    monkeypatch.undo()
    assert drive(scenario_text(small)).violations == ()


BROKEN = 53
"""A seed in which robots without an edge meet."""
