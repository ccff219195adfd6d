"""The profile of low rates: what `handfast check` lets pass."""

from __future__ import annotations

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.chaos.profiles.low_rate import RATES_HZ, draw_low_rate
from deploy.chaos.run import scenario_text
from deploy.check.check import check


def test_rates_are_low_and_nothing_is_refused() -> None:
    rates = set()
    for seed in range(60):
        fleet = resolved(parse_fleet(scenario_text(draw_low_rate(seed)), source=f"seed {seed}"))
        rates.add(fleet.fleet.rate_hz)
        assert not [each for each in check(fleet) if each.level == "error"]
        assert fleet.control.plant_timeout_s > 2.0 / fleet.fleet.rate_hz
        assert fleet.control.prediction_horizon_s >= 2.0 / fleet.fleet.rate_hz
    assert rates <= set(RATES_HZ)
    assert min(rates) <= 3


def test_where_nothing_happens_the_course_can_be_kept_up_with() -> None:
    for seed in range(60):
        tables = draw_low_rate(seed)
        if "faults" not in tables and tables["fleet"]["rate_hz"] < max(RATES_HZ):
            fleet = resolved(parse_fleet(scenario_text(tables), source=f"seed {seed}"))
            assert not [each for each in check(fleet) if each.place.startswith("trajectory.")]
