"""The hand point over all bodies and poses: the feedback linearisation (39) takes it all out."""

from __future__ import annotations

from math import hypot

from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.hand import Pose, advance, hand, wrench
from tests.hand_acceleration import hand_acceleration

COORDINATE = st.floats(-1e3, 1e3)
SPEED = st.floats(-20.0, 20.0)
POSES = st.builds(Pose, COORDINATE, COORDINATE, st.floats(-100.0, 100.0), SPEED, SPEED)
MASS = st.floats(0.1, 1e4)
INERTIA = st.floats(1e-3, 1e4)
REACH = st.floats(0.01, 10.0)
ACCELERATION = st.floats(-50.0, 50.0)


@given(ACCELERATION, ACCELERATION, POSES, MASS, INERTIA, REACH)
def test_the_wrench_gives_the_acceleration_that_was_asked_for(ux, uy, pose, mass, inertia, reach):
    force, torque = wrench(ux, uy, pose, mass, inertia, reach)
    ax, ay = hand_acceleration(force, torque, pose, mass, inertia, reach)
    # What is taken out by (39) and put in again by (4).
    size = 1.0 + hypot(ux, uy) + reach * pose.yaw_rate**2 + abs(pose.speed * pose.yaw_rate)
    assert hypot(ax - ux, ay - uy) < 1e-12 * size


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), POSES, MASS, INERTIA, REACH)
def test_the_acceleration_gives_back_the_wrench(force, torque, pose, mass, inertia, reach):
    ux, uy = hand_acceleration(force, torque, pose, mass, inertia, reach)
    again, torque_again = wrench(ux, uy, pose, mass, inertia, reach)
    size = hypot(ux, uy) + reach * pose.yaw_rate**2 + abs(pose.speed * pose.yaw_rate) + 1.0
    assert abs(again - force) < 1e-12 * (mass * size + abs(force))
    assert abs(torque_again - torque) < 1e-12 * (inertia / reach * size + abs(torque))


@given(POSES, REACH)
def test_the_hand_keeps_its_distance_from_the_axle(pose, reach):
    point = hand(pose, reach)
    assert abs(hypot(point.x - pose.x, point.y - pose.y) - reach) < 1e-9 + 1e-12 * hypot(pose.x, pose.y)
    # Its speed along the heading is the body's, across it the turn's.
    assert abs(hypot(point.vx, point.vy) - hypot(pose.speed, reach * pose.yaw_rate)) < 1e-9


@given(POSES, st.floats(-100.0, 100.0), st.floats(-1.0, 1.0), st.floats(0.0, 0.05), st.floats(0.0, 0.05))
def test_two_short_steps_are_one_long_step(pose, force, torque, first, second):
    one = Pose(*advance(pose, force, torque, 10.0, 0.5, first + second))
    two = Pose(*advance(advance(pose, force, torque, 10.0, 0.5, first), force, torque, 10.0, 0.5, second))
    assert abs(one.speed - two.speed) < 1e-12 * (1.0 + abs(pose.speed))
    assert abs(one.yaw_rate - two.yaw_rate) < 1e-12 * (1.0 + abs(pose.yaw_rate))
    assert abs(one.heading - two.heading) < 1e-10
    assert hypot(one.x - two.x, one.y - two.y) < 0.1  # Simpson's rule over up to two radians


@given(POSES)
def test_no_time_no_change(pose):
    assert advance(pose, 5.0, 0.5, 10.0, 0.5, 0.0) == pose
