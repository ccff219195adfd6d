"""The late profile: many that cross each other's ways, and hear each other late."""

from __future__ import annotations

from math import dist

import pytest

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import start_hands
from deploy.chaos.profiles.late import LATE_S, LOSS_MAX, RECOVERED_S, ROBOTS, draw_late
from deploy.chaos.run import scenario_text

SEEDS = range(60)


def test_every_place_is_on_the_other_side() -> None:
    sizes = set()
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_late(seed)), source=f"seed {seed}")
        hands, places = start_hands(fleet).tolist(), fleet.formation.offsets
        assert places is not None
        sizes.add(len(hands))
        for (x, y), place in zip(hands, places, strict=True):
            assert dist((-x, -y), place) < 0.01
    assert sizes == set(range(ROBOTS[0], ROBOTS[1] + 1))


def test_links_are_late_to_the_end_or_there_is_time_to_come_back() -> None:
    ends = set()
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_late(seed)), source=f"seed {seed}")
        (rule,) = fleet.faults.rules
        assert (rule.delay is None) != (rule.slot is None)
        assert rule.loss is None or rule.loss.start.rate <= LOSS_MAX / 100.0
        ends.add(rule.duration)
        left_s = fleet.fleet.duration_s - (rule.duration or 0.0)
        assert left_s == pytest.approx(LATE_S if rule.duration is None else RECOVERED_S)
    assert None in ends
    assert len(ends) > 20
