"""What a robot does for a body that rolls at it: as its own body can, and what keeps furthest away."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.dodging import (
    KEEPS_M,
    MOVES,
    STAND,
    STEP_S,
    Ability,
    Move,
    acceleration,
    clearance,
    out_of_the_way,
)
from handfast.agent.control.hand import Pose, advance, hand, wrench

CAN = Ability(0.8, 0.9, 1.0, 0.4)
GAP = 1.25
RESTS_S = 3.0
Way = list[tuple[float, float]]


def rolling(x: float, y: float, heading: float, speed: float) -> Way:
    """Every `STEP_S`, until it rests after `RESTS_S`."""
    steps = range(round(RESTS_S / STEP_S) + 1)
    return [(x + k * STEP_S * speed * cos(heading), y + k * STEP_S * speed * sin(heading)) for k in steps]


def test_where_standing_does_it_stands() -> None:
    here = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    passing = rolling(3.0, 2.0, pi, 0.9)
    assert clearance(here, STAND, [(passing, GAP)], CAN) == pytest.approx(2.0 - GAP, abs=0.01)
    assert out_of_the_way(here, [(passing, GAP)], CAN) == STAND
    assert out_of_the_way(here, [(rolling(9.0, 0.0, pi, 0.9), GAP)], CAN) == STAND


@pytest.mark.parametrize("speed", [0.0, 0.5])
@pytest.mark.parametrize("side", [-0.3, 0.3])
def test_from_one_that_rolls_at_it_head_on_it_goes_to_the_side_or_back(speed: float, side: float) -> None:
    here = Pose(0.0, 0.0, 0.0, speed, 0.0)
    ways = [(rolling(3.2, side, pi, 0.9), GAP)]
    move = out_of_the_way(here, ways, CAN)
    assert move[0] < 0.0 or move[0] * side * move[1] < 0.0, "not in front of it"
    assert clearance(here, move, ways, CAN) > max(-0.3, clearance(here, STAND, ways, CAN) + 0.5)


def test_between_two_it_keeps_from_both() -> None:
    here = Pose(0.0, 0.0, pi / 2, 0.0, 0.0)
    ways = [(rolling(2.5, 0.0, pi, 0.9), GAP), ([(-2.0, 0.0)], GAP)]
    move = out_of_the_way(here, ways, CAN)
    assert move[0] != 0.0
    assert clearance(here, move, ways, CAN) == max(clearance(here, each, ways, CAN) for each in MOVES)


def test_half_way_it_does_not_turn_back_for_little() -> None:
    here = Pose(0.0, 0.0, pi / 2, 0.0, 0.0)
    ways = [(rolling(2.5, 0.001, pi, 0.9), GAP)]
    first = out_of_the_way(here, ways, CAN)
    apart = {move: clearance(here, move, ways, CAN) for move in MOVES}
    near = [move for move in MOVES[1:] if move != first and apart[move] > apart[first] - 0.5 * KEEPS_M]
    assert near, "there are two ways that are as good"
    assert out_of_the_way(here, ways, CAN, near[0]) == near[0]


@given(
    heading=st.floats(-3.0, 3.0),
    speed=st.floats(-0.9, 0.9),
    turn=st.floats(-1.0, 1.0),
    move=st.sampled_from(MOVES),
)
def test_it_is_followed_as_the_body_moves_when_that_is_asked_of_it(
    heading: float, speed: float, turn: float, move: Move
) -> None:
    """A second of it, step by step: what is asked for is within its limit, and leads where it was to."""
    body = Pose(1.0, -2.0, heading, speed, turn)
    mark = [(9.0, 0.0)]
    expected = clearance(body, move, [(mark * 10, 0.0)], CAN)
    nearest = 9e9
    for _ in range(10):
        at = hand(body, CAN.reach)
        nearest = min(nearest, hypot(at.x - 9.0, at.y))
        asked = acceleration(body, move, CAN)
        assert hypot(*asked) <= CAN.hardest + 1e-9
        force, torque = wrench(*asked, body, 1.0, 1.0, CAN.reach)
        body = Pose(*advance(body, force, torque, 1.0, 1.0, STEP_S))
    assert nearest == pytest.approx(expected, abs=0.12)
