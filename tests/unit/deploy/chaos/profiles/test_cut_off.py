"""The cut-off profile: ways cross, and who crosses is not heard."""

from __future__ import annotations

from itertools import product
from math import dist
from typing import Any

import pytest

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import start_hands
from deploy.chaos.profiles.cut_off import BEGIN_S, draw_cut_off
from deploy.chaos.run import scenario_text

SEEDS = range(60)


@pytest.fixture(scope="module")
def drawn() -> list[dict[str, Any]]:
    return [draw_cut_off(seed) for seed in SEEDS]


def silent(tables: dict[str, Any]) -> set[tuple[int, int]]:
    """Links that carry nothing from the first second on."""
    fleet = parse_fleet(scenario_text(tables), source="scenario")
    found: set[tuple[int, int]] = set()
    for rule, (i, j) in product(fleet.faults.rules, product(fleet.ids, fleet.ids)):
        assert (rule.at or 0.0) <= BEGIN_S
        if i != j and rule.partition is not None and rule.partition.cuts(i, j, fleet.ids):
            found.add((i, j))
        if rule.link is not None and rule.link.has(i, j):
            found.add((i, j))
    return found


def test_ways_of_robots_that_do_not_hear_each_other_cross(drawn: list[dict[str, Any]]) -> None:
    close = 0
    for tables in drawn:
        fleet = parse_fleet(scenario_text(tables), source="scenario")
        starts, places = start_hands(fleet).tolist(), fleet.formation.offsets or ()
        cut = silent(tables)
        assert cut
        nearest = min(
            dist(
                [a + share * (b - a) for a, b in zip(starts[i], places[i], strict=True)],
                [a + share * (b - a) for a, b in zip(starts[j], places[j], strict=True)],
            )
            for share in (0.4, 0.45, 0.5, 0.55, 0.6)
            for i in range(len(starts))
            for j in range(i)
            if {(i + 1, j + 1), (j + 1, i + 1)} & cut
        )
        assert nearest < 3.0
        close += nearest < fleet.formation.safe_distance_m + 0.3
    assert close > len(drawn) // 3


def test_some_never_heal_and_some_are_deaf_one_way(drawn: list[dict[str, Any]]) -> None:
    healed = [tables for tables in drawn if any("for" in rule for rule in tables["faults"]["rule"])]
    one_way = [cut for cut in map(silent, drawn) if any((j, i) not in cut for i, j in cut)]
    assert 10 < len(healed) < 50
    assert 5 < len(one_way) < 40
