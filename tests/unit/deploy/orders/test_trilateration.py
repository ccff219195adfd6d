"""Places from distances: both where there are two, one where a third tells, none where none fits."""

from __future__ import annotations

from math import dist, sqrt

import pytest

from handfast.deploy.orders.trilateration import place_apart, trilaterate


def test_two_distances_leave_two_places():
    a, b = trilaterate([(0.0, 0.0), (2.0, 0.0)], [sqrt(2), sqrt(2)])
    assert a == pytest.approx((1.0, 1.0))
    assert b == pytest.approx((1.0, -1.0))


def test_a_third_one_leaves_one():
    (place,) = trilaterate([(0.0, 0.0), (2.0, 0.0), (0.0, 3.0)], [sqrt(2), sqrt(2), sqrt(5)])
    assert place == pytest.approx((1.0, 1.0))


@pytest.mark.parametrize(("d", "e"), [(0.9, 0.9), (5.0, 1.0), (1.0, 5.0)])
def test_circles_that_do_not_meet_have_none(d: float, e: float):
    assert trilaterate([(0.0, 0.0), (2.0, 0.0)], [d, e]) == ()
    assert place_apart([(0.0, 0.0), (2.0, 0.0)], [d, e], [(0.0, 0.0)]) is None


def test_typed_distances_are_met_as_well_as_they_can_be():
    anchors, wanted = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], (1.8, 0.5)
    (place,) = trilaterate(anchors, [round(dist(anchor, wanted), 2) for anchor in anchors])
    assert dist(place, wanted) < 0.005
    assert trilaterate(anchors, [round(dist(anchor, wanted), 1) for anchor in anchors]) == ()


def test_of_two_places_the_one_away_from_the_others():
    anchors = [(0.0, 0.0), (1.0, 0.0)]
    assert place_apart(anchors, [1.0, 1.0], [*anchors, (0.5, 2.0)]) == pytest.approx((0.5, -sqrt(0.75)))
    assert place_apart(anchors, [1.0, 1.0], [*anchors, (0.5, -2.0)]) == pytest.approx((0.5, sqrt(0.75)))
    assert place_apart([(1.0, 1.0)], [2.0], [(1.0, 1.0), (1.0, 0.0)]) == pytest.approx((1.0, 3.0))
    assert place_apart([(1.0, 1.0)], [2.0], [(1.0, 1.0)]) == (3.0, 1.0)
