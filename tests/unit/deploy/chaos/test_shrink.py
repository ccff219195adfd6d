"""Scenarios that fail, made smaller."""

from __future__ import annotations

from typing import Any

import pytest

from agent.fleet.loading import parse_fleet
from deploy.chaos import shrink as shrinking
from deploy.chaos.draw import draw
from deploy.chaos.profiles.mixed import draw_mixed
from deploy.chaos.report import parts
from deploy.chaos.run import Outcome, scenario_text
from deploy.chaos.shrink import shrink, without_robot
from deploy.simulate.worker_pool import Abandoned, GoOn
from deploy.verdict.violations import Violation

SEED = 66
"""Many robots, orders and rules."""
FAILED = Outcome((Violation("separation", 9.0, "too close"),))


class Bug:
    """A program in which `separation` fails if some parts come together; counts what is driven."""

    def __init__(self, *needed: str) -> None:
        self._needed = needed
        self.runs = 0

    def __call__(self, text: str, go_on: GoOn) -> Outcome:
        if not go_on():
            raise Abandoned
        self.runs += 1
        fleet = parse_fleet(text, source="here")
        if fleet.fleet.duration_s < 9.0:
            return Outcome()
        return FAILED if all(part in text for part in self._needed) else Outcome()


def small(monkeypatch: pytest.MonkeyPatch, bug: Bug, **options: Any) -> dict[str, Any]:
    monkeypatch.setattr(shrinking, "drive", bug)
    tables, outcome = shrink(draw_mixed(SEED), FAILED, lambda: True, **options)
    assert outcome == FAILED
    return tables


def test_what_is_not_needed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    before = draw_mixed(SEED)
    robot = before["robot"][2]["id"]
    bug = Bug(f"id = {robot},", 'kind = "stop"')
    tables = small(monkeypatch, bug)
    assert [row["id"] for row in tables["robot"]] == [robot]
    assert [order["kind"] for order in tables["order"]] == ["stop"]
    assert not {"faults", "obstacle", "geofence", "supervision"} & set(tables)
    assert tables["trajectory"] == {"kind": "hold"}
    assert tables["fleet"]["duration_s"] == 9.5
    assert "control" not in tables
    assert sum(parts(tables).values()) < 5 < sum(parts(before).values())


def test_no_more_is_driven_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    bug = Bug()
    small(monkeypatch, bug, runs_max=7)
    assert bug.runs == 7


def test_another_fault_is_not_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    other = Outcome((Violation("clearance", 1.0, "into a wall"),))
    monkeypatch.setattr(shrinking, "drive", lambda text, go_on: other)
    tables, outcome = shrink(draw_mixed(SEED), FAILED, lambda: True)
    assert (tables, outcome) == (draw_mixed(SEED), FAILED)


def test_it_stops_when_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shrinking, "drive", Bug())
    with pytest.raises(Abandoned):
        shrink(draw_mixed(SEED), FAILED, lambda: False)


@pytest.mark.parametrize("seed", range(12))
def test_a_fleet_without_a_robot_is_a_fleet(seed: int) -> None:
    tables = draw(seed)
    members = [row["id"] for row in tables["robot"] if not row.get("reserve")]
    for row in tables["robot"]:
        left = without_robot(tables, row["id"])
        if members == [row["id"]]:
            continue
        fleet = parse_fleet(scenario_text(left), source=f"seed {seed}")
        assert row["id"] not in fleet.ids
        assert len(fleet.ids) == len(tables["robot"]) - 1
    assert tables == draw(seed)  # untouched
