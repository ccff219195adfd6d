"""The fleet at one moment: whose word counts for where a body is, and what is between two."""

from __future__ import annotations

from itertools import combinations
from math import dist, hypot, pi
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.messages.types import HandState, Mission, PlantState
from handfast.deploy.recording.foxglove.moment import Latest, _distances
from tests.unit.deploy.synthetic_run import EPOCH_NS, make_fleet, triangle

FLEET = make_fleet(*triangle(2))
S = 10**9
SAFE_M = 0.22


def plant(robot: int, x: float, y: float = 0.0, heading: float = 0.0, **other: Any) -> PlantState:
    still = (0.0, 0.0, 0.0, 0.0, True, True, True, "")
    return PlantState(robot, 0, EPOCH_NS, x, y, heading, *still)._replace(**other)


def hand(robot: int, x: float, y: float, vx: float, vy: float, time_ns: int = EPOCH_NS) -> HandState:
    return HandState.placed(robot, 0, time_ns, True, 2, (x, y, vx, vy))


def test_a_plants_pose_counts_before_an_agents_and_the_truth_before_both() -> None:
    latest = Latest(FLEET)
    latest.take_hand(EPOCH_NS, hand(1, 7.0, 0.0, 0.0, 0.0))
    assert latest.at(EPOCH_NS).hands == {1: (7.0, 0.0)}
    latest.take_plant(EPOCH_NS, plant(1, 5.0, heading=pi / 2))
    assert latest.at(EPOCH_NS).hands[1] == pytest.approx((5.0, 0.1))
    latest.take_truth(EPOCH_NS, plant(1, 4.0))
    assert latest.at(EPOCH_NS).hands[1] == pytest.approx((4.1, 0.0))


def test_hand_points_are_carried_on_to_one_time() -> None:
    latest = Latest(FLEET)
    latest.take_plant(EPOCH_NS, plant(1, 0.0, speed=2.0, yaw_rate=1.0))
    latest.take_plant(EPOCH_NS, plant(2, 5.0, time_ns=EPOCH_NS + S // 10))
    latest.take_plant(EPOCH_NS, plant(3, 9.0, speed=2.0, time_ns=EPOCH_NS - 10 * S))  # its clock is off
    hands = latest.at(EPOCH_NS).hands
    assert hands == {1: pytest.approx((0.3, 0.01)), 2: (5.1, 0.0), 3: (9.1, 0.0)}


def test_errors_of_edges_and_places() -> None:
    latest = Latest(FLEET)
    for robot, place in ((1, (0.0, 0.0)), (2, (-0.5, 0.866)), (3, (1.0, 0.866))):
        latest.take_plant(EPOCH_NS, plant(robot, place[0] - 0.1, place[1]))
    moment = latest.at(EPOCH_NS)
    assert {(link.i, link.j): round(link.distance - link.wanted, 3) for link in moment.links} == {
        (1, 2): 0.0, (1, 3): 0.323, (2, 3): 0.5,
    }  # fmt: skip
    assert moment.place_errors == {1: 0.0, 2: pytest.approx(0.0, abs=1e-3), 3: pytest.approx(0.5, abs=1e-3)}
    assert moment.at_place == pytest.approx(0.25)
    assert moment.least == (pytest.approx(1.0, abs=1e-3), 1, 2)


def test_a_body_that_was_carried_off_is_near_to_nobody_until_it_is_heard() -> None:
    latest = Latest(FLEET)
    for robot in (1, 2):
        latest.take_plant(EPOCH_NS, plant(robot, 0.1 * robot))
    assert latest.at(EPOCH_NS).close == {(1, 2): pytest.approx(0.1)}
    latest.take_mission(Mission(1, EPOCH_NS, EPOCH_NS, 10 * S, "", removed=((2, EPOCH_NS),)))
    moment = latest.at(EPOCH_NS)
    assert (set(moment.hands), moment.close, len(moment.bodies)) == ({1}, {}, 2)
    latest.take_plant(EPOCH_NS + 1, plant(2, 0.2, time_ns=EPOCH_NS + 1))
    assert latest.at(EPOCH_NS + 1).close


places = st.tuples(st.floats(-3, 3), st.floats(-3, 3))


@given(st.lists(st.tuples(places, st.booleans()), max_size=12))
def test_distances_are_those_of_all_pairs(given_: list[tuple[tuple[float, float], bool]]) -> None:
    hands = {k: place for k, (place, _) in enumerate(given_)}
    heard = {k for k, (_, is_heard) in enumerate(given_) if is_heard}
    pairs = {
        (i, j): hypot(hands[i][0] - hands[j][0], hands[i][1] - hands[j][1])
        for i, j in combinations(hands, 2)
        if i in heard or j in heard
    }
    nearest, least, close = _distances(hands, heard, SAFE_M)
    assert nearest == {
        robot: pytest.approx(min(d for pair, d in pairs.items() if robot in pair))
        for robot in hands
        if any(robot in pair for pair in pairs)
    }
    assert close == {pair: pytest.approx(d) for pair, d in pairs.items() if d < SAFE_M}
    assert (least is None) == (not pairs)
    if least is not None:
        assert least[0] == pytest.approx(min(pairs.values()))
        assert dist(hands[least[1]], hands[least[2]]) == pytest.approx(least[0])
