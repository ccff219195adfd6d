"""The safety filter: the half planes of every limit, and the nearest acceleration that keeps them."""

from __future__ import annotations

from math import cos, hypot, inf, pi, sin, sqrt

import pytest

from handfast.agent.control.hand import Pose, advance, hand, wrench
from handfast.agent.control.safety_filter import (
    BODY,
    HARDER,
    SPEED,
    STANDING,
    UNSURE,
    HalfPlane,
    keep_apart,
    keep_clear,
    limit_actuators,
    limit_speed,
    limit_turning,
    project,
    turning_limit,
)
from tests.values import values

RATE = 3.0
STILL = (0.0, 0.0)


def between(offset, velocity, other_velocity, gap=0.3, **how):
    """The half planes of both robots of a pair."""
    back = -offset[0], -offset[1]
    return (
        keep_apart("peer", offset, velocity, other_velocity, gap, RATE, **how),
        keep_apart("peer", back, other_velocity, velocity, gap, RATE, **how),
    )


def needed(offset, velocity, other_velocity, gap=0.3):
    """What the two must do together, (F2), from derivatives of h taken by differences."""

    def h(t):
        x = offset[0] + t * (velocity[0] - other_velocity[0])
        y = offset[1] + t * (velocity[1] - other_velocity[1])
        return hypot(x, y) - gap

    step = 1e-4
    rate = (h(step) - h(-step)) / (2.0 * step)
    curvature = (h(step) - 2.0 * h(0.0) + h(-step)) / step**2
    return -2.0 * RATE * rate - RATE**2 * h(0.0) - curvature


@pytest.mark.parametrize(
    ("offset", "velocity", "other_velocity"),
    [
        ((1.0, 0.0), (-0.5, 0.0), (0.5, 0.0)),
        ((0.6, -0.5), (0.3, 0.4), (-0.2, 0.9)),
        ((-0.4, 0.1), (0.8, 0.1), (0.8, 0.1)),
        ((0.1, 0.2), (-1.0, 0.3), (0.7, 0.0)),
    ],
)
def test_the_two_parts_of_a_pair_are_what_the_barrier_needs(offset, velocity, other_velocity):
    own, others = between(offset, velocity, other_velocity)
    assert own.least + others.least == pytest.approx(needed(offset, velocity, other_velocity), abs=1e-5)
    assert (own.nx, own.ny) == (-others.nx, -others.ny)
    assert hypot(own.nx, own.ny) == pytest.approx(1.0)


def test_a_pair_that_meets_head_on_shares_evenly():
    own, others = between((1.0, 0.0), (-0.5, 0.0), (0.5, 0.0))
    assert own.least == pytest.approx(others.least)
    assert own.least == pytest.approx(0.5 * (6.0 - 9.0 * 0.7))


def test_a_formation_on_its_way_may_close_in_as_one_that_stands():
    standing, _ = between((1.0, 0.0), STILL, STILL)
    for velocity in (0.4, 0.0), (-0.4, 0.0), (0.0, 0.9):
        moving, _ = between((1.0, 0.0), velocity, velocity)
        assert moving.least == pytest.approx(standing.least)


def test_who_follows_too_closely_gives_way_so_that_the_one_ahead_may_brake():
    speed, room = 0.9, 0.1  # more speed than RATE * room
    ahead, behind = between((0.3 + room, 0.0), (speed, 0.0), (speed, 0.0))
    assert ahead.least == pytest.approx(-RATE * speed)
    assert behind.least == pytest.approx(RATE * speed - RATE**2 * room)


def test_who_is_alone_does_it_all_and_never_less_than_its_part():
    closing = (0.5, 0.0), (-0.9, 0.0), (0.2, 0.0)
    whole, _ = between(*closing, alone=True)
    assert whole.least == pytest.approx(needed(*closing), abs=1e-5)
    far = (2.0, 0.0), (-0.3, 0.0), STILL
    assert [*map(values, between(*far, alone=True))] == [*map(values, between(*far))]


