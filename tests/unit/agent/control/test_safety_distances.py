"""handfast.agent.control.safety_distances: from which distances on robots keep apart, and how fast they may
close in."""

from __future__ import annotations

from itertools import combinations
from math import dist, inf
from random import Random

import pytest

from handfast.agent.control.safety_distances import (
    acceleration_max,
    avoidance_distance,
    barrier_rate,
    braking_room,
    clearance,
    least_apart,
    sensing_distance,
    speed_max,
    speeding_rate,
)
from handfast.agent.control.safety_filter import keep_apart
from handfast.agent.fleet.model import Fleet
from tests.unit.agent.fleet.fleet_texts import small

LINE = {1: (0.0, 0.0), 2: (1.0, 0.0), 3: (2.0, 0.0)}
CHAIN = {(2, 1): 1.0, (2, 3): 1.0}


def test_the_distance_of_avoidance_is_half_way_to_the_shortest_edge() -> None:
    assert avoidance_distance(None, 0.2, CHAIN, LINE) == pytest.approx(0.6)
    assert avoidance_distance(None, 0.2, {**CHAIN, (1, 3): 0.5}, LINE) == pytest.approx(0.35)
    assert avoidance_distance(0.9, 0.2, CHAIN, LINE) == 0.9


def test_the_distance_of_avoidance_is_below_what_the_formation_puts_between_robots() -> None:
    close = {**LINE, 3: (0.0, 0.5)}
    assert least_apart(CHAIN, LINE) == 2.0
    assert least_apart(CHAIN, close) == 0.5
    assert avoidance_distance(None, 0.2, CHAIN, close) == pytest.approx(0.45)
    # Below the safe distance there would be nothing to push from.
    assert avoidance_distance(None, 0.48, CHAIN, close) == pytest.approx(1.05 * 0.48)


def test_the_least_distance_of_many_is_that_of_all_pairs() -> None:
    random = Random(0)
    for robots in (2, 7, 40):
        places = {k: (random.uniform(-3.0, 3.0), random.uniform(-3.0, 3.0)) for k in range(robots)}
        pairs = list(combinations(places, 2))
        edges = {pair[:: random.choice((1, -1))]: 1.0 for pair in random.sample(pairs, len(pairs) // 2)}
        apart = [dist(places[i], places[j]) for i, j in pairs if not {(i, j), (j, i)} & set(edges)]
        assert least_apart(edges, places) == min(apart)


def test_what_is_further_apart_than_matters_is_not_looked_for_and_changes_nothing() -> None:
    random = Random(1)
    for _ in range(300):
        wide, robots = random.choice((1.5, 4.0, 12.0)), random.randrange(2, 12)
        places = {k: (random.uniform(0.0, wide), random.uniform(0.0, wide)) for k in range(robots)}
        pairs = list(combinations(places, 2))
        edges = {pair: dist(*(places[k] for k in pair)) for pair in random.sample(pairs, len(pairs) // 2)}
        half_way = 0.5 * (0.2 + min(edges.values())) if edges else 0.5
        wanted = max(min(half_way, 0.9 * least_apart(edges, places)), 1.05 * 0.2)
        assert avoidance_distance(None, 0.2, edges, places) == wanted
        least = least_apart(edges, places)
        for within in (0.5 * least, least, 2.0 * least):
            assert least_apart(edges, places, within) == (least if least < within else inf)


def test_the_distance_of_avoidance_without_edges() -> None:
    assert avoidance_distance(None, 0.2, {}, {1: (0.0, 0.0)}) == pytest.approx(0.5)
    assert avoidance_distance(None, 0.2, {}, {1: (0.0, 0.0), 2: (0.4, 0.0)}) == pytest.approx(0.36)
    assert least_apart({(1, 2): 1.0}, {1: (0.0, 0.0), 2: (1.0, 0.0)}) == inf


def test_the_clearance_is_half_the_safe_distance() -> None:
    assert (clearance(None, 0.3), clearance(0.5, 0.3)) == (0.15, 0.5)


def test_the_rate_of_the_barrier_is_what_every_robot_can_brake_with() -> None:
    assert barrier_rate(small()) == 3.0
    slow = ("control.max_acceleration=1.2", "control.max_speed_mps=1.5")
    assert barrier_rate(small(*slow)) == pytest.approx(0.8)
    assert barrier_rate(small(*slow, "avoidance.barrier_rate=2.5")) == 2.5


def test_robots_drive_no_faster_than_they_can_steer() -> None:
    """c1/c2 = 2/3: from more than 1.5 a they brake and turn more slowly than they come to places."""
    weak = "control.max_acceleration=1", "control.max_speed_mps=5", "control.c1=0.4", "control.c2=0.6"
    assert speed_max(small(*weak)) == pytest.approx(1.5)
    assert barrier_rate(small(*weak)) == pytest.approx(2.0 / 3.0)
    assert speed_max(small(*weak, "control.max_speed_mps=1.4")) == 1.4
    assert speed_max(small(*weak, "avoidance.enabled=false")) == 5.0


def test_the_rate_of_the_barrier_and_accelerations_are_what_the_loop_can_carry() -> None:
    def at(rate_hz: float, *more: str) -> Fleet:
        waits = [f"control.{each}_s=5" for each in ("plant_timeout", "wrench_timeout", "prediction_horizon")]
        return small(f"fleet.rate_hz={rate_hz}", *waits, *more)

    assert [barrier_rate(at(rate_hz)) for rate_hz in (100, 12, 4, 1)] == [3.0, 3.0, 1.0, 0.25]
    assert barrier_rate(at(2, "avoidance.barrier_rate=3")) == 3.0
    assert [acceleration_max(at(rate_hz)) for rate_hz in (100, 7, 4, 1)] == [5.0, 5.0, 3.0, 0.75]
    assert acceleration_max(at(4, "avoidance.enabled=false")) == 5.0


def test_robots_come_to_their_speed_as_fast_as_the_loop_carries_however_slowly_they_brake() -> None:
    slow = ("control.max_acceleration=0.8", "control.max_speed_mps=1.0", "avoidance.barrier_rate=0.5")
    assert speeding_rate(small()) == speeding_rate(small(*slow)) == 3.0
    assert speeding_rate(small(*slow, "control.rate_min_hz=5")) == pytest.approx(1.5)
    assert speeding_rate(small("avoidance.barrier_rate=3.5")) == 3.5


def test_who_is_near_is_listened_to_in_time_to_brake() -> None:
    assert sensing_distance(small(), 0.6) == pytest.approx(1.5)
    fast = small("control.max_speed_mps=6", "control.max_acceleration=9", "avoidance.margin_m=0.1")
    assert braking_room(fast) == pytest.approx(0.2 + 0.1 + 2.0 * 6.0 / 1.5)
    assert sensing_distance(fast, 0.6) == braking_room(fast)
    # There the barrier admits two that come at each other as fast as they may, and no nearer.
    for room, admitted in ((braking_room(fast), True), (braking_room(fast) - 1e-6, False)):
        plane = keep_apart("peer", (room, 0.0), (-6.0, 0.0), (6.0, 0.0), 0.3, barrier_rate(fast))
        assert (plane.least <= barrier_rate(fast) * 6.0 + 1e-9) is admitted
