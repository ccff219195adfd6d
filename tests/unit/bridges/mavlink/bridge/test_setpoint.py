"""From a wrench to what a rover is asked for: the reference, its lead, its limits, no wind-up."""

from __future__ import annotations

from itertools import pairwise
from math import inf, nan

import pytest

from handfast.agent.control.hand import Pose
from handfast.bridges.mavlink.ardupilot.dynamics import Limits
from handfast.bridges.mavlink.bridge.estimate import Residual
from handfast.bridges.mavlink.bridge.setpoint import (
    DISAGREES_S,
    LEAD_SPEED_S,
    LEAD_YAW_S,
    REPORT_DEAD_BAND,
    SPEED_BAND,
    YAW_RATE_BAND,
    Bounds,
    MotionCheck,
    Setpoint,
)
from handfast.plant.backend import Command

MASS, INERTIA, DT = 20.0, 2.0, 0.04
REST = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
NONE = Residual(0.0, 0.0)


def setpoint(bounds: Bounds = Bounds(), limits: Limits | None = None) -> Setpoint:  # noqa: B008
    made = Setpoint(MASS, INERTIA, bounds)
    if limits is not None:
        made.vehicle = limits
    return made


def moving(made: Setpoint) -> Pose:
    """An estimate of a rover that does what the reference does."""
    return REST._replace(speed=made.speed, yaw_rate=made.yaw_rate)


def push(made: Setpoint, acceleration: float, spin: float, seconds: float) -> tuple[float, float]:
    """For some time, with a rover that follows."""
    asked = (0.0, 0.0)
    for _ in range(round(seconds / DT)):
        asked = made.step(DT, Command(MASS * acceleration, INERTIA * spin), moving(made), NONE)
    return asked


def test_the_reference_integrates_the_wrench():
    made = setpoint()
    push(made, 0.5, 0.2, 1.0)
    # The first step only begins: what it was told acts from then on.
    assert made.speed == pytest.approx(0.5 * (1.0 - DT))
    assert made.yaw_rate == pytest.approx(0.2 * (1.0 - DT))
    assert (made.force, made.torque) == pytest.approx((MASS * 0.5, INERTIA * 0.2))


def test_what_is_asked_for_leads():
    made = setpoint()
    speed, yaw_rate = push(made, 0.5, 0.2, 1.0)
    assert speed == pytest.approx(made.speed + 0.5 * (LEAD_SPEED_S + DT / 2))
    assert yaw_rate == pytest.approx(made.yaw_rate + 0.2 * (LEAD_YAW_S + DT / 2))
    steady = push(made, 0.0, 0.0, 2 * DT)
    assert steady == pytest.approx((made.speed, made.yaw_rate))


def test_through_zero_into_reverse():
    made = setpoint()
    push(made, 0.5, 0.0, 0.8)
    speeds = [push(made, -0.5, 0.0, DT)[0] for _ in range(40)]
    assert speeds[-1] < -0.3
    steps = [b - a for a, b in pairwise(speeds[1:])]
    assert steps == pytest.approx([-0.5 * DT] * len(steps))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_stuck_rover_is_not_wound_up(sign: float):
    """It stands, whatever it is asked for; once free it is not asked for more than a little."""
    made = setpoint()
    speed = yaw_rate = 0.0
    for _ in range(250):
        stuck = Residual(-speed, -yaw_rate)
        speed, yaw_rate = made.step(DT, Command(sign * MASS * 0.8, sign * INERTIA), REST, stuck)
        assert abs(speed) <= SPEED_BAND + 0.8 * (LEAD_SPEED_S + DT)
        assert abs(yaw_rate) <= YAW_RATE_BAND + 1.0 * (LEAD_YAW_S + DT)
        assert abs(made.speed) < 0.07  # the agent is told that it stands
    assert sign * speed > 0.1  # it still tries
    assert sign * yaw_rate > 0.1
    for _ in range(25):  # pushed back: for a second, not for as long as it was stuck
        speed, _ = made.step(DT, Command(-sign * MASS * 0.8, 0.0), REST, NONE)
    assert sign * speed < 0.0


def test_a_slow_rover_pulls_the_reference_down():
    made = setpoint()
    speed, _ = push(made, 0.5, 0.0, 1.0)
    speed, _ = made.step(DT, Command(0.0, 0.0), moving(made), NONE)
    for _ in range(25):
        speed, _ = made.step(DT, Command(0.0, 0.0), REST._replace(speed=speed - 0.3), Residual(-0.3, 0.0))
    assert speed == pytest.approx(0.5 - 0.2, abs=0.01)  # by what is beyond the dead band, in 1 s


