"""Desired navigation: every kind's values at known times, and what a bad section says."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, pi, sqrt

import pytest

from handfast.agent.control.peers.beliefs import Lane
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.trajectory import (
    corner_distances,
    corner_turns,
    duration,
    legs,
    make_trajectory,
    maximum_acceleration,
    maximum_speed,
    maximum_speed_along,
)

LINE = TrajectorySection("line", start_m=(1.0, -2.0), velocity_mps=(0.2, -0.1))
HOLD = TrajectorySection("hold", start_m=(3.0, 4.0))
CIRCLE = TrajectorySection("circle", centre_m=(1.0, 2.0), radius_m=2.0, speed_mps=0.5, phase_rad=pi / 2)
CORNER = TrajectorySection(
    "waypoints", waypoints_m=((0.0, 0.0), (4.0, 0.0), (4.0, 3.0)), speed_mps=0.5, corner_acceleration=0.3
)


def test_line_moves_from_the_epoch_on():
    assert make_trajectory(LINE).at(10.0) == pytest.approx((3.0, -3.0, 0.2, -0.1, 0.0, 0.0))
    assert make_trajectory(LINE).at(0.0) == (1.0, -2.0, 0.2, -0.1, 0.0, 0.0)


@pytest.mark.parametrize("section", [LINE, HOLD, CIRCLE, CORNER], ids=lambda section: section.kind)
def test_before_the_epoch_it_holds_at_the_start_at_rest(section: TrajectorySection):
    trajectory = make_trajectory(section)
    assert trajectory.at(-5.0) == (*trajectory.at(0.0)[:2], 0.0, 0.0, 0.0, 0.0)


def test_hold_stays():
    assert make_trajectory(HOLD).at(1e6) == (3.0, 4.0, 0.0, 0.0, 0.0, 0.0)
    assert duration(HOLD) == 0.0


def test_circle_starts_at_its_phase_counter_clockwise():
    assert make_trajectory(CIRCLE).at(0.0) == pytest.approx((1.0, 4.0, -0.5, 0.0, 0.0, -0.125))
    quarter = pi / 2 / (0.5 / 2.0)
    assert make_trajectory(CIRCLE).at(quarter) == pytest.approx((-1.0, 2.0, 0.0, -0.5, 0.125, 0.0))


def test_waypoints_drive_the_middle_of_a_leg_straight_at_the_wanted_speed():
    trajectory = make_trajectory(CORNER)
    x, y, vx, vy, ax, ay = trajectory.at(1.25 + 4.0)
    assert (x, y) == pytest.approx((2.0, 0.0))
    assert (vx, vy, ax, ay) == (0.5, 0.0, 0.0, 0.0)


def test_waypoints_pass_a_corner_at_the_stated_distance_with_the_stated_acceleration():
    trajectory = make_trajectory(CORNER)
    x, y, vx, vy, ax, ay = trajectory.at(1.25 + 8.0)  # the middle of the blend
    assert hypot(x - 4.0, y) == pytest.approx(corner_distances(CORNER)[1])
    assert corner_distances(CORNER)[1] == pytest.approx(9.0 / 64.0 * 2.0 * 0.25 / 0.3)
    assert (vx, vy) == pytest.approx((0.25, 0.25))
    assert (ax, ay) == pytest.approx((-0.3 / sqrt(2.0), 0.3 / sqrt(2.0)))


def test_a_short_leg_is_driven_slower_and_the_others_as_asked():
    section = replace(CORNER, waypoints_m=((0.0, 0.0), (5.0, 0.0), (5.0, 0.1), (9.0, 0.1)))
    speeds = [leg.speed for leg in legs(section)]
    assert speeds[0] == speeds[2] == 0.5
    # 0.75 v (|dv| + |dv'|) <= a length, met with at most 2 % to spare
    used = 0.75 * speeds[1] * 2.0 * hypot(0.5, speeds[1])
    assert 0.96 * 0.3 * 0.1 <= used <= 0.3 * 0.1


def test_a_single_leg_too_short_for_the_speed_is_an_acceleration_and_a_braking():
    section = replace(CORNER, waypoints_m=((0.0, 0.0), (0.5, 0.0)), speed_mps=5.0)
    (leg,) = legs(section)
    assert leg.speed == pytest.approx(sqrt(0.3 * 0.5 / 1.5), rel=0.02)  # v^2 = a length / 1.5
    assert maximum_speed(section) == leg.speed
    assert make_trajectory(section).at(100.0)[:2] == (0.5, 0.0)


def test_durations_and_greatest_values():
    assert duration(LINE) is None
    assert duration(replace(LINE, velocity_mps=(0.0, 0.0))) == 0.0
    assert duration(CIRCLE) is None
    assert maximum_speed(LINE) == pytest.approx(hypot(0.2, 0.1))
    assert maximum_speed(CIRCLE) == maximum_speed(CORNER) == 0.5
    assert maximum_speed(HOLD) == 0.0
    assert maximum_speed_along(LINE, 1.0, 0.0) == 0.2
    assert maximum_speed_along(LINE, 0.6, 0.8) == pytest.approx(0.04)
    assert maximum_speed_along(CORNER, 1.0, 0.0) == maximum_speed_along(CORNER, 0.0, -1.0) == 0.5
    assert maximum_speed_along(CORNER, sqrt(0.5), sqrt(0.5)) == pytest.approx(0.5 * sqrt(0.5))
    assert maximum_speed_along(CIRCLE, 0.0, 1.0) == 0.5
    assert maximum_speed_along(HOLD, 1.0, 0.0) == 0.0
    assert maximum_acceleration(CIRCLE) == pytest.approx(0.125)
    assert maximum_acceleration(CORNER) == 0.3
    assert maximum_acceleration(LINE) == maximum_acceleration(HOLD) == 0.0
    assert legs(LINE) == corner_distances(LINE) == corner_turns(LINE) == ()


@pytest.mark.parametrize(
    ("section", "field"),
    [
        (TrajectorySection("line"), "velocity_mps"),
        (replace(HOLD, start_m=(float("nan"), 0.0)), "start_m"),
        (replace(CIRCLE, radius_m=0.0), "radius_m"),
        (replace(CIRCLE, speed_mps=None), "speed_mps"),
        (replace(CIRCLE, centre_m=None), "centre_m"),
        (replace(CIRCLE, phase_rad=float("inf")), "phase_rad"),
        (replace(CORNER, waypoints_m=()), "waypoints_m"),
        (replace(CORNER, waypoints_m=((0.0, 0.0), (float("inf"), 0.0))), r"waypoints_m\[2\]"),
        (replace(CORNER, speed_mps=-1.0), "speed_mps"),
        (replace(CORNER, corner_acceleration=0.0), "corner_acceleration"),
        (replace(HOLD, kind="spiral"), "kind"),  # type: ignore[arg-type]
    ],
)
def test_a_bad_section_names_the_field(section: TrajectorySection, field: str):
    with pytest.raises(ValueError, match=rf"trajectory\.{field}"):
        make_trajectory(section)
    with pytest.raises(ValueError, match=rf"trajectory\.{field}"):
        duration(section)


@pytest.mark.parametrize("section", [LINE, HOLD, CIRCLE, CORNER], ids=lambda section: section.kind)
@pytest.mark.parametrize(("since", "until"), [(-2.0, 40.0), (3.0, 9.0), (8.0, 8.5), (500.0, 600.0)])
def test_the_path_is_where_the_reference_goes_and_nowhere_else(
    section: TrajectorySection, since: float, until: float
):
    trajectory = make_trajectory(section)
    path = trajectory.path(since, until)
    lane = Lane(path)
    for k in range(201):
        x, y = trajectory.at(since + (until - since) * k / 200)[:2]
        assert lane.distance(x, y) < 0.01
    went = Lane([trajectory.at(since + (until - since) * k / 2000)[:2] for k in range(2001)])
    assert all(went.distance(x, y) < 0.02 for x, y in path)
