"""The simulated unicycle: against scipy, its limits, its brake."""

from __future__ import annotations

from dataclasses import replace
from math import cos, exp, hypot, isfinite, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose, advance
from handfast.agent.fleet.sections import Robot
from handfast.agent.messages.types import ACTS_PERIODS
from handfast.plant import unicycle
from handfast.plant.backend import Command
from handfast.plant.unicycle import Actuator, Unicycle, integrate

MASS, INERTIA = 10.0, 0.13
PERIOD_S = 0.02
BODY = Robot(id=1, x_m=1.0, y_m=-2.0, heading_rad=0.5, mass_kg=MASS, inertia_kgm2=INERTIA)
POSES = [
    Pose(0.0, 0.0, 0.0, 0.0, 0.0),
    Pose(1.0, -2.0, 0.7, 0.5, -0.3),
    Pose(-3.0, 0.5, -2.9, -1.2, 9.0),
]


def solved(pose: Pose, force: Actuator, torque: Actuator, dt: float) -> Pose:
    def rate(t: float, y: NDArray[np.float64]) -> list[float]:
        _, _, heading, speed, yaw_rate = y
        return [
            speed * cos(heading),
            speed * sin(heading),
            yaw_rate,
            force.value(t) / MASS,
            torque.value(t) / INERTIA,
        ]

    solution = solve_ivp(rate, (0.0, dt), pose, method="DOP853", rtol=1e-12, atol=1e-12)
    return Pose._make(solution.y[:, -1].tolist())


# ---------------------------------------------------------------------- the motion


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("lag", [0.0, 0.005, 0.1, 3.0])
@pytest.mark.parametrize("dt", [0.001, 0.02, 0.5])
def test_integrate_against_scipy(pose: Pose, lag: float, dt: float):
    force, torque = Actuator(-5.0, 20.0, lag), Actuator(0.4, -0.9, lag)
    after, expected = integrate(pose, force, torque, MASS, INERTIA, dt), solved(pose, force, torque, dt)
    assert after[2:] == pytest.approx(expected[2:], rel=1e-9, abs=1e-9)  # in closed form
    # The quadrature is of polynomials; a lag that is gone within a small part of the step is none.
    short_lag = 0.0 < lag < dt / 20
    assert after[:2] == pytest.approx(expected[:2], abs=1e-5 if short_lag else 1e-9)


@pytest.mark.parametrize("yaw_rate", [30.0, -200.0, 1000.0])
def test_fast_turns_are_integrated_in_small_steps(yaw_rate: float):
    pose = Pose(0.0, 0.0, 0.3, 2.0, yaw_rate)
    force, torque = Actuator(0.0, 30.0, 0.0), Actuator(0.0, 1.0, 0.02)
    assert integrate(pose, force, torque, MASS, INERTIA, 0.1) == pytest.approx(
        solved(pose, force, torque, 0.1), rel=1e-9, abs=1e-9
    )


@pytest.mark.parametrize("lag", [0.0, 0.05])
def test_many_steps_are_one(lag: float):
    """A body that is stepped through the bus's ticks is where one long integration puts it."""
    body = Unicycle(replace(BODY, actuator_lag_s=lag), PERIOD_S)
    now, reading = 0, body.step(0, Command(12.0, 0.3))
    for _ in range(25):
        now += round(PERIOD_S * NS_PER_S)
        reading = body.step(now, Command(12.0, 0.3))
    start = Pose(1.0, -2.0, 0.5, 0.0, 0.0)
    expected = solved(start, Actuator(0.0, 12.0, lag), Actuator(0.0, 0.3, lag), 0.5)
    assert reading.pose == pytest.approx(expected, rel=1e-9, abs=1e-9)
    start = 12.0 * (1.0 - exp(-0.5 / lag)) if lag else 12.0
    assert reading.force == pytest.approx(Actuator(start, 12.0, lag).mean(PERIOD_S))


# ---------------------------------------------------------------------- the backend


def test_a_command_acts_from_its_step_on():
    body = Unicycle(BODY, PERIOD_S)
    first = body.step(0, Command(10.0, 0.0))
    assert (first.force, first.pose.speed) == (10.0, 0.0)
    second = body.step(NS_PER_S, Command(0.0, 0.0))
    assert (second.force, second.pose.speed) == (0.0, pytest.approx(1.0))
    third = body.step(2 * NS_PER_S, None)
    assert third.pose.speed == pytest.approx(1.0)


