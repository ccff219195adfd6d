"""How a rover steers, and how few of its outputs are read to know that."""

from __future__ import annotations

from handfast.bridges.mavlink.ardupilot.steering import (
    ALL,
    FRAME_TYPE,
    USUAL,
    to_read,
    trouble,
    turns_on_the_spot,
)

NONE = dict.fromkeys(ALL, 0.0)


def test_skid_steering_is_a_throttle_on_each_side_wherever() -> None:
    assert turns_on_the_spot({**NONE, "SERVO1_FUNCTION": 73.0, "SERVO3_FUNCTION": 74.0})
    assert turns_on_the_spot({**NONE, "SERVO16_FUNCTION": 73.0, "SERVO2_FUNCTION": 74.0})
    assert not turns_on_the_spot({**NONE, "SERVO1_FUNCTION": 73.0, "SERVO3_FUNCTION": 73.0})
    assert turns_on_the_spot({FRAME_TYPE: 1.0})
    assert not turns_on_the_spot({FRAME_TYPE: None})


def test_steering_and_throttle_are_front_wheels() -> None:
    ackermann = {**NONE, "SERVO1_FUNCTION": 26.0, "SERVO3_FUNCTION": 70.0}
    assert trouble(ackermann) == "it steers by its front wheels (SERVO1_FUNCTION 26)"
    assert trouble({**ackermann, FRAME_TYPE: 1.0}) == ""
    assert trouble({**ackermann, "SERVO3_FUNCTION": 0.0}) == ""
    assert trouble({}) == ""


def test_the_usual_ones_are_waited_for_and_further_ones_read_where_these_do_not_settle_it() -> None:
    one, three = USUAL
    assert to_read({}) == to_read({one: 26.0}) == ()
    assert to_read({one: None, three: None}) == (), "it tells nothing"
    assert to_read({one: 73.0, three: 74.0}) == ()
    assert to_read({one: 0.0, three: None}) == (FRAME_TYPE,)
    assert to_read({one: 26.0, three: 70.0, FRAME_TYPE: 0.0}) == ()
    read = {one: 26.0, three: 0.0, FRAME_TYPE: 0.0}
    assert to_read(read) == ("SERVO2_FUNCTION", "SERVO4_FUNCTION")
    assert to_read({**read, "SERVO2_FUNCTION": 70.0, "SERVO4_FUNCTION": 0.0}) == ()
    read |= {"SERVO2_FUNCTION": None, "SERVO4_FUNCTION": 0.0}
    assert to_read(read) == ALL[4:]
    assert to_read({**read, **dict.fromkeys(ALL[4:], 0.0)}) == ()
