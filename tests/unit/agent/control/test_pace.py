"""How far a fleet's rate can fall, and how fast robots drive then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import pace
from handfast.agent.control.safety_distances import LOWEST_SHARE, barrier_rate
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.analysis.couplings import Mode
from handfast.deploy.analysis.stability import sampled_radius

FLEETS = Path("deploy/data/fleets")


def fleet(*overrides: str, name: str = "delta") -> Fleet:
    return load_fleet(FLEETS / f"{name}.toml", overrides)


WAITS = ("control.plant_timeout_s=2", "control.wrench_timeout_s=2")


@pytest.mark.parametrize(
    ("overrides", "steps", "why"),
    [
        ((), 2, "control.plant_timeout_s = 0.2 s is less than two periods of 0.16 s"),
        (WAITS, 2, "avoidance.barrier_rate = 3 1/s, and 6.25 Hz carry at most 1.88 1/s"),
        ((*WAITS, "control.rate_min_hz=6.25"), 3, "control.rate_min_hz = 6.25 Hz"),
        ((*WAITS, "control.rate_min_hz=7"), 2, "control.rate_min_hz = 7 Hz"),
        ((*WAITS, "control.rate_min_hz=50"), 0, "control.rate_min_hz = 50 Hz"),
        ((*WAITS, "control.rate_min_hz=1"), 3, "no period is longer than 0.25 s"),
        ((*WAITS, "control.rate_min_hz=1", "avoidance.barrier_rate=2"), 2, "avoidance.barrier_rate = 2 1/s"),
        (("control.prediction_horizon_s=0.2",), 1, "0.75 control.prediction_horizon_s = 0.15 s is less"),
        (("control.coupling=penalty",), 0, "of this control.coupling only control.rate_min_hz"),
        (("control.kd=20", "control.coupling=edge"), 0, "the gains of the law are too high for 25 Hz"),
    ],
)
def test_a_step_is_taken_where_nothing_speaks_against_it(
    overrides: tuple[str, ...], steps: int, why: str
) -> None:
    made = fleet(*overrides)
    assert pace.steps(made) == steps
    assert why in pace.why_not(made, steps + 1)


def test_another_s_law_falls_only_where_the_file_says_so() -> None:
    made = fleet()
    own = replace(made, control=replace(made.control, law="somebody.s:Law"))
    assert pace.steps(own) == 0
    assert "of this control.law" in pace.why_not(own, 1)
    assert pace.steps(replace(own, control=replace(own.control, rate_min_hz=10.0))) == 2


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
    assert pace.standing_period_ns(made) == round(period_s * NS_PER_S)


def test_the_lowest_rate_is_no_higher_than_the_rate() -> None:
    with pytest.raises(FleetError, match=r"control.rate_min_hz: 60.0 Hz is more than fleet.rate_hz = 50"):
        fleet("control.rate_min_hz=60")


def test_the_barrier_suits_the_lowest_rate_where_it_is_given() -> None:
    assert barrier_rate(fleet()) == 3.0
    assert barrier_rate(fleet("control.rate_min_hz=5")) == pytest.approx(LOWEST_SHARE * 5.0)
    assert barrier_rate(fleet("control.rate_min_hz=5", "avoidance.barrier_rate=2.5")) == 2.5


@given(st.floats(0.0, 40.0), st.floats(0.0, 40.0), st.floats(0.001, 1.0))
def test_what_is_called_stable_is(k1: float, k2: float, period_s: float) -> None:
    mode = Mode(k1, k2, True)
    radius = max(sampled_radius(mode, 1.0 / period_s, predicted=known) for known in (True, False))
    if abs(radius - 1.0) > 1e-6:
        assert pace.is_stable(k1, k2, period_s) == (radius < 1.0)


@given(st.floats(0.3, 4.0), st.floats(0.5, 10.0), st.floats(4.0, 200.0))
def test_the_way_to_a_standstill_stays_what_it_is(speed: float, push: float, rate: float) -> None:
    waits = ("control.plant_timeout_s=2", "control.wrench_timeout_s=2")
    given_ = (f"control.max_speed_mps={speed}", f"control.max_acceleration={push}", f"fleet.rate_hz={rate}")
    made = fleet(*given_, *waits)
    p = barrier_rate(made)
    for level in range(pace.steps(made) + 2):
        share = pace.speed_share(made, level)
        period_s = (1 << level) / rate
        assert share * speed * (2.0 * period_s + 1.0 / p) == pytest.approx(
            speed * (2.0 / rate + 1.0 / p), rel=1e-6
        )
        assert 0.0 < share <= 1.0
