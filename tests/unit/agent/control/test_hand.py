"""The unicycle and its hand point: eqs (1)-(6) against finite differences and scipy."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from handfast.agent.control.hand import Pose, advance, hand, wrench
from handfast.agent.formation.points import Floats
from tests.hand_acceleration import hand_acceleration

MASS, INERTIA, REACH = 10.0, 0.13, 0.1
POSES = [
    Pose(0.0, 0.0, 0.0, 0.0, 0.0),
    Pose(1.0, -2.0, 0.7, 0.5, -0.3),
    Pose(-3.0, 0.5, -2.9, -1.2, 4.0),
    Pose(1e3, 1e3, 30.0, 2.0, -6.0),
]


def unicycle(force: float, torque: float, mass: float = MASS, inertia: float = INERTIA):
    """Eq. (1) as an ordinary differential equation."""

    def rate(_t: float, y: Floats) -> Floats:
        _, _, heading, speed, yaw_rate = y
        return np.array(
            [speed * cos(heading), speed * sin(heading), yaw_rate, force / mass, torque / inertia]
        )

    return rate


def solved(pose: Pose, force: float, torque: float, dt: float) -> Pose:
    solution = solve_ivp(
        unicycle(force, torque), (0.0, dt), pose, method="DOP853", rtol=1e-12, atol=1e-13, max_step=abs(dt)
    )
    return Pose._make(solution.y[:, -1].tolist())


# ---------------------------------------------------------------------- the hand point


def test_hand_point_lies_ahead_of_the_axle():
    assert hand(Pose(1.0, 2.0, 0.0, 0.0, 0.0), 0.1) == pytest.approx((1.1, 2.0, 0.0, 0.0))
    assert hand(Pose(1.0, 2.0, pi / 2, 0.0, 0.0), 0.1) == pytest.approx((1.0, 2.1, 0.0, 0.0))
    assert hand(Pose(1.0, 2.0, -pi / 2, 0.0, 0.0), 0.3) == pytest.approx((1.0, 1.7, 0.0, 0.0))


@pytest.mark.parametrize("pose", POSES)
def test_hand_velocity_is_the_derivative_of_its_position(pose: Pose):
    h = 1e-5
    ahead, behind = (hand(solved(pose, 0.0, 0.0, dt), REACH) for dt in (h, -h))
    now = hand(pose, REACH)
    assert now.vx == pytest.approx((ahead.x - behind.x) / (2 * h), abs=1e-6)
    assert now.vy == pytest.approx((ahead.y - behind.y) / (2 * h), abs=1e-6)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(("force", "torque"), [(0.0, 0.0), (13.0, 0.2), (-4.0, -1.1)])
def test_hand_acceleration_is_the_derivative_of_its_velocity_4(pose: Pose, force: float, torque: float):
    h = 1e-5
    ahead, behind = (hand(solved(pose, force, torque, dt), REACH) for dt in (h, -h))
    ax, ay = hand_acceleration(force, torque, pose, MASS, INERTIA, REACH)
    assert ax == pytest.approx((ahead.vx - behind.vx) / (2 * h), abs=1e-5)
    assert ay == pytest.approx((ahead.vy - behind.vy) / (2 * h), abs=1e-5)


def test_acceleration_is_g_plus_h_times_the_wrench_5():
    """G_i and H_i as the paper writes them."""
    pose, force, torque = POSES[1], 7.0, -0.4
    c, s, v, w = cos(pose.heading), sin(pose.heading), pose.speed, pose.yaw_rate
    g = np.array([-v * w * s - REACH * w * w * c, v * w * c - REACH * w * w * s])
    h = np.array([[c / MASS, -REACH * s / INERTIA], [s / MASS, REACH * c / INERTIA]])
    expected = g + h @ (force, torque)
    assert hand_acceleration(force, torque, pose, MASS, INERTIA, REACH) == pytest.approx(expected)
    u = np.array([0.3, -1.1])
    assert wrench(*u, pose, MASS, INERTIA, REACH) == pytest.approx(np.linalg.solve(h, u - g))


# ---------------------------------------------------------------------- the body carried forward


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("dt", [0.0, 0.01, 0.05, -0.02])
def test_advance_against_scipy(pose: Pose, dt: float):
    force, torque = 20.0, 0.3
    expected = solved(pose, force, torque, dt) if dt else pose
    after = Pose(*advance(pose, force, torque, MASS, INERTIA, dt))
    assert after.speed == pytest.approx(expected.speed, abs=1e-12)
    assert after.yaw_rate == pytest.approx(expected.yaw_rate, abs=1e-12)
    assert after.heading == pytest.approx(expected.heading, abs=1e-11)
    assert after.x == pytest.approx(expected.x, abs=1e-5)
    assert after.y == pytest.approx(expected.y, abs=1e-5)
