"""Where a robot may be that is not heard: every place of its way lies on a stretch, at its time.

How far a point is from a robot's way, and which stretches of it are near.
"""

from __future__ import annotations

from itertools import pairwise
from math import cos, dist, hypot, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.peers.beliefs import (
    DOUBT_MAX,
    DOUBT_ROLLS_MAX,
    LENGTH_MAX,
    RUN,
    STRETCH,
    STRETCHES_MAX,
    Lane,
    Stretch,
    growth,
    offset,
    own_doubt,
    rolled_on,
    said_doubt,
    stands_after,
    stood_between,
    stood_on,
)
from handfast.agent.control.peers.rolling import Rolls, arc, rolled

Row = tuple[float, float, float]


def curve(speed: float, turn: float, seconds: float) -> list[Row]:
    """A way of constant speed and turning rate, a row every 0.1 s."""
    rows = [(0.0, 1.0, -2.0)]
    for k in range(1, round(seconds / 0.1) + 1):
        _, x, y = rows[-1]
        angle = turn * 0.1 * k
        rows.append((0.1 * k, x + 0.1 * speed * cos(angle), y + 0.1 * speed * sin(angle)))
    return rows


@given(
    speed=st.floats(0.0, 5.0),
    turn=st.floats(-4.0, 4.0),
    seconds=st.floats(0.1, 6.0),
    doubt=st.floats(0.0, DOUBT_MAX),
)
def test_every_place_of_the_way_is_on_a_stretch_that_is_there_by_then(
    speed: float, turn: float, seconds: float, doubt: float
):
    way = curve(speed, turn, seconds)
    belief = stood_on(way, doubt)
    assert 1 <= len(belief.stretches) <= STRETCHES_MAX
    for t, x, y in way:
        assert any(
            each.after <= t + 1e-9 and each.distance(x, y) + doubt <= each.radius + 1e-9
            for each in belief.stretches
        )
    for each in belief.stretches:  # the circle round all
        for end in ((each.x, each.y), each.end):
            assert dist(end, (belief.x, belief.y)) + each.radius + DOUBT_MAX <= belief.reach + 1e-9


@given(speed=st.floats(0.0, 5.0), turn=st.floats(-4.0, 4.0), x=st.floats(-3.0, 3.0), y=st.floats(-3.0, 3.0))
def test_told_as_a_straight_way_nothing_of_it_is_lost(speed: float, turn: float, x: float, y: float):
    belief = stood_on(curve(speed, turn, 3.0), 0.1)
    (told,) = stood_between(x, y, *belief.straight(x, y)).stretches
    for each in belief.stretches:
        for end in ((each.x, each.y), each.end):
            assert told.distance(*end) + each.radius <= told.radius + 1e-9


def test_a_short_way_is_one_stretch_and_a_longer_one_is_cut():
    assert len(stood_on(curve(0.0, 0.0, 3.0), 0.0).stretches) == 1
    assert len(stood_on(curve(0.9 * STRETCH, 0.0, 1.0), 0.0).stretches) == 1
    longer = stood_on(curve(0.45, 0.0, 1.0), 0.0).stretches
    assert len(longer) == 2
    assert [each.after for each in longer] == sorted(each.after for each in longer)
    assert all(dist(a.end, (b.x, b.y)) < 1e-9 for a, b in pairwise(longer))


def test_a_straight_way_is_no_wider_for_being_long():
    for seconds in (0.5, 6.0):
        assert all(
            each.radius == pytest.approx(0.1) for each in stood_on(curve(1.0, 0.0, seconds), 0.1).stretches
        )


def test_the_nearest_point_of_a_stretch_is_beside_it_or_an_end():
    line = Stretch(1.0, 1.0, 2.0, 0.0, 0.1, 0.0)
    assert line.offset(2.0, 1.5) == (0.0, 0.5, False)
    assert line.offset(0.5, 1.0) == (-0.5, 0.0, True)
    assert line.offset(4.0, 2.0) == (1.0, 1.0, True)
    assert Stretch(1.0, 1.0, 0.0, 0.0, 0.1, 0.0).offset(1.0, 3.0) == (0.0, 2.0, True)


def test_stretches_widen_with_the_age_and_stay_bounded():
    (there,) = stood_between(0.0, 0.0, 0.0, 0.0, 0.2).stretches
    assert there.radius_at(0.05) == 0.2
    assert 0.2 < there.radius_at(1.0) < there.radius_at(2.0) < 0.2 + DOUBT_MAX
    assert there.radius_at(1e9) == pytest.approx(0.2 + DOUBT_MAX)
    assert said_doubt(0.0) == 0.0
    for age in (0.0, 0.05, 0.5, 1.9, 2.2, 60.0):
        assert growth(age) == pytest.approx((said_doubt(age + 1e-6) - said_doubt(age)) / 1e-6, abs=1e-6)


def test_a_robot_that_is_cut_off_one_way_first_and_then_the_other_stands_in_time() -> None:
    """Its beacons end, and just before the others' could tell it so theirs do: it waits once more."""
    horizon, forgiven, beacon, braking = 2.0, 0.4, 0.2, 0.3
    given_up = horizon + forgiven
    told = given_up + beacon  # by when it would have heard that it is not heard
    assert told + given_up + braking <= stands_after(horizon, forgiven)


@given(
    st.floats(-2.0, 2.0), st.floats(0.0, 6.2), st.floats(-1.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.3)
)
def test_a_body_that_rolls_on_may_be_on_all_of_that_way_as_well_from_when_it_is_there(
    speed: float, heading: float, yaw_rate: float, share: float, off: float
) -> None:
    before = stood_on(curve(0.5, 1.0, 3.0), 0.1)
    rolls, (x, y) = Rolls(3.5, 0.4), before.way[0]
    obeys = heading, speed, yaw_rate
    belief = rolled_on(before, arc(x, y, obeys, rolls), off)
    age = share * rolls.for_s
    there = rolled(x, y, obeys, rolls.reach, age)
    on = [each for each in belief.stretches if each.after <= age]
    assert min(each.distance(there.x, there.y) - each.radius for each in on) < -0.1 - off + 0.05
    assert set(before.stretches) <= set(belief.stretches)
    assert set(before.way) <= set(belief.way)
    assert [each.after for each in belief.stretches] == sorted(each.after for each in belief.stretches)
    assert dist((there.x, there.y), (belief.x, belief.y)) <= belief.reach


def test_whose_body_may_roll_on_is_believed_more_doubt_than_others():
    assert own_doubt(99.0, rolls=False) == DOUBT_MAX
    assert own_doubt(99.0, rolls=True) == DOUBT_ROLLS_MAX
    assert own_doubt(0.1, rolls=False) == own_doubt(0.1, rolls=True) == 0.1


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
