"""What profiles draw alike."""

from __future__ import annotations

from itertools import combinations
from math import cos, dist, hypot, pi, sin

import pytest

from deploy.chaos.dice import Dice
from deploy.chaos.profiles import pieces


@pytest.mark.parametrize("rate_hz", [2, 5, 10, 12])
def test_timeouts_have_room_for_two_periods(rate_hz: float) -> None:
    given = pieces.timeouts(rate_hz)
    assert all(seconds > 2.0 / rate_hz for seconds in given.values())
    assert set(given) == {"plant_timeout_s", "wrench_timeout_s"}
    assert pieces.timeouts(20.0) == {}


def test_hands_are_apart_and_where_they_are_to_be() -> None:
    rows = pieces.robots_about(Dice("test"), range(1, 9), {3}, 4.0, 0.5, 0.2)
    hands = [
        (row["x_m"] + 0.2 * cos(row["heading_rad"]), row["y_m"] + 0.2 * sin(row["heading_rad"]))
        for row in rows
    ]
    assert all(dist(a, b) > 0.499 for a, b in combinations(hands, 2))
    assert all(max(abs(x), abs(y)) < 2.001 for x, y in hands)
    assert [row["id"] for row in rows if row.get("reserve")] == [3]


def test_courses_begin_where_they_are_to_and_keep_their_speed() -> None:
    for k in range(30):
        course = pieces.draw_trajectory(Dice("test", k), (2.0, 1.0), 1.0)
        speed = hypot(*course.get("velocity_mps", (course.get("speed_mps", 0.1), 0.0)))
        assert 0.09 < speed < 0.41
        if course["kind"] == "waypoints":
            assert course["waypoints_m"][0] == [2.0, 1.0]
        if course["kind"] == "circle":
            x, y = course["centre_m"]
            assert dist((x, y), (2.0, 1.0)) == pytest.approx(course["radius_m"], abs=2e-3)


def test_a_place_is_turned_counter_clockwise() -> None:
    assert pieces.turned((1.0, 0.0), 0.5 * pi) == pytest.approx((0.0, 1.0))
