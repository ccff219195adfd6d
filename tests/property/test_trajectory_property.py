"""Waypoint trajectories over any waypoints: smooth, within their limits, and there in the end."""

from __future__ import annotations

from itertools import pairwise
from math import hypot

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.trajectory import (
    corner_distances,
    duration,
    legs,
    make_trajectory,
    maximum_speed,
    maximum_speed_along,
)

COORDINATE = st.floats(-20.0, 20.0).map(lambda value: round(value, 3))
POINTS = st.lists(st.tuples(COORDINATE, COORDINATE), min_size=2, max_size=7).map(tuple)
SECTIONS = st.builds(
    TrajectorySection,
    st.just("waypoints"),
    waypoints_m=POINTS,
    speed_mps=st.floats(0.05, 3.0),
    corner_acceleration=st.floats(0.05, 3.0),
)


def moving(section: TrajectorySection) -> float:
    """Its duration; sections that never move are thrown away."""
    end = duration(section)
    assert end is not None
    assume(end > 0.0)
    return end


@given(SECTIONS, st.floats(0.0, 1.0))
@settings(max_examples=200, deadline=None)
def test_derivatives_agree_with_differences(section: TrajectorySection, share: float):
    end = moving(section)
    trajectory, t = make_trajectory(section), share * end
    step = 1e-4 * min(1.0, end)
    if t < step:
        t = step
    before, here, after = (trajectory.at(t + k * step) for k in (-1, 0, 1))
    # |a| <= a_max, so over one step a velocity is off by at most a_max * step; jerk is at most 6 |dv| / T^2
    for axis in (0, 1):
        assert abs((after[axis] - before[axis]) / (2 * step) - here[axis + 2]) <= (
            section.corner_acceleration * step + 1e-8
        )
    jerk = jerk_bound(section)
    for axis in (2, 3):
        assert abs((after[axis] - before[axis]) / (2 * step) - here[axis + 2]) <= jerk * step + 1e-8


@pytest.mark.slow
@given(SECTIONS)
@settings(max_examples=100, deadline=None)
def test_acceleration_is_bounded_and_continuous(section: TrajectorySection):
    end = moving(section)
    trajectory, jerk = make_trajectory(section), jerk_bound(section)
    steps = 500
    samples = [trajectory.at(end * k / steps) for k in range(-2, steps + 3)]
    for _, _, vx, vy, ax, ay in samples:
        assert hypot(ax, ay) <= section.corner_acceleration * (1 + 1e-9)
        assert hypot(vx, vy) <= maximum_speed(section) * (1 + 1e-9)
        assert abs(0.28 * vx - 0.96 * vy) <= maximum_speed_along(section, 0.28, -0.96) + 1e-9
    for a, b in pairwise(samples):
        assert hypot(b[4] - a[4], b[5] - a[5]) <= jerk * end / steps * (1 + 1e-6) + 1e-9
        assert (
            hypot(b[2] - a[2], b[3] - a[3]) <= section.corner_acceleration * end / steps * (1 + 1e-6) + 1e-9
        )


def jerk_bound(section: TrajectorySection) -> float:
    """6 |dv| / T^2 with T = 1.5 |dv| / a, for the gentlest change of velocity: 8/3 a^2 / |dv|."""
    # The cut of a corner says its |dv|^2 = 64/9 a cut; at both ends |dv| is the leg's speed.
    squares = [64.0 / 9.0 * section.corner_acceleration * d for d in corner_distances(section)[1:-1]]
    driven = legs(section)
    ends = [driven[0].speed, driven[-1].speed]
    gentlest = min([square**0.5 for square in squares if square > 1e-24] + ends)
    return 8.0 / 3.0 * section.corner_acceleration**2 / gentlest


@given(SECTIONS)
@settings(max_examples=100, deadline=None)
def test_begins_and_ends_at_rest_on_the_first_and_last_waypoint(section: TrajectorySection):
    end = moving(section)
    trajectory = make_trajectory(section)
    assert section.waypoints_m is not None
    assert trajectory.at(0.0) == (*section.waypoints_m[0], 0.0, 0.0, 0.0, 0.0)
    final = trajectory.at(end)
    assert hypot(final[0] - section.waypoints_m[-1][0], final[1] - section.waypoints_m[-1][1]) < 1e-9
    assert final[2:] == (0.0, 0.0, 0.0, 0.0)


@given(SECTIONS)
@settings(max_examples=60, deadline=None)
def test_passes_every_waypoint_within_its_stated_distance(section: TrajectorySection):
    end = moving(section)
    trajectory = make_trajectory(section)
    assert section.waypoints_m is not None
    points = [section.waypoints_m[0]]
    points += [b for a, b in pairwise(section.waypoints_m) if a != b]
    cuts = corner_distances(section)
    assert len(cuts) == len(points)
    steps = 4000
    path = [trajectory.at(end * k / steps) for k in range(steps + 1)]
    slack = maximum_speed(section) * end / steps
    for (x, y), cut in zip(points, cuts, strict=True):
        assert min(hypot(px - x, py - y) for px, py, *_ in path) <= cut + slack


@given(SECTIONS)
@settings(max_examples=200, deadline=None)
def test_legs_are_never_faster_than_asked(section: TrajectorySection):
    moving(section)
    assert section.speed_mps is not None
    for leg in legs(section):
        assert 0.0 < leg.speed <= section.speed_mps
