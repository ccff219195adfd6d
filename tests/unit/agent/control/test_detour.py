"""handfast.agent.control.detour: when a robot goes round what blocks it, which way, and when it is back on
the direct way."""

from __future__ import annotations

from math import hypot, inf, isfinite, nan

import pytest

from handfast.agent.control.detour import (
    AGAINST,
    CAUGHT_S,
    FREE_S,
    LEAVING,
    LET_GO_S,
    LOOSE_S,
    PATIENCE_S,
    PATIENCE_WITH_ROBOTS_S,
    ROUND_S,
    SPEED_MIN,
    TAKE_HOLD_S,
    Blocker,
    Detour,
    Hold,
)

PERIOD, RATE = 0.02, 0.6
EAST, STILL = (0.5, 0.0), (0.0, 0.0)
WALL = Blocker(-1.0, 0.0, "wall", True)
NORTH_WALL, SOUTH_WALL = Blocker(0.0, -1.0, "north", True), Blocker(0.0, 1.0, "south", True)
ROBOT = Blocker(-1.0, 0.0, "robot 7", False)


NOBODY: frozenset[int] = frozenset()
PULLS_WEST = [(3, (-0.2, 0.0)), (2, (-0.1, 0.1)), (5, (0.0, -0.1))]
BALANCED = Hold([], [], (-RATE * 0.5, 0.0), PULLS_WEST, NOBODY, ())
"""Edges that take all of what drives it east."""


def run(detour, seconds, blockers, wanted=EAST, own=STILL, place=STILL):
    """What it says after so many seconds of the same; `blockers` or all that holds it."""
    hold = blockers if isinstance(blockers, Hold) else Hold(blockers, [], STILL, [], NOBODY, ())
    given = None
    for _ in range(round(seconds / PERIOD)):
        given = detour.velocity(wanted, own, hold, place)
    return given


def blocked(blockers, wanted=EAST):
    detour = Detour(PERIOD, RATE)
    run(detour, 5.0, blockers, wanted)
    assert detour.round
    return detour


@pytest.mark.parametrize(("blocker", "patience"), [(WALL, PATIENCE_S), (ROBOT, PATIENCE_WITH_ROBOTS_S)])
def test_it_begins_after_it_has_been_held_up_for_a_while(blocker, patience):
    detour = Detour(PERIOD, RATE)
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
        detour = Detour(PERIOD, RATE)
        assert run(detour, 10.0, blockers, wanted, own) is None
        assert detour.round == ""


def test_it_is_not_held_up_for_good_if_it_gets_on_in_between():
    detour = Detour(PERIOD, RATE)
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


def test_round_a_robot_it_leaves_as_soon_as_the_direct_way_is_free():
    detour = blocked([ROBOT])
    beside = Blocker(0.0, 1.0, "robot 7", False)
    assert run(detour, FREE_S + PERIOD, [beside]) is None


DEAD, BESIDE_DEAD = WALL._replace(name="robot 7", body=True), SOUTH_WALL._replace(name="robot 7", body=True)


@pytest.mark.parametrize("other", [SOUTH_WALL, BESIDE_DEAD._replace(name="robot 8")])
def test_two_that_stand_may_be_a_trap(other: Blocker):
    detour = blocked([DEAD])
    run(detour, 1.0, [DEAD, other])
    run(detour, FREE_S + 1.0, [other])
    assert detour.round
    run(detour, 4.0, [])
    again = blocked([WALL])
    assert again.round
    run(detour, 5.0, [DEAD])  # what it met the last time does not count
    run(detour, 1.0, [DEAD, BESIDE_DEAD])
    run(detour, FREE_S + PERIOD, [BESIDE_DEAD])
    assert not detour.round


@pytest.mark.parametrize(("rightwards", "side"), [(0.0, -1.0), (0.4, -1.0), (0.9, 1.0), (-0.9, -1.0)])
def test_robots_keep_to_the_right_of_each_other_unless_one_is_well_beside(rightwards, side):
    other = Blocker(-((1.0 - rightwards**2) ** 0.5), rightwards, "robot 7", False)
    _, y = run(blocked([other]), PERIOD, [other])
    assert side * y > 0.0
    wall = other._replace(fixed=True)
    _, y = run(blocked([wall]), PERIOD, [wall])
    assert (y > 0.0) is (rightwards > 0.0)


