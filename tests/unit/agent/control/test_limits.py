"""handfast.agent.control.limits: from which distances on robots keep apart, and how fast they may
close in.

handfast.agent.control.limits: the softness of an edge, and that the law goes with the scale.

How far a fleet's rate can fall, and how fast robots drive then.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import dist, inf
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import law, limits
from handfast.agent.control.limits import (
    FOLD,
    LOWEST_SHARE,
    SOFTNESS,
    acceleration_max,
    avoidance_distance,
    barrier_rate,
    braking_room,
    clearance,
    gains_of,
    least_apart,
    one_sided,
    sensing_distance,
    softness,
    speed_max,
    speeding_rate,
)
from handfast.agent.control.safety_filter import keep_apart
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.analysis.couplings import Mode
from handfast.deploy.analysis.stability import sampled_radius
from tests.unit.agent.fleet.fleet_texts import small

LINE = {1: (0.0, 0.0), 2: (1.0, 0.0), 3: (2.0, 0.0)}
CHAIN = {(2, 1): 1.0, (2, 3): 1.0}


def test_the_distance_of_avoidance_is_half_way_to_the_shortest_edge_and_not_far() -> None:
    assert avoidance_distance(None, 0.3, CHAIN, LINE) == pytest.approx(0.65)
    assert avoidance_distance(None, 0.2, {**CHAIN, (1, 3): 0.5}, LINE) == pytest.approx(0.35)
    assert avoidance_distance(None, 0.2, {(1, 2): 6.0}, {1: (0.0, 0.0), 2: (6.0, 0.0)}) == pytest.approx(0.56)
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
        near = min([2.8 * 0.2, *(0.5 * (0.2 + each) for each in edges.values())]) if edges else 0.5
        wanted = max(min(near, 0.9 * least_apart(edges, places)), 1.05 * 0.2)
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
    assert [acceleration_max(at(rate_hz)) for rate_hz in (100, 7, 4, 1)] == [5.0, 5.0, 3.0, 0.75]
    assert acceleration_max(at(4, "avoidance.enabled=false")) == 5.0


def test_robots_come_to_their_speed_as_fast_as_the_loop_carries_however_slowly_they_brake() -> None:
    slow = ("control.max_acceleration=0.8", "control.max_speed_mps=1.0")
    assert speeding_rate(small()) == speeding_rate(small(*slow)) == 3.0
    assert speeding_rate(small(*slow, "control.rate_min_hz=5")) == pytest.approx(1.5)


def test_who_is_near_is_listened_to_in_time_to_brake() -> None:
    assert sensing_distance(small(), 0.6) == pytest.approx(1.5)
    fast = small("control.max_speed_mps=6", "control.max_acceleration=9", "avoidance.margin_m=0.1")
    assert braking_room(fast) == pytest.approx(0.2 + 0.1 + 2.0 * 6.0 / 1.5)
    assert sensing_distance(fast, 0.6) == braking_room(fast)
    # There the barrier admits two that come at each other as fast as they may, and no nearer.
    for room, admitted in ((braking_room(fast), True), (braking_room(fast) - 1e-6, False)):
        plane = keep_apart("peer", (room, 0.0), (-6.0, 0.0), (6.0, 0.0), 0.3, barrier_rate(fast))
        assert (plane.least <= barrier_rate(fast) * 6.0 + 1e-9) is admitted


def bare(**control: float | None) -> Fleet:
    fleet = small()
    return replace(
        fleet,
        control=replace(fleet.control, **{"k2": None} | control),  # type: ignore[arg-type]
        avoidance=replace(fleet.avoidance, enabled=False),
    )


def test_a_k2_that_is_given_is_taken_as_it_is() -> None:
    gains = gains_of(bare(k2=7.0))
    assert [softness(gains, span) for span in (0.1, 1.0, 30.0)] == [7.0, 7.0, 7.0]
    assert one_sided(gains) == gains


def test_one_that_is_left_out_goes_with_the_span_of_the_edge() -> None:
    gains = gains_of(bare())
    assert [softness(gains, span) * span * span for span in (0.1, 1.0, 30.0)] == pytest.approx([SOFTNESS] * 3)


def test_where_the_pull_is_limited_edges_are_as_much_softer() -> None:
    """(N1) from c2 V / c1 = 2.25 m on: of FOLD spans that are further, the pull is so much less."""
    fleet = bare(c1=0.4, c2=0.6, max_speed_mps=1.5)
    gains = gains_of(replace(fleet, avoidance=replace(fleet.avoidance, enabled=True)))
    for span in (0.1, 1.6, 1.7, 8.0):
        less = min(1.0, 2.25 / (FOLD * span))
        assert softness(gains, span) == pytest.approx(SOFTNESS / span**2 / less)


def test_a_one_sided_constraint_is_as_soft_as_the_edge_that_it_is_half_of() -> None:
    gains = gains_of(small())
    for span in (0.3, 3.0, 30.0):
        assert softness(one_sided(gains), 0.5 * span) == pytest.approx(softness(gains, span))


COMPONENT = st.floats(-3.0, 3.0)
PAIR = st.tuples(COMPONENT, COMPONENT)


@given(PAIR, PAIR, PAIR, st.floats(0.4, 3.0), st.floats(0.01, 100.0))
def test_every_length_of_the_law_goes_with_the_edges_and_no_time_does(
    offset: tuple[float, float],
    velocity: tuple[float, float],
    navigation: tuple[float, float],
    distance: float,
    scale: float,
) -> None:
    gains = gains_of(bare())

    def force(size: float) -> tuple[float, float]:
        def sized(vector: tuple[float, float]) -> tuple[float, float]:
            return size * vector[0], size * vector[1]

        edge = law.edge(
            sized(offset), sized(velocity), sized(navigation), size * distance, size * 0.22, gains
        )
        return law.force(edge, law.multiplier_edge(edge))

    small_one, large_one = force(1.0), force(scale)
    if abs(offset[0]) + abs(offset[1]) > 1e-3:
        assert large_one == pytest.approx((scale * small_one[0], scale * small_one[1]), rel=1e-6, abs=1e-9)


FLEETS = Path("deploy/data/fleets")


def fleet(*overrides: str, name: str = "delta") -> Fleet:
    return load_fleet(FLEETS / f"{name}.toml", overrides)


WAITS = ("control.plant_timeout_s=2", "control.wrench_timeout_s=2")


@pytest.mark.parametrize(
    ("overrides", "steps", "why"),
    [
        ((), 2, "control.plant_timeout_s = 0.2 s is less than two periods of 0.16 s"),
        (WAITS, 2, "the safety filter's rate is 3 1/s, and 6.25 Hz carry at most 1.88 1/s"),
        ((*WAITS, "control.rate_min_hz=6.25"), 3, "control.rate_min_hz = 6.25 Hz"),
        ((*WAITS, "control.rate_min_hz=7"), 2, "control.rate_min_hz = 7 Hz"),
        ((*WAITS, "control.rate_min_hz=50"), 0, "control.rate_min_hz = 50 Hz"),
        ((*WAITS, "control.rate_min_hz=1"), 3, "no period is longer than 0.25 s"),
        (("control.prediction_horizon_s=0.2",), 1, "0.75 control.prediction_horizon_s = 0.15 s is less"),
        (("control.coupling=penalty",), 0, "of this control.coupling only control.rate_min_hz"),
        (("control.kd=20", "control.coupling=edge"), 0, "the gains of the law are too high for 25 Hz"),
    ],
)
def test_a_step_is_taken_where_nothing_speaks_against_it(
    overrides: tuple[str, ...], steps: int, why: str
) -> None:
    made = fleet(*overrides)
    assert limits.steps(made) == steps
    assert why in limits.why_not(made, steps + 1)


def test_another_s_law_falls_only_where_the_file_says_so() -> None:
    made = fleet()
    own = replace(made, control=replace(made.control, law="somebody.s:Law"))
    assert limits.steps(own) == 0
    assert "of this control.law" in limits.why_not(own, 1)
    assert limits.steps(replace(own, control=replace(own.control, rate_min_hz=10.0))) == 2


@pytest.mark.parametrize(
    ("settings", "period_s"),
    [
        ((), 0.16),
        (("control.wrench_timeout_s=0.2",), 0.08),
        (("fleet.rate_hz=10", "control.wrench_timeout_s=0.3"), 0.2),
        (("fleet.rate_hz=4", "control.wrench_timeout_s=0.75", "control.plant_timeout_s=0.75"), 0.25),
    ],
)
def test_who_stands_for_an_overload_decides_as_rarely_as_plant_and_neighbours_bear(
    settings: tuple[str, ...], period_s: float
) -> None:
    made = fleet("control.plant_timeout_s=0.3", "control.wrench_timeout_s=0.3", *settings)
    assert limits.standing_period_ns(made) == round(period_s * NS_PER_S)


def test_the_lowest_rate_is_no_higher_than_the_rate() -> None:
    with pytest.raises(FleetError, match=r"control.rate_min_hz: 60.0 Hz is more than fleet.rate_hz = 50"):
        fleet("control.rate_min_hz=60")


def test_the_barrier_suits_the_lowest_rate_where_it_is_given() -> None:
    assert barrier_rate(fleet()) == 3.0
    assert barrier_rate(fleet("control.rate_min_hz=5")) == pytest.approx(LOWEST_SHARE * 5.0)


@given(st.floats(0.0, 40.0), st.floats(0.0, 40.0), st.floats(0.001, 1.0))
def test_what_is_called_stable_is(k1: float, k2: float, period_s: float) -> None:
    mode = Mode(k1, k2, True)
    radius = max(sampled_radius(mode, 1.0 / period_s, predicted=known) for known in (True, False))
    if abs(radius - 1.0) > 1e-6:
        assert limits.is_stable(k1, k2, period_s) == (radius < 1.0)


@given(st.floats(0.3, 4.0), st.floats(0.5, 10.0), st.floats(4.0, 200.0))
def test_the_way_to_a_standstill_stays_what_it_is(speed: float, push: float, rate: float) -> None:
    waits = ("control.plant_timeout_s=2", "control.wrench_timeout_s=2")
    given_ = (f"control.max_speed_mps={speed}", f"control.max_acceleration={push}", f"fleet.rate_hz={rate}")
    made = fleet(*given_, *waits)
    p = barrier_rate(made)
    for level in range(limits.steps(made) + 2):
        share = limits.speed_share(made, level)
        period_s = (1 << level) / rate
        assert share * speed * (2.0 * period_s + 1.0 / p) == pytest.approx(
            speed * (2.0 / rate + 1.0 / p), rel=1e-6
        )
        assert 0.0 < share <= 1.0