def test_the_agent_is_told_of_a_rover_that_is_elsewhere():
    made = setpoint()
    push(made, 0.5, 0.2, 1.0)
    reference = made.speed, made.yaw_rate
    made.step(DT, Command(0.0, 0.0), REST._replace(speed=0.3, yaw_rate=0.4), NONE)
    assert (made.speed, made.yaw_rate) == pytest.approx(
        (0.3 + REPORT_DEAD_BAND[0], 0.4 - REPORT_DEAD_BAND[1])
    )
    made.step(DT, Command(0.0, 0.0), REST._replace(speed=0.47, yaw_rate=0.19), NONE)
    assert (made.speed, made.yaw_rate) == pytest.approx((reference[0] + 0.02, reference[1] + 0.008))


def test_phantom_speed_does_not_move_it():
    made = setpoint()
    for k in range(250):
        phantom = 0.05 if k % 50 < 25 else -0.02
        asked = made.step(
            DT, Command(0.0, 0.0), REST._replace(speed=phantom, yaw_rate=0.01), Residual(phantom, 0.01)
        )
        assert asked == (0.0, 0.0)


def test_a_brake_asks_for_nothing_and_takes_up_without_a_jerk():
    made = setpoint()
    push(made, 0.5, 0.3, 1.0)
    measured = REST._replace(speed=0.4, yaw_rate=-0.2)
    assert made.step(DT, None, measured, NONE) == (0.0, 0.0)
    assert (made.speed, made.yaw_rate, made.force, made.torque) == (0.4, -0.2, 0.0, 0.0)
    assert made.step(DT, Command(0.0, 0.0), measured, NONE) == (0.4, -0.2)


def test_a_rover_that_stands_is_told_to_stand():
    made = setpoint()
    made.step(DT, None, REST._replace(speed=0.05, yaw_rate=-0.02), NONE)
    assert (made.speed, made.yaw_rate) == (0.0, 0.0)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("where", ["force", "torque", "speed", "yaw_rate", "residual"])
def test_what_is_not_a_number_brakes(bad: float, where: str):
    made = setpoint()
    push(made, 0.5, 0.3, 1.0)
    command, pose, residual = Command(1.0, 1.0), moving(made), NONE
    if where in ("force", "torque"):
        command = command._replace(**{where: bad})
    elif where == "residual":
        residual = Residual(bad, 0.0)
    else:
        pose = pose._replace(**{where: bad})
    assert made.step(DT, command, pose, residual) == (0.0, 0.0)
    assert "not a number" in made.note
    assert all(abs(value) < 1.0 for value in (made.speed, made.yaw_rate, made.force, made.torque))
    made.step(DT, Command(1.0, 1.0), REST, NONE)
    assert made.note == ""


def test_a_huge_wrench_is_limited():
    made = setpoint()
    for _ in range(100):
        assert made.step(DT, Command(1e308, -1e308), moving(made), NONE) <= (1.0, 1.0)
    assert (made.speed, made.yaw_rate) == (1.0, -1.0)


# ---------------------------------------------------------------------- motion follows


def checked(
    predicted: tuple[float, float], residual: Residual, seconds: float, *, driving: bool = True
) -> str:
    check = MotionCheck()
    return [check.step(DT, driving, predicted, residual) for _ in range(round(seconds / DT))][-1]


def test_a_stuck_rover_is_told_of():
    assert checked((0.5, 0.0), Residual(-0.48, 0.0), DISAGREES_S - DT) == ""
    note = checked((0.5, 0.0), Residual(-0.48, 0.0), DISAGREES_S)
    assert note == "does not follow its commands: asked for 0.50 m/s, moves at 0.02 m/s"
    assert checked((-0.5, 0.0), Residual(0.48, 0.0), 4.0).endswith("asked for -0.50 m/s, moves at -0.02 m/s")


@pytest.mark.parametrize(
    ("predicted", "residual"),
    [
        ((0.0, 0.0), Residual(0.05, 0.01)),  # phantom speed
        ((0.5, 0.3), Residual(0.1, 0.1)),
        ((1.0, 0.0), Residual(-0.55, 0.0)),  # a slope, tall grass
        ((0.1, 0.1), Residual(-0.1, -0.1)),  # too slow to tell
    ],
)
def test_what_is_ordinary_is_not(predicted: tuple[float, float], residual: Residual):
    assert checked(predicted, residual, 10.0) == ""


def test_one_that_others_drive_is_not_checked():
    assert checked((0.0, 0.0), Residual(1.0, 0.0), 10.0, driving=False) == ""


def test_told_until_it_follows_again():
    check = MotionCheck()
    stuck, free = Residual(-0.5, 0.0), NONE
    for _ in range(round(DISAGREES_S / DT)):
        check.step(DT, True, (0.5, 0.0), stuck)
    assert check.step(DT, True, (0.5, 0.0), free)
    notes = [check.step(DT, True, (0.5, 0.0), free) for _ in range(round(DISAGREES_S / DT))]
    assert notes[-1] == ""
    assert check.step(DT, True, (0.5, 0.0), stuck) == ""  # begins to count anew