def test_who_has_come_too_fast_towards_one_that_does_nothing_brakes_harder():
    """Nearer than (F1) lets it come, as it has learned too late: not as softly as the barrier leads back."""
    closing = (0.5, 0.0), (-0.9, 0.0), (0.2, 0.0)
    whole, _ = between(*closing, alone=True, rank=STANDING)
    too_fast = 1.1 - RATE * 0.2
    assert whole.least == pytest.approx(needed(*closing) + HARDER * too_fast, abs=1e-5)


def test_of_what_the_other_does_only_what_brings_them_together_counts():
    closing = (0.5, 0.0), (-0.9, 0.0), (0.2, 0.0)
    whole, _ = between(*closing, alone=True)
    towards, _ = between(*closing, alone=True, other_acceleration=(2.0, 7.0))
    away, _ = between(*closing, alone=True, other_acceleration=(-2.0, 7.0))
    assert towards.least == pytest.approx(whole.least + 2.0)
    assert values(away) == values(whole)
    pushed = between(*closing, other_acceleration=(2.0, 0.0))
    assert [*map(values, pushed)] == [*map(values, between(*closing))]


def test_two_that_are_too_close_both_give_way():
    own, others = between((0.2, 0.0), STILL, STILL)
    assert own.least == others.least == pytest.approx(0.5 * RATE**2 * 0.1)


def test_two_hands_in_one_place_go_on_through_each_other():
    own, others = between((0.0, 0.0), (0.0, 0.5), (0.0, -0.5))
    assert (own.nx, own.ny) == (0.0, 1.0)
    assert (others.nx, others.ny) == (0.0, -1.0)
    own, _ = between((0.0, 0.0), STILL, STILL)
    assert project(1.0, 0.0, [own], 5.0) == (1.0, 0.0, (), 0.0)


def test_round_a_boundary_that_bulges_it_asks_for_more_than_is_needed():
    radius, clearance, x, speed = 0.5, 0.1, 0.65, 0.8

    def h(t):  # past a circle about the origin, at a tangent
        return hypot(x, speed * t) - radius - clearance

    step = 1e-4
    curvature = (h(step) - 2.0 * h(0.0) + h(-step)) / step**2
    plane = keep_clear("tree", x - radius, 1.0, 0.0, (0.0, speed), clearance, RATE)
    assert plane.least == pytest.approx(-(RATE**2) * h(0.0))
    assert plane.least > -(RATE**2) * h(0.0) - curvature + 0.9


def test_the_speed_is_let_grow_to_its_limit_and_brought_back_from_above():
    assert limit_speed(0.0, 0.0, 1.0, RATE) == ()
    (slow,) = limit_speed(0.3, 0.4, 1.0, RATE)
    limit = pytest.approx(-0.6), pytest.approx(-0.8), pytest.approx(-1.5)
    assert values(slow) == (*limit, "speed", SPEED)
    (fast,) = limit_speed(0.0, -2.0, 1.0, RATE)
    assert project(0.0, 0.0, [fast], 5.0)[:2] == pytest.approx((0.0, 3.0))


@pytest.mark.parametrize("pose", [Pose(1.0, 2.0, 0.7, 0.9, -1.5), Pose(0.0, 0.0, -2.0, -0.4, 0.0)])
def test_what_the_actuators_can_give_is_a_box_of_accelerations(pose):
    mass, inertia, reach, force, torque = 10.0, 0.13, 0.1, 20.0, 0.6
    planes = list(limit_actuators(pose, mass, inertia, reach, force, torque))
    for direction in range(16):
        angle = direction * pi / 8.0 + 0.1
        u = project(30.0 * cos(angle), 30.0 * sin(angle), planes, 100.0)
        given = wrench(u.ux, u.uy, pose, mass, inertia, reach)
        assert abs(given[0]) <= force + 1e-6
        assert abs(given[1]) <= torque + 1e-6
        # the nearest is on the edge of the box
        assert abs(given[0]) > force - 1e-6 or abs(given[1]) > torque - 1e-6
        assert u.causes == ("actuators",)


EAST = HalfPlane(1.0, 0.0, 1.0, "east")
WEST = HalfPlane(-1.0, 0.0, 1.0, "west")
NORTH = HalfPlane(0.0, 1.0, 2.0, "north")


