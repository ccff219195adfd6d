"""Where a robot may be that is not heard: every place of its way lies in a disc, at its time."""

from __future__ import annotations

from itertools import pairwise
from math import cos, dist, hypot, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.control.peers.beliefs import (
    DISCS_MAX,
    DOUBT_MAX,
    STRETCH,
    growth,
    said_doubt,
    stands_after,
    stood_between,
    stood_on,
)

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
def test_every_place_of_the_way_is_in_a_disc_that_is_there_by_then(
    speed: float, turn: float, seconds: float, doubt: float
):
    way = curve(speed, turn, seconds)
    belief = stood_on(way, doubt)
    assert 1 <= len(belief.discs) <= DISCS_MAX
    for t, x, y in way:
        assert any(
            disc.after <= t + 1e-9 and dist((x, y), disc[:2]) + doubt <= disc.radius + 1e-9
            for disc in belief.discs
        )
    for disc in belief.discs:  # the circle round all
        assert dist(disc[:2], (belief.x, belief.y)) + disc.radius + DOUBT_MAX <= belief.reach + 1e-9


@given(speed=st.floats(0.0, 5.0), turn=st.floats(-4.0, 4.0), x=st.floats(-3.0, 3.0), y=st.floats(-3.0, 3.0))
def test_told_as_a_straight_way_nothing_of_it_is_lost(speed: float, turn: float, x: float, y: float):
    belief = stood_on(curve(speed, turn, 3.0), 0.1)
    told = stood_between(x, y, *belief.straight(x, y))
    for disc in belief.discs:
        reached = [
            each for each in told.discs if dist(each[:2], disc[:2]) <= each.radius - disc.radius + 1e-9
        ]
        assert reached or _covered(disc.x, disc.y, disc.radius, told.discs)


def _covered(x: float, y: float, radius: float, discs: tuple[tuple[float, float, float, float], ...]) -> bool:
    """Whether points all over a circle are in one disc or another."""
    points = [
        (x + share * radius * cos(k), y + share * radius * sin(k)) for k in range(12) for share in (0, 0.5, 1)
    ]
    return all(any(dist(p, disc[:2]) <= disc[2] + 1e-9 for disc in discs) for p in points)


def test_a_short_way_is_one_disc_and_a_longer_one_is_cut():
    assert len(stood_on(curve(0.0, 0.0, 3.0), 0.0).discs) == 1
    assert len(stood_on(curve(0.9 * STRETCH, 0.0, 1.0), 0.0).discs) == 1
    longer = stood_on(curve(0.45, 0.0, 1.0), 0.0).discs
    assert len(longer) == 2
    assert [disc.after for disc in longer] == sorted(disc.after for disc in longer)
    assert all(hypot(b.x - a.x, b.y - a.y) <= a.radius + b.radius + 1e-9 for a, b in pairwise(longer))


def test_discs_grow_with_the_age_and_stay_bounded():
    (disc,) = stood_between(0.0, 0.0, 0.0, 0.0, 0.2).discs
    assert disc.radius_at(0.05) == 0.2
    assert 0.2 < disc.radius_at(1.0) < disc.radius_at(2.0) < 0.2 + DOUBT_MAX
    assert disc.radius_at(1e9) == pytest.approx(0.2 + DOUBT_MAX)
    assert said_doubt(0.0) == 0.0
    for age in (0.0, 0.05, 0.5, 1.9, 2.2, 60.0):
        assert growth(age) == pytest.approx((said_doubt(age + 1e-6) - said_doubt(age)) / 1e-6, abs=1e-6)


def test_a_robot_that_is_cut_off_one_way_first_and_then_the_other_stands_in_time() -> None:
    """Its beacons end, and just before the others' could tell it so theirs do: it waits once more."""
    horizon, forgiven, beacon, braking = 2.0, 0.4, 0.2, 0.3
    given_up = horizon + forgiven
    told = given_up + beacon  # by when it would have heard that it is not heard
    assert told + given_up + braking <= stands_after(horizon, forgiven)
