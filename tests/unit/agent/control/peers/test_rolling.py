"""Where a vehicle rolls that nothing commands: as a body that is driven so, step by step.

What a robot does for a body that rolls at it: as its own body can, and what keeps furthest away.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin, tau
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.hand import Pose, advance, hand, wrench
from handfast.agent.control.peers.rolling import (
    KEEPS_M,
    MOVES,
    SPEED_LAGS,
    STAND,
    STEP_S,
    STOPS_S,
    TURN_SHARE,
    Ability,
    Move,
    Rolls,
    acceleration,
    arc,
    arc_of,
    asked,
    clearance,
    is_somewhere_on,
    moves,
    out_of_the_way,
    rolled,
    rolls_of,
)
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.messages.types import HandState

REACH = 0.4
ROLLS = Rolls(3.5, REACH)
FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 5, y_m = 5, plant = "mavlink" }]
robot_defaults = { hand_offset_m = 0.4, mavlink = { connection = "simulator" } }
datum = { latitude_deg = 50.0, longitude_deg = 8.0 }
fleet = { name = "two" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [0, 9]], safe_distance_m = 1.0 }
"""


@given(
    heading=st.floats(0.0, tau),
    speed=st.floats(-1.0, 1.0),
    yaw_rate=st.floats(-1.5, 1.5),
    t=st.floats(0.0, 4.0),
)
def test_it_keeps_its_speed_and_yaw_rate(heading: float, speed: float, yaw_rate: float, t: float) -> None:
    pose = Pose(1.0, -2.0, heading, speed, yaw_rate)
    begins = hand(pose, REACH)
    for _ in range(40):
        pose = Pose(*advance(pose, 0.0, 0.0, 1.0, 1.0, t / 40))
    there = rolled(begins.x, begins.y, (heading, speed, yaw_rate), REACH, t)
    assert there == pytest.approx(hand(pose, REACH), abs=1e-6)


def test_its_way_leads_from_where_it_was_heard_to_where_it_rests():
    way = arc(1.0, 2.0, (0.5, 0.8, -0.3), ROLLS)
    assert way[0] == pytest.approx((0.0, 1.0, 2.0))
    assert way[-1] == pytest.approx(
        (ROLLS.for_s, *rolled(1.0, 2.0, (0.5, 0.8, -0.3), REACH, ROLLS.for_s)[:2])
    )
    assert [t for t, _, _ in way] == sorted(t for t, _, _ in way)


def test_one_that_says_what_it_obeys_turns_and_any_other_goes_straight_on():
    message = HandState.placed(2, 0, 0, True, 1, (0.0, 0.0, 0.3, 0.4))
    _, x, y = arc_of(message, ROLLS)[-1]
    assert (x, y) == pytest.approx((0.3 * ROLLS.for_s, 0.4 * ROLLS.for_s))
    _, x, y = arc_of(message._replace(obeys=((0.0, 0.5, pi / ROLLS.for_s),)), ROLLS)[-1]
    assert x == pytest.approx(-2.0 * REACH)  # it has turned about
    assert y == pytest.approx(2.0 * 0.5 * ROLLS.for_s / pi)


@pytest.mark.parametrize(
    "other",
    [{"following": True}, {"doubt": 0.2}, {"vx": 0.5}, {"obeys": ()}],
    ids=lambda each: next(iter(each)),
)
def test_others_say_where_they_are(other: dict[str, Any]) -> None:
    lost = HandState.placed(2, 0, 0, False, 1, (1.0, 2.0, 0.0, 0.0), 1.9, ((0.0, 0.5, 0.0),))
    assert is_somewhere_on(lost)
    assert not is_somewhere_on(lost._replace(**other))


def test_only_vehicles_roll_on():
    fleet = parse_fleet(FLEET, source="here")
    assert rolls_of(fleet.robot(1)) is None
    assert rolls_of(fleet.robot(2)) == Rolls(3.0 + STOPS_S, 0.4)


def test_a_body_moves_that_is_faster_than_its_estimate_is_wrong():
    assert not moves(0.03, -0.04)
    assert moves(0.0, -0.1)


def test_it_goes_by_what_it_was_asked_for_once_it_has_taken_that_up() -> None:
    assert asked(-0.5, 0.3, 0.3, 0.0) == (pytest.approx(tau - 0.5), 0.3, 0.0)
    _, speed, yaw_rate = asked(0.0, 0.2, 0.8, -0.4)
    assert (speed, yaw_rate) == pytest.approx((0.8 - SPEED_LAGS * 0.6, TURN_SHARE * -0.4))


CAN = Ability(0.8, 0.9, 1.0, 0.4)
GAP = 1.25
RESTS_S = 3.0
Track = list[tuple[float, float]]


def rolling(x: float, y: float, heading: float, speed: float) -> Track:
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
