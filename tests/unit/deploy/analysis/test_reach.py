"""Where a body can have been between two sights of it: no path that keeps the speed is outside."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.clearances import distances
from handfast.deploy.analysis.reach import Reach, Seen, apart, known, least_apart

Points = list[tuple[float, float]]
PLACE = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
WAYS = st.lists(PLACE, min_size=2, max_size=6)
SPARE = st.floats(1.0, 3.0)
TOLERANCE_M = 1e-9


class Way:
    """A body that goes from corner to corner in some time, and is never faster than its `speed`."""

    def __init__(self, corners: Points, start_s: float, end_s: float, spare: float) -> None:
        legs = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(corners)]
        self.start_s, self.end_s = start_s, end_s
        self.speed = max(spare * sum(legs) / (end_s - start_s), 0.01)
        shares = np.concatenate([[0.0], np.cumsum([leg + 1e-6 for leg in legs])])
        self._times = start_s + (end_s - start_s) * shares / shares[-1]
        self._times[-1] = end_s
        self.speed = max(
            [self.speed] + [leg / (b - a) for leg, (a, b) in zip(legs, pairwise(self._times), strict=True)]
        )
        self._corners = np.array(corners)

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        x, y = (np.interp(t, self._times, self._corners[:, axis]) for axis in (0, 1))
        return x, y

    @property
    def reach(self) -> Reach:
        ends = [Seen(t, *map(float, np.ravel(self.at(np.array([t]))))) for t in (self.start_s, self.end_s)]
        return Reach(ends[0], ends[1], self.speed)


@given(WAYS, st.floats(0.2, 5.0), SPARE)
def test_no_path_that_keeps_the_speed_leaves_the_discs(corners: Points, lasts_s: float, spare: float) -> None:
    way = Way(corners, 2.0, 2.0 + lasts_s, spare)
    times = np.linspace(way.start_s, way.end_s, 101)
    x, y = way.at(times)
    for disc in way.reach.discs(times):
        assert (np.hypot(x - disc.x, y - disc.y) <= disc.radius + TOLERANCE_M).all()
    assert way.reach.too_far_m <= TOLERANCE_M
    # And so it is in the ellipse of all such paths.
    before, after = way.reach.before, way.reach.after
    assert before is not None
    assert after is not None
    there = np.hypot(x - before.x, y - before.y) + np.hypot(x - after.x, y - after.y)
    assert (there <= way.speed * lasts_s + TOLERANCE_M).all()


@given(WAYS, WAYS, st.floats(0.2, 5.0), st.floats(-1.0, 1.0), SPARE, st.booleans())
def test_two_bodies_are_never_nearer_than_is_said(
    first: Points, second: Points, lasts_s: float, shift_s: float, spare: float, seen: bool
) -> None:
    """Also between the times at which they are compared, and where the other is in a gap of its own."""
    one = Way(first, 0.0, lasts_s, spare)
    other = Way(second, shift_s, shift_s + lasts_s, spare)
    times = np.linspace(max(0.0, shift_s), min(lasts_s, lasts_s + shift_s), 7)
    if times[-1] <= times[0]:
        return
    discs = known(*other.at(times)) if seen else other.reach.discs(times)
    said_m = least_apart(one.reach.discs(times), discs, float(times[1] - times[0]), one.speed + other.speed)
    fine = np.linspace(times[0], times[-1], 301)
    (ax, ay), (bx, by) = one.at(fine), other.at(fine)
    assert said_m <= float(np.hypot(ax - bx, ay - by).min()) + TOLERANCE_M
    at_once = apart(one.reach.discs(times), discs)
    assert at_once is not None
    (ax, ay), (bx, by) = one.at(times), other.at(times)
    assert (at_once <= np.hypot(ax - bx, ay - by) + TOLERANCE_M).all()


@given(WAYS, st.floats(0.2, 5.0), SPARE, st.booleans())
def test_it_is_never_nearer_to_what_stands_than_is_said(
    corners: Points, lasts_s: float, spare: float, round_one: bool
) -> None:
    boundary: Circle | Polygon = Circle("rock", 1.0, 0.5, 0.7)
    if not round_one:
        boundary = Polygon(
            "fence", [(-4.0, -4.0), (4.0, -4.0), (0.0, 0.0), (4.0, 4.0), (-4.0, 4.0)], inside=True
        )
    way = Way(corners, 0.0, lasts_s, spare)
    x, y = way.at(np.linspace(0.0, lasts_s, 301))
    away_m = distances(boundary, np.stack([x, y], axis=1))
    said_m = way.reach.clearance(float(away_m[0]), float(away_m[-1]))
    assert said_m <= float(away_m.min()) + TOLERANCE_M


def test_the_bound_is_no_larger_than_it_must_be() -> None:
    """Half a second out and half a second back at 1 m/s: 0.5 m, and no more."""
    reach = Reach(Seen(0.0, 0.0, 0.0), Seen(1.0, 0.0, 0.0), 1.0)
    times = np.linspace(0.0, 1.0, 1001)
    stands = known(np.full(1001, 2.0), np.zeros(1001))
    assert least_apart(reach.discs(times), stands, 1e-3, 1.0) == pytest.approx(1.5, abs=1e-3)
    assert least_apart(reach.discs(times), reach.discs(times), 1e-3, 2.0) == 0.0
    assert reach.clearance(2.0, 2.0) == pytest.approx(1.5)
    assert reach.clearance(5.0, 0.1) == pytest.approx(0.1)


def test_who_passes_between_two_looks_is_not_missed() -> None:
    times = np.array([0.0, 1.0])
    stands = Reach(Seen(0.0, 0.0, 0.0), Seen(1.0, 0.0, 0.0), 0.01)
    passes = known(np.array([-1.0, 1.0]), np.zeros(2))
    assert least_apart(stands.discs(times), passes, 1.0, 2.01) == 0.0


def test_who_was_seen_once_or_never_is_bounded_by_that() -> None:
    times = np.array([0.0, 1.0])
    here = known(np.zeros(2), np.zeros(2))
    once = Reach(None, Seen(1.0, 3.0, 0.0), 1.0)
    found = apart(once.discs(times), here)
    assert found is not None
    assert found.tolist() == [2.0, 3.0]
    assert once.clearance(nan, 3.0) == once.too_far_m == -inf
    assert apart(Reach(None, None, 1.0).discs(times), here) is None
    assert least_apart([], here, 1.0, 1.0) == 0.0


def test_who_moved_further_than_it_can_is_not_bounded() -> None:
    assert Reach(Seen(0.0, 0.0, 0.0), Seen(1.0, 3.0, 0.0), 1.0).too_far_m == pytest.approx(2.0)
    assert Reach(Seen(0.0, 0.0, 0.0), Seen(1.0, 0.5, 0.0), 1.0).too_far_m == pytest.approx(-0.5)
