"""Scenarios as they are drawn: valid, fair and the same again."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Any

import pytest

from agent.control.boundaries import obstacles_of
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved, start_hands
from deploy.chaos.dice import Dice
from deploy.chaos.draw import PROFILES, draw, profile_of, seeds_of
from deploy.chaos.draw_formation import APART_FACTOR
from deploy.chaos.report import parts
from deploy.chaos.run import scenario_text
from deploy.check.check import check

SEEDS = range(100)
ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def drawn() -> dict[int, tuple[dict[str, Any], Fleet]]:
    """Tables and fleet by seed."""
    return {
        seed: (tables, parse_fleet(scenario_text(tables), source=f"seed {seed}"))
        for seed in SEEDS
        for tables in [draw(seed)]
    }


def test_one_seed_is_one_text_also_in_another_process(drawn: dict[int, tuple[dict[str, Any], Fleet]]) -> None:
    script = (
        "from deploy.chaos.run import scenario_text; from deploy.chaos.draw import draw\n"
        "print(''.join(scenario_text(draw(seed)) for seed in range(8)), end='')"
    )
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(ROOT)}
    again = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=True)
    assert again.stdout.decode() == "".join(scenario_text(drawn[seed][0]) for seed in range(8))
    assert len({scenario_text(tables) for tables, _ in drawn.values()}) == len(SEEDS)


def test_check_finds_no_error_in_any(drawn: dict[int, tuple[dict[str, Any], Fleet]]) -> None:
    errors = [
        f"seed {seed}: {finding}"
        for seed, (_, fleet) in drawn.items()
        for finding in check(resolved(fleet))
        if finding.level == "error"
    ]
    assert errors == []


def test_starts_and_places_are_well_apart(drawn: dict[int, tuple[dict[str, Any], Fleet]]) -> None:
    for _, fleet in drawn.values():
        safe_m = fleet.formation.safe_distance_m
        hands = start_hands(fleet).tolist()
        assert all(dist(a, b) > 1.49 * safe_m for a, b in combinations(hands, 2))
        assert fleet.formation.offsets is not None
        assert all(
            dist(a, b) > APART_FACTOR * safe_m - 0.01 for a, b in combinations(fleet.formation.offsets, 2)
        )
        for obstacle in obstacles_of(fleet):
            for x, y in hands:
                near = obstacle.near(x, y, 100.0)
                assert min(each.distance for each in near) > 0.5 * safe_m + 0.3


def test_every_profile_is_drawn_about_as_often_as_it_is_to_be() -> None:
    counts = Counter(profile_of(seed) for seed in range(2000))
    total = sum(profile.weight for profile in PROFILES.values())
    assert set(counts) == set(PROFILES)
    for name, profile in PROFILES.items():
        assert abs(counts[name] / 2000 - profile.weight / total) < 0.03, name


def test_seeds_of_one_profile_are_the_first_that_draw_it() -> None:
    assert seeds_of(None, 7, 3) == [7, 8, 9]
    found = seeds_of("fast", 10, 5)
    assert found == [seed for seed in range(10, found[-1] + 1) if profile_of(seed) == "fast"]
    assert len(found) == 5


def test_everything_is_drawn_in_some(drawn: dict[int, tuple[dict[str, Any], Fleet]]) -> None:
    found: Counter[str] = Counter()
    for tables, _ in drawn.values():
        found += parts(tables)
    assert {
        "robots in reserve", "obstacles", "geofences", "dead-man's switches",
        "order: join", "order: leave", "order: replace", "order: remove",
        "order: reshape", "order: stop", "order: resume",
        "fault: delay", "fault: loss", "fault: duplicate", "fault: reorder", "fault: corrupt",
        "fault: partition", "fault: deaf one way", "fault: never heard", "fault: kill agent for good",
        "fault: delay everywhere", "fault: loss everywhere",
        "fault: links of limited range", "fault: kill agent", "fault: kill plant", "fault: pause agent",
        "fault: restart agent", "fault: clock skew or drift", "fault: late ticks",
        "fault: processes that stand now and then",
    } <= set(found)  # fmt: skip
    assert {fleet.trajectory.kind for _, fleet in drawn.values()} == {"hold", "line", "circle", "waypoints"}


def test_a_drawing_does_not_depend_on_the_one_before() -> None:
    Dice("something else").share()
    assert scenario_text(draw(5)) == scenario_text(draw(5))
