"""Whatever is asked of a simulated rover: what it makes of it is finite, or the end of it."""

from __future__ import annotations

from math import isfinite

from hypothesis import given
from hypothesis import strategies as st

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import wrapped
from handfast.bridges.mavlink.simulator.guided import (
    Guided,
    NotFinite,
    Pose,
    PositionTarget,
    of_position_target,
)
from tests.unit.bridges.mavlink.rover_bench import MASK_VELOCITY

FINITE = st.floats(-1e6, 1e6, width=32)
ANY = FINITE | st.sampled_from([float("nan"), float("inf"), float("-inf")])
POSES = st.builds(Pose, FINITE, FINITE, st.floats(-4.0, 4.0))


def messages(values: st.SearchStrategy[float]) -> st.SearchStrategy[PositionTarget]:
    frames = st.sampled_from([1, 7, 8, 9]) | st.integers(0, 255)
    return st.builds(PositionTarget, frames, st.integers(0, 0xFFFF), *[values] * 6)


@given(messages(FINITE), POSES)
def test_what_is_finite_gives_demands_that_are(message: PositionTarget, pose: Pose) -> None:
    target = of_position_target(message, pose, 3.0)
    if target is None:
        return
    guided = Guided()
    guided.take(target, 0)
    speed, yaw_rate = guided.demand(pose, 3.0, 2.0)
    assert abs(speed) <= 3.0
    assert isfinite(yaw_rate)


@given(messages(ANY), POSES)
def test_what_is_used_is_finite_or_the_end(message: PositionTarget, pose: Pose) -> None:
    try:
        target = of_position_target(message, pose, 3.0)
    except NotFinite:
        assert not all(map(isfinite, message[2:]))
        return
    if target is not None:
        assert all(map(isfinite, target))


@given(st.floats(-3.0, 3.0, width=32), FINITE, st.sampled_from([1, 7, 8, 9]), POSES)
def test_a_bridges_setpoint_means_what_it_says(v: float, w: float, frame: int, pose: Pose) -> None:
    message = PositionTarget(frame, constants.MASK_SPEED_AND_YAW_RATE, 0.0, 0.0, v, 0.0, 0.0, w)
    assert of_position_target(message, pose, 3.0) == (v, w)


@given(FINITE, FINITE, POSES)
def test_a_velocity_vector_never_reverses(vx: float, vy: float, pose: Pose) -> None:
    message = PositionTarget(1, MASK_VELOCITY, 0.0, 0.0, vx, vy, 0.0, 0.0)
    target = of_position_target(message, pose, 3.0)
    assert target is not None
    assert target[0] >= 0.0
    assert target[1] == wrapped(target[1])