def test_what_keeps_all_limits_is_not_touched():
    assert project(1.5, 2.5, [EAST, NORTH], 5.0) == (1.5, 2.5, (), 0.0)
    assert project(0.1, -0.2, [], 5.0) == (0.1, -0.2, (), 0.0)


def test_what_is_asked_too_much_is_shortened():
    u = project(30.0, -40.0, [], 5.0)
    assert (u.ux, u.uy) == pytest.approx((3.0, -4.0))
    assert hypot(u.ux, u.uy) <= 5.0
    assert u.causes == ("acceleration",)
    assert project(1.5e308, -1.5e308, [], 5.0)[:2] == pytest.approx((5.0 / sqrt(2.0), -5.0 / sqrt(2.0)))


def test_on_one_plane_on_two_and_on_the_circle():
    assert project(-4.0, 0.5, [EAST], 5.0) == (1.0, 0.5, ("east",), 0.0)
    assert project(-4.0, -2.0, [EAST, NORTH], 5.0) == (
        pytest.approx(1.0),
        pytest.approx(2.0),
        ("east", "north"),
        0.0,
    )
    u = project(0.0, 9.0, [EAST, HalfPlane(0.0, -1.0, -1.0, "south")], 1.2)
    assert (u.ux, u.uy) == pytest.approx((1.0, sqrt(1.2**2 - 1.0)))
    assert u.causes == ("east", "acceleration")


def test_two_planes_against_each_other_are_missed_by_the_same():
    u = project(3.0, 0.7, [EAST, WEST], 5.0)
    assert u[:2] == pytest.approx((0.0, 0.7), abs=1e-7)
    assert u.causes == ("east", "west")
    assert u.violation == pytest.approx(1.0, abs=1e-7)


def test_a_miss_that_cannot_be_helped_is_no_leave_to_miss_others():
    u = project(3.0, 0.7, [EAST, WEST, NORTH], 5.0)
    assert u[:2] == pytest.approx((0.0, 2.0), abs=1e-7)


def test_separation_comes_before_speed_and_the_body_before_both():
    slow = HalfPlane(-1.0, 0.0, 0.5, "speed", SPEED)
    assert project(0.0, 0.0, [slow, EAST], 5.0)[:2] == pytest.approx((1.0, 0.0), abs=1e-7)
    body = HalfPlane(-1.0, 0.0, -0.4, "body", BODY)
    u = project(0.0, 0.0, [slow, EAST, body], 5.0)
    assert u[:2] == pytest.approx((0.4, 0.0), abs=1e-7)
    assert u.violation == pytest.approx(0.9, abs=1e-7)
    assert u.causes == ("speed", "east", "body")


def test_a_body_that_spins_too_fast_for_its_own_limits_is_no_failure_of_separation():
    u = project(0.0, 0.0, [HalfPlane(1.0, 0.0, 9.0, "body", BODY), EAST], 5.0)
    assert u[:2] == pytest.approx((5.0, 0.0), abs=1e-3)
    assert u.violation == 0.0


@pytest.mark.parametrize("speed", [-1.0, -0.3, 0.0, 0.8])
@pytest.mark.parametrize(("yaw_rate", "turns"), [(0.0, 4.0), (3.9, 4.0), (-5.0, 4.0)])
def test_the_yaw_rate_comes_to_its_limit_and_no_further(yaw_rate: float, turns: float, speed: float) -> None:
    """Asked to turn as hard as can be at a speed that is kept; one that drives backwards swings round."""
    reach, rate, dt = 0.1, 3.0, 1e-3
    pose = Pose(0.0, 0.0, 0.7, speed, yaw_rate)
    began, _ = turning_limit(speed, reach, turns, rate)
    for _ in range(3000):
        c, s = cos(pose.heading), sin(pose.heading)
        along = -reach * pose.yaw_rate**2 + 9.0 * (speed - pose.speed)
        wanted = along * c - 30.0 * s, along * s + 30.0 * c
        ux, uy, _, _ = project(*wanted, list(limit_turning(pose, reach, turns, rate)), 50.0)
        pose = Pose(*advance(pose, *wrench(ux, uy, pose, 1.0, 1.0, reach), 1.0, 1.0, dt))
        limit, _ = turning_limit(pose.speed, reach, turns, rate)
        beyond = max(0.0, yaw_rate - began)  # of its limit, at first
        assert pose.yaw_rate <= limit + beyond + 2e-3 * turns
    assert pose.yaw_rate == pytest.approx(limit, abs=0.02 * turns)


