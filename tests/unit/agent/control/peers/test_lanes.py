"""How far a point is from a robot's way, and which stretches of it are near."""

from __future__ import annotations

from itertools import pairwise
from math import dist, hypot

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.peers.lanes import LENGTH_MAX, RUN, Lane, offset

POINT = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))


def plain(points: list[tuple[float, float]], x: float, y: float) -> float:
    """Distance to the line through `points`, piece by piece."""
    least = dist(points[0], (x, y))
    for (ax, ay), (bx, by) in pairwise(points):
        square = (bx - ax) ** 2 + (by - ay) ** 2
        share = 0.0 if square == 0.0 else ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / square
        share = max(0.0, min(1.0, share))
        least = min(least, dist((ax + share * (bx - ax), ay + share * (by - ay)), (x, y)))
    return least


@given(points=st.lists(POINT, min_size=1, max_size=40), at=POINT, within=st.floats(0.1, 20.0))
def test_the_distance_is_to_the_nearest_piece_and_whatever_is_near_is_in_a_near_run(
    points: list[tuple[float, float]], at: tuple[float, float], within: float
):
    lane, away = Lane(points), plain(points, *at)
    assert lane.distance(*at) == pytest.approx(away, abs=1e-6)
    near = lane.near(*at, within)
    if away < within - 1e-6:
        assert min(hypot(*offset(run, *at)) for run in near) == pytest.approx(away, abs=1e-6)
    assert all(hypot(run.x - at[0], run.y - at[1]) < run.reach + within for run in near)


def test_of_a_long_way_only_a_stretch_is_near():
    lane = Lane([(0.0, 0.0), (10_000.0, 0.0)])
    near = lane.near(5000.0, 1.0, 2.0)
    assert 1 <= len(near) <= 2
    assert all(len(run.pieces) <= RUN and run.reach <= RUN * LENGTH_MAX for run in near)
    assert offset(near[0], 5000.0, 1.0)[1] == pytest.approx(1.0)


def test_a_way_that_goes_nowhere_is_a_place():
    for points in ([(1.0, 2.0)], [(1.0, 2.0), (1.0, 2.0)]):
        lane = Lane(points)
        assert lane.distance(4.0, 6.0) == pytest.approx(5.0)
        (run,) = lane.near(1.0, 2.0, 0.1)
        assert offset(run, 1.0, 2.0) == (0.0, 0.0)


def test_pieces_too_short_to_have_a_direction_are_none() -> None:
    assert Lane([(0.0, 0.0), (1e-200, 0.0)]).distance(3.0, 4.0) == 5.0
    assert Lane([(0.0, 0.0), (1e-200, 0.0), (6.0, 0.0)]).distance(3.0, 4.0) == 4.0
