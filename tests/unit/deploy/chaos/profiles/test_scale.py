"""The profile of small and of large formations."""

from __future__ import annotations

from itertools import combinations
from math import dist

from agent.fleet.loading import parse_fleet
from deploy.chaos.profiles.scale import SAFE_SHARES, SPACING_M, draw_scale
from deploy.chaos.run import scenario_text


def test_from_small_to_large_with_a_safe_distance_that_suits() -> None:
    least = []
    for seed in range(60):
        fleet = parse_fleet(scenario_text(draw_scale(seed)), source=f"seed {seed}")
        places = fleet.formation.offsets or ()
        apart = min(dist(a, b) for a, b in combinations(places, 2))
        least.append(apart)
        assert fleet.formation.safe_distance_m < (SAFE_SHARES[1] + 0.01) * apart
        assert not fleet.faults.rules
        assert not fleet.orders
    assert SPACING_M[0] - 0.01 < min(least) < 0.5
    assert 6.0 < max(least) < 2.0 * SPACING_M[1]
