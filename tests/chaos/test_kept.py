"""Kept scenarios: no oracle finds a violation in any of them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from handfast.agent.supervision.state_machine import TRANSITIONS
from tests.chaos.report import NOT_DRAWN
from tests.chaos.run import drive

KEPT = Path(__file__).parent / "kept"
DRAWN = sorted((KEPT / "drawn").glob("*.toml"))
"""Scenarios of seeds of the first generator. Together they take every transition, end in every way and have
every kind of course, fault and pair of faults."""
FOUND = sorted((KEPT / "found").glob("*.toml"))
"""Scenarios that once failed, each with a comment on the fault that it brought to light."""
COVERING = (4, 15, 41, 156, 170, 171, 176)
"""Seeds of `DRAWN` that together take every transition."""


@pytest.mark.long
@pytest.mark.parametrize("path", [*DRAWN, *FOUND], ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_no_oracle_is_violated_in_a_kept_scenario(path: Path) -> None:
    outcome = drive(path.read_text(encoding="utf-8"))
    assert [f"{each.oracle}: {each.message}" for each in outcome.violations] == []


@pytest.mark.slow
def test_kept_scenarios_take_every_transition() -> None:
    taken: Counter[str] = Counter()
    for seed in COVERING:
        outcome = drive((KEPT / "drawn" / f"{seed}.toml").read_text(encoding="utf-8"))
        assert outcome.violations == (), seed
        taken.update(outcome.transitions)
    assert {row.name for row in TRANSITIONS} - set(taken) == set(NOT_DRAWN)
