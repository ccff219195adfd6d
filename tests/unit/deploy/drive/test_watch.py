"""What is made of the latest words of a fleet."""

from __future__ import annotations

from math import dist

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.messages.types import HandState
from deploy.drive.watch import at_once, closest
from tests.unit.deploy.synthetic_run import EPOCH_NS


def at(robot: int, x: float, y: float) -> HandState:
    return HandState.placed(robot, 1, EPOCH_NS, True, 0, (x, y, 0.0, 0.0))


@given(st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.booleans()), max_size=12))
def test_the_closest_are_any_two_of_which_one_is_heard(places: list[tuple[int, int, bool]]) -> None:
    found = closest((at(robot, 0.1 * x, 0.1 * y), silent) for robot, (x, y, silent) in enumerate(places, 1))
    distances = {
        (i + 1, j + 1): 0.1 * dist(places[i][:2], places[j][:2])
        for j in range(len(places))
        for i in range(j)
        if not (places[i][2] and places[j][2])
    }
    assert (found is None) == (not distances)
    if found is not None:
        assert found[0] == pytest.approx(min(distances.values()))
        assert distances[found[1], found[2]] == pytest.approx(found[0])


def test_who_sends_seldom_is_taken_where_it_is_by_now() -> None:
    later = at(2, 5.0, 0.0)._replace(time_ns=at(2, 5.0, 0.0).time_ns + 200_000_000)
    seldom = at(1, 0.0, 0.0)._replace(vx=0.5, vy=-1.0, next_ms=240)
    found = at_once({1: seldom, 2: later})
    assert found[1].place[:2] == (0.1, -0.2)
    assert found[2] is later
    silent = at_once({1: seldom._replace(next_ms=100), 2: later})[1]
    assert silent.place[:2] == (0.05, -0.1)  # no further than it promised
    old = at(1, 0.0, 0.0)._replace(vx=0.5)
    assert at_once({1: old, 2: later})[1] is old