def test_a_body_that_brakes_from_a_fast_drive_backwards_swings_round_no_faster_than_it_may() -> None:
    reach, rate, dt, turns = 0.1, 3.0, 1e-4, 4.0
    limit, slope = turning_limit(-1.0, reach, turns, rate)
    assert slope == pytest.approx(
        (turning_limit(-1.0 + 1e-6, reach, turns, rate)[0] - limit) / 1e-6, rel=1e-4
    )
    pose, most = Pose(0.0, 0.0, 0.0, -1.0, limit), 0.0
    for _ in range(20000):
        here = hand(pose, reach)
        ux, uy = -rate * here.vx, -rate * here.vy
        assert all(p.nx * ux + p.ny * uy >= p.least - 1e-2 for p in limit_turning(pose, reach, turns, rate))
        pose = Pose(*advance(pose, *wrench(ux, uy, pose, 1.0, 1.0, reach), 1.0, 1.0, dt))
        most = max(most, pose.yaw_rate)
    assert limit < 0.5 * turns
    assert 2.0 * limit < most <= turns * 1.001


def test_a_gap_that_grows_asks_for_as_much_more_as_keeps_up_with_it() -> None:
    """h' = n.w - growth, of which the own robot gives all that the growth asks for."""
    given = ("robot 2", (1.0, 0.0), (-0.5, 0.0), (0.2, 0.1), 0.5, 3.0)
    for alone in (False, True):
        still, grows = keep_apart(*given, alone=alone), keep_apart(*given, alone=alone, growth=0.15)
        assert grows.least - still.least == pytest.approx(2.0 * 3.0 * 0.15)
        assert (grows.nx, grows.ny) == (still.nx, still.ny)


def test_from_one_that_stands_it_keeps_away_though_another_follows_it() -> None:
    """Who follows can still make way."""
    follows = HalfPlane(1.0, 0.0, 1.0, "robot 2")
    stands = HalfPlane(-1.0, 0.0, 1.0, "robot 3", STANDING)
    found = project(0.0, 0.0, [follows, stands], 5.0)
    assert found.ux <= -1.0 + 1e-6


def test_separation_from_a_robot_that_is_known_comes_before_one_that_may_be_anywhere() -> None:
    known = HalfPlane(1.0, 0.0, 1.0, "robot 2")
    ghost = HalfPlane(-1.0, 0.0, 1.0, "robot 3", UNSURE)
    found = project(0.0, 0.0, [ghost, known], 5.0)
    assert found.ux >= 1.0 - 1e-6
    assert found.violation == pytest.approx(2.0, abs=1e-6)


def turned_by(pose: Pose, wanted: tuple[float, float], quickest: float) -> float:
    """The rate (rad/s^2) at which a body's turn changes, with what `limit_turning` lets pass of `wanted`."""
    planes = list(limit_turning(pose, 0.1, 0.5, 0.5, quickest=quickest))
    ux, uy, _, _ = project(*wanted, planes, 50.0)
    across = -ux * sin(pose.heading) + uy * cos(pose.heading)
    return (across - pose.speed * pose.yaw_rate) / 0.1


def test_a_period_swings_no_body_beyond_the_limit_of_its_turn() -> None:
    """At rest W_v is W, backwards it is next to nothing: what is left is not to be used up at once."""
    backwards = Pose(0.0, 0.0, 0.0, -0.12, 0.1)
    for side in (1.0, -1.0):
        wanted = 40.0, side * 40.0
        assert abs(turned_by(backwards, wanted, inf)) > 100.0
        assert side * turned_by(backwards, wanted, 2.0) <= 2.0 * (1.15 * 0.5 - side * 0.1) + 1e-6