def test_it_tries_the_sides_in_turn_for_longer_and_longer():
    detour, sides = Detour(PERIOD, RATE), []
    for _ in range(round(8.0 * ROUND_S / PERIOD)):
        given = run(detour, PERIOD, [WALL])
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
    assert run(detour, PERIOD, [WALL]) is None


@pytest.mark.parametrize("absurd", [nan, inf, 1e300])
def test_absurd_numbers_pass_through_without_harm(absurd):
    detour = blocked([WALL])
    run(detour, PERIOD, [WALL], (absurd, 0.0))
    run(detour, PERIOD, [WALL], EAST, (absurd, absurd))
    detour.reset()
    given = run(detour, 2.0, [WALL])
    assert all(isfinite(value) for value in given)


def test_robots_are_passed_as_seen_from_the_formation_and_walls_from_the_ground():
    # Its place is beside it, and both drive east; what is in between drives east as well.
    wanted, place, beside = (0.4, 0.3), (0.4, 0.0), (0.0, -1.0)
    for fixed in (False, True):
        detour = Detour(PERIOD, RATE)
        given = run(detour, 6.0, [Blocker(*beside, "it", fixed)], wanted, place, place)
        assert (detour.round == "it") is not fixed  # along a wall it gets on
        if given is not None:
            assert given[1] < 0.3
            assert abs(given[0] - 0.4) == pytest.approx(0.3, abs=0.05)


# ---------------------------------------------------------------------- wrong rest points


def test_a_robot_that_its_edges_hold_in_balance_lets_go_of_them_until_it_is_near_its_place():
    detour = Detour(PERIOD, RATE)
    run(detour, CAUGHT_S - 3 * PERIOD, BALANCED)
    assert (detour.grip, detour.held) == (1.0, "")
    run(detour, LET_GO_S + 5 * PERIOD, BALANCED)
    assert detour.grip == 0.0
    assert detour.held == "on its way out of a wrong rest point with robots 2, 3"
    run(detour, 3.0, [], own=EAST)
    assert detour.grip == 0.0
    run(detour, 0.5 * TAKE_HOLD_S, [], (0.9 * SPEED_MIN, 0.0))
    assert detour.grip == pytest.approx(0.5, abs=0.05)
    assert detour.held == ""
    run(detour, TAKE_HOLD_S, [], (0.9 * SPEED_MIN, 0.0))
    assert detour.grip == 1.0


def test_it_takes_its_edges_back_when_it_does_not_come_near_and_tries_again_for_longer():
    detour, loose = Detour(PERIOD, RATE), []
    for _ in range(round(100.0 / PERIOD)):
        run(detour, PERIOD, BALANCED)
        loose.append(detour.grip == 0.0)
    ends = [k for k in range(1, len(loose)) if loose[k] != loose[k - 1]]
    took = [(b - a) * PERIOD for a, b in zip(ends[::2], ends[1::2], strict=False)]
    assert took == pytest.approx([LOOSE_S - LET_GO_S, 2.0 * LOOSE_S - LET_GO_S], abs=0.2)


# ---------------------------------------------------------------------- what it says


def test_it_says_round_what_it_goes():
    detour = blocked([WALL])
    run(detour, PERIOD, [WALL])
    assert detour.held == "on its way round wall"
    run(detour, PERIOD, [], STILL)
    assert detour.held == ""


@pytest.mark.parametrize("ny", [1.0, -1.0])
def test_from_what_it_is_too_near_to_it_drives_away_before_it_drives_along(ny: float):
    """At most 60 degrees from straight: only that the safety filter lets it."""
    beside = Blocker(-0.6, 0.8 * ny, "robot 4", True, within=True)
    detour = blocked([beside])
    x, y = run(detour, 2.0, [beside])
    away = (beside.nx * x + beside.ny * y) / hypot(x, y)
    assert LEAVING < away < 0.8
    assert x > 0.0  # on the side to which its place is nearer
    x, y = run(detour, 2.0, [beside._replace(within=False)])
    assert abs(beside.nx * x + beside.ny * y) / hypot(x, y) < 2.0 * AGAINST
