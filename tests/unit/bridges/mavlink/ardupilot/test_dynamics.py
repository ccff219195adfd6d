"""The modelled rover against the step responses measured on the autopilot (shared facts, ArduRover).

Times were read to 10 ms from samples 20 ms apart, speeds and yaw rates to three digits of one run each:
`TIME` and the relative tolerances below are those reading errors."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, degrees, hypot, pi, sin

import pytest

from handfast.bridges.mavlink.ardupilot.dynamics import Limits, RoverDynamics

DT = 0.005
TIME = 0.02
"""s."""
Response = list[tuple[float, float, float]]
"""Time (s), speed (m/s) and yaw rate (rad/s), truth."""


def driven(rover: RoverDynamics, speed: float, yaw_rate: float, seconds: float, dt: float = DT) -> Response:
    out = []
    for k in range(round(seconds / dt)):
        rover.step(dt, speed, yaw_rate)
        out.append(((k + 1) * dt, rover.speed, rover.yaw_rate))
    return out


def reaches(response: Response, share: float, target: float, column: int) -> float:
    """When the response first has that share of the target."""
    return next(row[0] for row in response if row[column] / target >= share)


def settled(response: Response, target: float, column: int) -> float:
    """From when on it stays within 5 %."""
    return max(row[0] for row in response if abs(row[column] - target) > 0.05 * abs(target)) + DT


def peak(response: Response, column: int) -> float:
    return max(row[column] for row in response)


def test_speed_of_a_half():
    response = driven(RoverDynamics(), 0.5, 0.0, 12.0)
    for share, when in ((0.1, 0.22), (0.63, 0.52), (0.9, 0.67)):
        assert reaches(response, share, 0.5, 1) == pytest.approx(when, abs=TIME)
    assert peak(response, 1) == pytest.approx(0.544, abs=0.004)
    assert settled(response, 0.5, 1) == pytest.approx(2.4, abs=0.1)
    assert response[-1][1] == pytest.approx(0.501, abs=0.002)


def test_speed_of_one_and_a_half():
    response = driven(RoverDynamics(), 1.5, 0.0, 12.0)
    assert reaches(response, 0.9, 1.5, 1) == pytest.approx(1.49, abs=TIME)
    assert peak(response, 1) == pytest.approx(1.613, abs=0.01)


def test_yaw_rate():
    response = driven(RoverDynamics(), 0.0, 0.3, 3.0)
    for share, when in ((0.1, 0.06), (0.63, 0.12), (0.9, 0.14)):
        assert reaches(response, share, 0.3, 2) == pytest.approx(when, abs=0.5 * TIME)
    assert peak(response, 2) == pytest.approx(0.371, abs=0.004)
    assert settled(response, 0.3, 2) == pytest.approx(0.28, abs=TIME)
    assert response[-1][2] == pytest.approx(0.2996, abs=0.001)


def test_reverse_while_turning():
    response = driven(RoverDynamics(), -0.5, 0.3, 12.0)
    assert reaches(response, 0.9, -0.5, 1) == pytest.approx(0.71, abs=0.045)  # measured 0.67 the other way
    assert reaches(response, 0.9, 0.3, 2) == pytest.approx(0.13, abs=TIME)
    assert response[-1][1] == pytest.approx(-0.512, abs=0.015)
    assert response[-1][2] == pytest.approx(0.2997, abs=0.001)


def test_stop():
    rover = RoverDynamics()
    driven(rover, 0.5, 0.3, 10.0)
    response = driven(rover, 0.0, 0.0, 2.0)
    assert max(t for t, speed, _ in response if speed > 0.03) == pytest.approx(0.8, abs=0.1)
    assert rover.speed == 0.0
    assert rover.yaw_rate == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("dt", [0.001, 0.0025, 0.01, 0.02])
def test_step_length_does_not_matter(dt: float):
    coarse, fine = RoverDynamics(), RoverDynamics()
    driven(coarse, 0.5, 0.3, 2.0, dt)
    driven(fine, 0.5, 0.3, 2.0)
    assert coarse.speed == pytest.approx(fine.speed, abs=0.003)
    assert coarse.yaw == pytest.approx(fine.yaw, abs=0.005)
    assert hypot(coarse.north - fine.north, coarse.east - fine.east) < 0.005


def test_nothing_moves_before_the_delay():
    response = driven(RoverDynamics(), 1.0, 1.0, 0.1)
    still = [t for t, speed, yaw_rate in response if speed == 0.0 and yaw_rate == 0.0]
    assert max(still) == pytest.approx(0.03, abs=DT)


def test_commands_that_change_each_act_in_their_turn():
    rover = RoverDynamics()
    for k in range(200):  # a ramp
        rover.step(0.02, 0.0, 0.002 * k)
    assert rover.yaw_rate == pytest.approx(0.002 * 199, abs=0.01)


def limit_reached(limits: Limits, speed: float, yaw_rate: float) -> RoverDynamics:
    rover = RoverDynamics()
    for _ in range(1000):
        rover.step(0.02, speed, yaw_rate, limits=limits)
    return rover


def test_limits():
    assert limit_reached(Limits(), 9.0, 0.0).speed == pytest.approx(3.0, abs=0.01)
    assert degrees(limit_reached(Limits(), 0.0, -9.0).yaw_rate) == pytest.approx(-120.0, abs=0.1)
    fast = limit_reached(Limits(), 3.0, 9.0)
    assert fast.speed * fast.yaw_rate == pytest.approx(0.6 * 9.80665, rel=0.01)
    slow = Limits(speed=0.4, yaw_rate=0.2)
    assert limit_reached(slow, -2.0, 1.0).speed == pytest.approx(-0.4, abs=0.002)
    assert limit_reached(slow, -2.0, 1.0).yaw_rate == pytest.approx(0.2, abs=0.002)


def test_a_limit_of_zero_is_none():
    free = limit_reached(Limits(0.0, 0.0, 0.0, 0.0), 5.0, 3.0)
    assert free.speed == pytest.approx(5.0, abs=0.01)
    assert free.yaw_rate == pytest.approx(3.0, abs=0.01)


def test_without_power_it_rolls_out():
    rover = RoverDynamics()
    driven(rover, 1.0, 0.5, 5.0)
    for _ in range(200):
        rover.step(0.02, 1.0, 0.5, powered=False)
    assert (rover.speed, rover.yaw_rate) == (0.0, 0.0)
    driven(rover, 1.0, 0.0, 0.5)  # and begins anew
    assert 0.1 < rover.speed < 0.5


def heading(north: float, east: float, yaw: float) -> Callable[[float], tuple[float, float]]:
    return lambda way: (north + way * cos(yaw), east + way * sin(yaw))


@pytest.mark.parametrize("yaw", [0.0, 0.5 * pi, -2.0])
def test_drives_along_its_yaw(yaw: float):
    rover = RoverDynamics(3.0, -2.0, yaw)
    driven(rover, 0.5, 0.0, 4.0)
    way = hypot(rover.north - 3.0, rover.east + 2.0)
    assert 1.5 < way < 2.0
    assert (rover.north, rover.east) == pytest.approx(heading(3.0, -2.0, yaw)(way))


def test_turns_clockwise():
    rover = RoverDynamics()
    driven(rover, 0.5, 0.3, 10.0)
    assert rover.yaw == pytest.approx(3.0, abs=0.05)
    assert rover.east > 1.0  # to the right of north