@pytest.mark.parametrize(("asked", "given"), [(50.0, 8.0), (-50.0, -8.0), (3.0, 3.0)])
def test_force_and_torque_are_limited(asked: float, given: float):
    body = Unicycle(replace(BODY, max_force_n=8.0, max_torque_nm=0.8), PERIOD_S)
    reading = body.step(0, Command(asked, asked / 10.0))
    assert (reading.force, reading.torque) == pytest.approx((given, given / 10.0))
    after = body.step(NS_PER_S // 10, Command(0.0, 0.0)).pose
    assert after.speed == pytest.approx(0.1 * given / MASS)
    assert after.yaw_rate == pytest.approx(0.1 * given / 10.0 / INERTIA)


@pytest.mark.parametrize("lag", [0.0, 0.001, 0.1])
def test_what_acts_is_told_until_the_next_step_as_the_lag_lets_it(lag: float):
    """Who predicts the body by what it tells is right about its speed, and all but right about its place."""
    body, now = Unicycle(replace(BODY, actuator_lag_s=lag), PERIOD_S), 0
    reading = body.step(0, Command(10.0, 1.0))
    for force in (10.0, -10.0, 3.0):
        expected = Pose(*advance(reading.pose, reading.force, reading.torque, MASS, INERTIA, PERIOD_S))
        now += round(PERIOD_S * NS_PER_S)
        reading = body.step(now, Command(force, 0.1 * force))
        assert reading.pose[3:] == pytest.approx(expected[3:])
        assert reading.pose == pytest.approx(expected, abs=5e-4)


def moving(body: Robot, period_s: float = PERIOD_S) -> tuple[Unicycle, int]:
    """A body that drives at 1 m/s and turns at 1 rad/s, and the time."""
    plant = Unicycle(body, period_s)
    plant.step(0, Command(MASS * 10.0, INERTIA * 10.0))
    reading = plant.step(NS_PER_S // 10, Command(0.0, 0.0))
    assert (reading.pose.speed, reading.pose.yaw_rate) == pytest.approx((1.0, 1.0))
    return plant, NS_PER_S // 10


@pytest.mark.parametrize("period_s", [0.001, 0.02, 0.09, 0.1, 0.5, 1.0])
def test_a_brake_brings_it_to_rest_and_holds_it(period_s: float):
    plant, now = moving(BODY, period_s)
    speeds, rates = [1.0], [1.0]
    for _ in range(max(5, round(2.0 / period_s))):
        reading = plant.step(now, None)
        now += round(period_s * NS_PER_S)
        reading = plant.step(now, None)
        speeds.append(reading.pose.speed)
        rates.append(reading.pose.yaw_rate)
    for values in (speeds, rates):
        assert np.all(np.diff(values) <= 1e-12)  # and never the other way
        assert min(values) > -1e-9
    assert abs(speeds[-1]) < 1e-3
    assert abs(rates[-1]) < 1e-3
    rest = reading.pose
    for _ in range(100):
        now += round(period_s * NS_PER_S)
        reading = plant.step(now, None)
    assert hypot(reading.pose.x - rest.x, reading.pose.y - rest.y) < 1e-3


def test_a_brake_knows_no_lag_and_keeps_the_limits():
    plant, now = moving(replace(BODY, actuator_lag_s=5.0 * 1e-9, max_force_n=1000.0))
    assert plant.step(now, None).force == pytest.approx(-MASS * unicycle.BRAKE_DECELERATION_MAX)
    slow = Unicycle(replace(BODY, actuator_lag_s=2.0), PERIOD_S)
    slow.step(0, Command(50.0, 0.0))
    slow.step(2 * NS_PER_S, Command(50.0, 0.0))
    assert slow.step(2 * NS_PER_S, None).force == pytest.approx(-MASS * unicycle.BRAKE_DECELERATION_MAX)
    plant, now = moving(replace(BODY, max_force_n=100.0, max_torque_nm=1.3))
    reading = plant.step(now, None)
    assert (reading.force, reading.torque) == pytest.approx((-50.0, -1.3))
    plant, now = moving(replace(BODY, max_force_n=100.0))
    plant._body = replace(BODY, max_force_n=20.0, max_torque_nm=0.01)  # weaker than what set it in motion
    reading = plant.step(now, None)
    assert (reading.force, reading.torque) == pytest.approx((-20.0, -0.01))


@pytest.mark.parametrize("gap_s", [0.15, 0.3, 1.0, 10.0])
def test_a_brake_holds_although_its_process_was_frozen(gap_s: float):
    """A step may come late, after a stall or SIGSTOP: a braking body has not reversed meanwhile."""
    plant, now = moving(BODY)
    plant.step(now, None)
    now += round(gap_s * NS_PER_S)
    pose = plant.step(now, None).pose
    assert -1e-9 < pose.speed <= 1.0
    assert -1e-9 < pose.yaw_rate <= 1.0


@pytest.mark.parametrize("gap_s", [0.15, 0.4, 0.9])
def test_a_body_whose_process_was_frozen_was_pushed_for_two_periods_and_went_on(gap_s: float):
    body = Unicycle(BODY, PERIOD_S, timeout_s=1.0)
    body.step(0, Command(20.0, 0.3))
    pose = body.step(round(gap_s * NS_PER_S), Command(20.0, 0.3)).pose
    pushed_s = min(gap_s, ACTS_PERIODS * PERIOD_S)
    assert pose.speed == pytest.approx(20.0 / MASS * pushed_s)
    assert pose.yaw_rate == pytest.approx(0.3 / INERTIA * pushed_s)


@pytest.mark.parametrize(
    ("force", "torque"),
    [(0.0, 1e6), (1e12, 0.0), (1.7e308, 0.0), (0.0, 1e12), (1e12, 1e155), (0.0, 1e300), (1.7e308, 1.7e308)],
)
def test_an_absurd_command_neither_stalls_it_nor_raises(
    force: float, torque: float, monkeypatch: pytest.MonkeyPatch
):
    """`PlantBackend.step` never blocks and never raises; what fails makes the reading unhealthy."""
    evaluations = 0

    def counted(angle: float) -> float:
        nonlocal evaluations
        evaluations += 1
        assert evaluations < 200_000, "the step does not end"
        return cos(angle)

    monkeypatch.setattr(unicycle, "cos", counted)
    body = Unicycle(BODY, PERIOD_S)
    for tick in range(3):
        reading = body.step(round(tick * PERIOD_S * NS_PER_S), Command(force, torque))
        if not all(map(isfinite, (*reading.pose, reading.force, reading.torque))):
            assert not reading.healthy
            assert reading.note
