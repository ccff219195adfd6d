"""agent.control.detour: when a robot goes round what blocks it, which way, and when it is back on the direct
way."""

from __future__ import annotations

from math import inf, isfinite, nan

import pytest

from agent.control.detour import (
    FREE_S,
    KEEPS_S,
    PATIENCE_S,
    PATIENCE_WITH_ROBOTS_S,
    ROUND_S,
    SPEED_MIN,
    Blocker,
    Detour,
)

PERIOD = 0.02
EAST, STILL = (0.5, 0.0), (0.0, 0.0)
WALL = Blocker(-1.0, 0.0, "wall", True)
NORTH_WALL, SOUTH_WALL = Blocker(0.0, -1.0, "north", True), Blocker(0.0, 1.0, "south", True)
ROBOT = Blocker(-1.0, 0.0, "robot 7", False)


def run(detour, seconds, blockers, wanted=EAST, own=STILL):
    """What it says after so many seconds of the same."""
    given = None
    for _ in range(round(seconds / PERIOD)):
        given = detour.velocity(wanted, own, blockers)
    return given


def blocked(blockers, wanted=EAST):
    detour = Detour(PERIOD)
    run(detour, 5.0, blockers, wanted)
    assert detour.round
    return detour


@pytest.mark.parametrize(("blocker", "patience"), [(WALL, PATIENCE_S), (ROBOT, PATIENCE_WITH_ROBOTS_S)])
def test_it_begins_after_it_has_been_held_up_for_a_while(blocker, patience):
    detour = Detour(PERIOD)
    assert run(detour, patience - 3 * PERIOD, [blocker]) is None
    assert run(detour, 4 * PERIOD, [blocker]) is not None
    assert (detour.round, detour.fixed) == (blocker.name, blocker.fixed)


def test_what_does_not_hold_it_up_is_left_alone():
    for blockers, own, wanted in (
        ([], STILL, EAST),
        ([NORTH_WALL], STILL, EAST),  # beside it
        ([WALL], EAST, EAST),  # it gets on all the same
        ([WALL], STILL, (0.9 * SPEED_MIN, 0.0)),  # it is about there
    ):
        detour = Detour(PERIOD)
        assert run(detour, 10.0, blockers, wanted, own) is None
        assert detour.round == ""


def test_it_is_not_held_up_for_good_if_it_gets_on_in_between():
    detour = Detour(PERIOD)
    for _ in range(5):
        assert run(detour, 0.9 * PATIENCE_S, [WALL]) is None
        assert run(detour, PERIOD, [WALL], own=EAST) is None


def test_it_goes_along_what_blocks_it_as_fast_as_it_would_and_keeps_to_the_right():
    x, y = run(blocked([WALL]), PERIOD, [WALL])
    assert (x, y) == pytest.approx((0.0, -0.5), abs=0.05)
    assert x > 0.0  # it leans against it


@pytest.mark.parametrize(("wanted", "northwards"), [((0.4, 0.3), True), ((0.4, -0.3), False)])
def test_it_begins_on_the_side_to_which_its_place_is_nearer(wanted, northwards):
    _, y = run(blocked([WALL], wanted), PERIOD, [WALL], wanted)
    assert (y > 0.0) is northwards


def test_it_is_back_on_the_direct_way_when_that_has_been_free_for_a_while():
    detour = blocked([WALL])
    given = run(detour, 1.2, [])  # turns back
    assert given == pytest.approx(EAST)
    assert run(detour, FREE_S, []) is None
    assert (detour.round, detour.fixed) == ("", False)


def test_out_of_a_trap_it_first_turns_back_as_far_as_it_has_turned_away():
    detour = blocked([WALL])
    run(detour, 1.0, [WALL, SOUTH_WALL])  # into the corner, and back west
    given = run(detour, 2.0, [SOUTH_WALL])
    assert given == pytest.approx((-0.5, 0.0), abs=0.06)
    assert detour.round  # though the direct way has been free for long


def test_turns_are_counted_beyond_half_a_one():
    detour, west_wall = blocked([WALL]), Blocker(1.0, 0.0, "west", True)
    run(detour, 1.0, [WALL, SOUTH_WALL])
    given = run(detour, 1.0, [SOUTH_WALL, west_wall])  # the last corner of a cup: north, by three quarters
    assert given == pytest.approx((0.0, 0.5), abs=0.06)
    given = run(detour, 2.0, [])
    assert given is not None
    assert detour.round
    assert given[0] < 0.4


def test_round_a_robot_it_leaves_as_soon_as_the_direct_way_is_free():
    detour = blocked([ROBOT])
    beside = Blocker(0.0, 1.0, "robot 7", False)
    assert run(detour, FREE_S + PERIOD, [beside]) is None


def test_held_up_again_soon_after_it_keeps_the_side_but_not_for_ever():
    northwards = (0.4, 0.3)
    for pause, keeps in ((0.5 * KEEPS_S, True), (KEEPS_S + 1.0, False)):
        detour = blocked([WALL])  # southwards
        run(detour, 2.0, [])
        assert run(detour, pause, []) is None
        _, y = run(detour, 2.0, [WALL], northwards)
        assert (y < 0.0) is keeps
    at_its_place = blocked([WALL])
    run(at_its_place, PERIOD, [], STILL)
    _, y = run(at_its_place, 2.0, [WALL], northwards)
    assert y > 0.0


def test_it_tries_the_sides_in_turn_for_longer_and_longer():
    detour, sides = Detour(PERIOD), []
    for _ in range(round(8.0 * ROUND_S / PERIOD)):
        given = detour.velocity(EAST, STILL, [WALL])
        if given is not None:
            sides.append(given[1] > 0.0)
    turns = [k for k in range(1, len(sides)) if sides[k] != sides[k - 1]]
    assert [k * PERIOD for k in turns] == pytest.approx([ROUND_S, 3.0 * ROUND_S, 7.0 * ROUND_S], abs=0.6)


def test_where_all_ways_are_blocked_it_does_not_count_turns_that_it_does_not_make():
    proximity = [WALL, NORTH_WALL, SOUTH_WALL, Blocker(1.0, 0.0, "west", True)]
    detour = blocked(proximity)
    run(detour, 10.0, proximity)
    run(detour, 4.5, [])  # all free: it turns back less than once
    assert detour.round == ""


def test_a_robot_that_ceases_to_drive_is_on_no_detour():
    detour = blocked([WALL])
    detour.reset()
    assert detour.round == ""
    assert detour.velocity(EAST, STILL, [WALL]) is None


@pytest.mark.parametrize("absurd", [nan, inf, 1e300])
def test_absurd_numbers_pass_through_without_harm(absurd):
    detour = blocked([WALL])
    detour.velocity((absurd, 0.0), STILL, [WALL])
    detour.velocity(EAST, (absurd, absurd), [WALL])
    detour.reset()
    given = run(detour, 2.0, [WALL])
    assert all(isfinite(value) for value in given)
