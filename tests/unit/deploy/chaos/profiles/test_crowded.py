"""The crowded profile: many in each other's places, some of whom die."""

from __future__ import annotations

from math import dist

import pytest

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolve, resolved, start_hand
from deploy.chaos.profiles.crowded import DEAD_MAX, ROBOTS, draw_crowded
from deploy.chaos.profiles.pieces import START_FACTOR
from deploy.chaos.run import scenario_text
from deploy.check.check import check

SEEDS = range(40)


def test_most_start_elsewhere_and_some_die() -> None:
    sizes, dead, cut, late = set(), set(), 0, 0
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_crowded(seed)), source=f"seed {seed}")
        rules = fleet.faults.rules
        sizes.add(len(fleet.ids))
        dead.add(sum(rule.kill is not None for rule in rules))
        cut += sum(rule.partition is not None for rule in rules)
        late += sum(rule.delay is not None for rule in rules)
        hands = {robot.id: start_hand(robot) for robot in fleet.robots}
        offsets = dict(zip(fleet.ids, resolve(fleet).offsets.tolist(), strict=True))
        off = [robot for robot in fleet.ids if dist(hands[robot], offsets[robot]) > 0.5]
        assert len(off) > 0.8 * len(fleet.ids)
        apart = min(dist(a, b) for i, a in hands.items() for j, b in hands.items() if i < j)
        assert apart > START_FACTOR * fleet.formation.safe_distance_m
    assert sizes <= set(range(ROBOTS[0], ROBOTS[1] + 1))
    assert len(sizes) > 6
    assert dead == set(range(1, DEAD_MAX + 1))
    assert 0.2 * len(SEEDS) < cut < 0.6 * len(SEEDS)
    assert 0.75 * len(SEEDS) < late < len(SEEDS)


@pytest.mark.parametrize("seed", range(10))
def test_check_finds_nothing_wrong_with_them(seed: int) -> None:
    fleet = parse_fleet(scenario_text(draw_crowded(seed)), source=f"seed {seed}")
    assert [finding for finding in check(resolved(fleet)) if finding.level == "error"] == []
