"""What is made of the latest words of a fleet."""

from __future__ import annotations

from math import dist

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.messages.types import HandState
from deploy.drive.watch import closest
from tests.unit.deploy.synthetic_run import EPOCH_NS


def at(robot: int, x: float, y: float) -> HandState:
    return HandState.placed(robot, 1, EPOCH_NS, True, 0, (x, y, 0.0, 0.0))


@given(st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), max_size=12))
def test_the_closest_are_any_two(places: list[tuple[int, int]]) -> None:
    found = closest([at(robot, 0.1 * x, 0.1 * y) for robot, (x, y) in enumerate(places, 1)])
    distances = {
        (i + 1, j + 1): 0.1 * dist(places[i], places[j]) for j in range(len(places)) for i in range(j)
    }
    assert (found is None) == (not distances)
    if found is not None:
        assert found[0] == pytest.approx(min(distances.values()))
        assert distances[found[1], found[2]] == pytest.approx(found[0])
