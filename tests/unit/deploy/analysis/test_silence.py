"""What is promised of robots that do not hear each other."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.control.peers.beliefs import stands_after
from handfast.agent.control.peers.lateness import LATE_MAX_NS
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.analysis.silence import UNSURE_S, Links, Promise, promised
from handfast.deploy.console.data_files import FLEETS


def fleet(*overrides: str) -> Fleet:
    return resolved(load_fleet(FLEETS / "delta.toml", ["avoidance.enabled=true", *overrides]))


def of(*overrides: str, links: Links | None = None, **off: Any) -> Promise:
    return promised(fleet(*overrides), links or Links(), **off)


def test_with_good_links_the_margin_covers_what_robots_are_off_their_ways():
    made = fleet()
    safe, margin = made.formation.safe_distance_m, made.avoidance.margin_m
    found = promised(made, Links())
    assert found.unmet == ()
    assert safe < found.kept_m < safe + margin  # what a sampled barrier is left by
    assert found.stands_s == stands_after(made.control.prediction_horizon_s, 0.0)
    off = promised(made, Links(), off_m=0.9 * margin)
    assert safe < off.kept_m < found.kept_m
    assert promised(made, Links(), off_m=2.0 * margin).kept_m < safe


def test_what_is_off_counts_as_far_as_the_age_does_not_cover_it_and_lanes_count_in_full():
    still = of().kept_m
    assert of(off_m=0.01).kept_m == still  # within the doubt that every silent robot has
    assert of(lanes_m=0.01).kept_m == pytest.approx(still - 0.01)
    assert of(off_m=0.04, lanes_m=0.03).kept_m == of(lanes_m=0.03).kept_m
    assert of(off_m=0.1, links=Links(clock_s=0.02)).kept_m < of(off_m=0.1).kept_m


def test_late_links_give_up_later_and_doubt_more():
    slow = Links(delay_s=0.4, gap_s=0.3)
    found = of(links=slow)
    assert found.stands_s == pytest.approx(of().stands_s + 2.0 * (0.7 - UNSURE_S))
    assert of(off_m=0.1, links=slow).kept_m > of(off_m=0.1).kept_m
    latest = 2.0 * LATE_MAX_NS * 1e-9
    assert of(links=Links(delay_s=0.1, gap_s=60.0)).stands_s == pytest.approx(of().stands_s + latest)


@pytest.mark.parametrize(
    ("overrides", "links", "said"),
    [
        (["avoidance.enabled=false"], Links(), "nothing keeps robots apart"),
        ([], Links(delay_s=3.0), "robots relay of a silent one"),
        ([], Links(deceleration=0.2), "s to brake"),
        ([], Links(deceleration=0.0), "s to brake"),
    ],
)
def test_where_a_proof_lacks_a_condition_it_is_named(overrides: list[str], links: Links, said: str):
    assert said in "; ".join(of(*overrides, links=links).unmet)


def test_a_rate_that_is_low_is_paid_for_by_the_margin():
    assert of("fleet.rate_hz=10").kept_m < of("fleet.rate_hz=50").kept_m - 0.01
