"""The law of one edge in plain numbers; `tests/property/test_law_property.py` compares it with arrays."""

from __future__ import annotations

import pytest

from handfast.agent.control import law

GAINS = law.Gains(kd=1.8, k2=5.0, kp=1.0)
RS = 0.22


def pair(rho: float, closing: float = 0.0, push: float = 0.0) -> law.Edge:
    """Robot i at `rho` on the right of j, wanted at 1 m; they close, and their navigation draws them on."""
    return law.edge((rho, 0.0), (-closing, 0.0), (push, 0.0), 1.0, RS, GAINS)


def test_at_its_distance_and_at_rest_an_edge_asks_for_nothing() -> None:
    e = pair(1.0)
    assert (e.normal, e.distance, e.phi, e.rate, e.demand) == ((1.0, 0.0), 1.0, 0.0, 0.0, 0.0)
    assert e.slope == pytest.approx(1.0 / (1.0 - RS))


def test_one_that_is_too_short_is_pushed_apart_and_one_too_long_drawn_together() -> None:
    for rho, sign in ((0.8, 1.0), (1.2, -1.0)):
        e = pair(rho)
        assert e.phi == pytest.approx((rho - 1.0) / (rho - RS))
        for multiplier in (law.multiplier_edge(e), law.multiplier_penalty(e, GAINS)):
            fx, fy = law.force(e, multiplier)
            assert fx * sign > 0.0
            assert fy == 0.0


def test_one_edge_alone_needs_one_sweep() -> None:
    e = pair(0.7, closing=0.4, push=-0.2)
    alone = law.multiplier_edge(e)
    assert law.multiplier_sweep(e, 0.0, (0.0, 0.0), 2.0) == pytest.approx(alone)
    fx, fy = law.force(e, alone)
    assert law.multiplier_sweep(e, alone, (2.0 * fx, 2.0 * fy), 2.0) == pytest.approx(alone)


def test_two_in_one_place_have_no_direction_and_no_force() -> None:
    e = law.edge((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), 1.0, RS, GAINS)
    assert law.force(e, law.multiplier_edge(e)) == (0.0, 0.0)


def test_navigation_is_cut_far_from_the_place_only() -> None:
    assert law.navigation_force(0.3, 2.0, -1.0, 0.4, 0.6) == pytest.approx(0.3 - 0.8 + 0.6)
    near, far = (0.3, 0.4), (30.0, 40.0)
    assert law.acting_error(near, (0.0, 0.0), 0.4, 0.6, 1.0) == near
    assert law.acting_error(far, (0.0, 0.0), 0.4, 0.6, 1.0) == pytest.approx((0.6 / 20 * 30, 0.6 / 20 * 40))


@pytest.mark.parametrize(
    ("error", "place", "wanted"),
    [
        ((-30.0, -40.0), (0.3, 0.4), (1.2, 1.6)),  # it is behind its place
        ((30.0, 40.0), (0.3, 0.4), (-1.2, -1.6)),  # its place comes to it
        ((9e9, 0.0), (0.0, 0.5), (-2.0, 0.0)),  # straight to it from far away, wherever that drives
        ((-30.0, 0.0), (5.0, 0.0), (5.5, 0.0)),  # it still arrives
        ((0.0, 0.0), (5.0, 0.0), (5.0, 0.0)),
    ],
)
def test_far_from_its_place_a_robot_makes_for_it_at_its_limit(
    error: tuple[float, float], place: tuple[float, float], wanted: tuple[float, float]
) -> None:
    x, y = law.acting_error(error, place, 0.4, 0.6, 2.0)
    assert (place[0] - 0.4 / 0.6 * x, place[1] - 0.4 / 0.6 * y) == pytest.approx(wanted, abs=1e-9)
