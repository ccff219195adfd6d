"""Where robots are is what is heard of them last; what is not heard is not shown."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, isnan, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.sequence_numbers import FIRST_ROUND
from handfast.agent.messages.types import Distance, HandState, Mission, Place, PlantState, Status
from handfast.deploy.drive.watch import Watch
from handfast.deploy.orders.mission_editing import first_mission
from handfast.deploy.playback.track import COLUMNS
from handfast.deploy.view.motion import PLACE_DIGITS, SILENT_NS, Motion
from tests.unit.deploy.orders.order_fleets import EPOCH, S, after, first_plan, order
from tests.unit.deploy.view.running import FLEET, NAME, START

AT = {name: index for index, name in enumerate(COLUMNS)}
OF_BODY = ("x", "y", "heading", "speed")
OF_AGENT = ("age_ms", "tick_us", "navigation_x", "navigation_y", "constraint_x", "constraint_y")
INDEX = {robot: index for index, robot in enumerate(FLEET.ids)}
STATE, TRUTH = key_expressions.plant_state, key_expressions.plant_truth


def motion(fleet: Fleet = FLEET) -> tuple[Motion, Watch]:
    watch = Watch(fleet, resolve(fleet))
    return Motion(fleet, watch), watch


def body(robot: int, x: float, y: float, heading: float = 0.0, *, healthy: bool = True) -> PlantState:
    return PlantState(
        *(robot, FIRST_ROUND, START, x, y, heading, 0.25, 0.0, 0.0, 0.0), True, healthy, True, ""
    )


def status(robot: int, ages_us: tuple[int, ...], tick_us: tuple[int, ...]) -> Status:
    return Status(robot, 1, START, "running", "", "", 1, 0, (), tick_us, ages_us, ())


def hand(robot: int) -> HandState:
    made = HandState.placed(robot, FIRST_ROUND, START, True, 0, (0.0,) * 4)
    return made._replace(navigation_x=1.0, navigation_y=2.0, constraint_x=3.0, constraint_y=4.0)


def seen(shown: Motion, robot: int, *names: str, now_ns: int = START) -> list[float]:
    row = shown.look(now_ns, None)[INDEX[robot]]
    return [float(row[AT[name]]) for name in names]


@pytest.mark.parametrize("offset_m", [0.3, 0.0, -0.25])
def test_the_hand_point_is_ahead_of_the_axle_or_behind_it(offset_m: float) -> None:
    robots = tuple(replace(robot, hand_offset_m=offset_m) for robot in FLEET.robots)
    shown, _ = motion(replace(FLEET, robots=robots))
    heading = pi / 6
    shown.feed(START, STATE(NAME, 3), body(3, 2.0, 1.0, heading))
    x, y = 2.0 + offset_m * cos(heading), 1.0 + offset_m * sin(heading)
    assert seen(shown, 3, *OF_BODY) == pytest.approx([x, y, heading, 0.25])
    assert all(map(isnan, seen(shown, 4, *OF_BODY)))


def test_where_a_body_really_is_counts_more_than_what_it_measures() -> None:
    shown, _ = motion(replace(FLEET, robots=tuple(replace(each, hand_offset_m=0.0) for each in FLEET.robots)))
    shown.feed(START, STATE(NAME, 1), body(1, 1.0, 0.0))
    assert seen(shown, 1, "x") == [1.0]
    shown.feed(START, TRUTH(NAME, 1), body(1, 1.5, 0.0))
    shown.feed(START, STATE(NAME, 1), body(1, 1.1, 0.0))
    shown.feed(START, STATE(NAME, 2), body(2, 9.0, 0.0))
    assert seen(shown, 1, "x") == [1.5]
    assert seen(shown, 2, "x") == [9.0]


def test_a_measurement_that_must_not_be_used_is_not_shown() -> None:
    shown, _ = motion()
    shown.feed(START, STATE(NAME, 1), body(1, 1.0, 0.0, healthy=False))
    assert all(map(isnan, seen(shown, 1, *OF_BODY)))


def test_what_is_not_its_sender_s_is_not_shown() -> None:
    shown, _ = motion()
    shown.feed(START, STATE(NAME, 1), body(2, 1.0, 0.0))
    shown.feed(START, key_expressions.hand(NAME, 1), hand(2))
    shown.feed(START, key_expressions.status(NAME, 1), status(2, (5,), (5,)))
    shown.feed(START, STATE(NAME, 99), body(99, 1.0, 0.0))
    shown.feed(START, key_expressions.hand(NAME, 99), hand(99))
    rows = np.delete(shown.look(START, None), [AT["place_x"], AT["place_y"]], axis=1)
    assert np.isnan(rows).all()


def test_a_body_that_is_silent_is_nowhere() -> None:
    shown, _ = motion()
    shown.feed(START, STATE(NAME, 1), body(1, 1.0, 0.0))
    shown.feed(START, key_expressions.hand(NAME, 1), hand(1))
    assert not any(map(isnan, seen(shown, 1, *OF_BODY, now_ns=START + SILENT_NS)))
    shown.feed(START + SILENT_NS, key_expressions.hand(NAME, 1), hand(1))
    assert all(map(isnan, seen(shown, 1, *OF_BODY, now_ns=START + SILENT_NS + 1)))
    assert seen(shown, 1, "navigation_x", now_ns=START + SILENT_NS + 1) == [1.0]  # its agent is heard
    shown.feed(START + 2 * SILENT_NS, STATE(NAME, 1), body(1, 3.0, 0.0))
    assert not any(map(isnan, seen(shown, 1, *OF_BODY, now_ns=START + 2 * SILENT_NS)))


def test_what_a_silent_agent_said_is_not_so_any_more() -> None:
    shown, _ = motion()
    shown.feed(START, STATE(NAME, 1), body(1, 1.0, 0.0))
    shown.feed(START, key_expressions.hand(NAME, 1), hand(1))
    shown.feed(START, key_expressions.status(NAME, 1), status(1, (2_000, 31_000), (150, 90)))
    now_ns = START + SILENT_NS
    assert seen(shown, 1, *OF_AGENT, now_ns=now_ns) == [31.0, 150.0, 1.0, 2.0, 3.0, 4.0]
    shown.feed(now_ns, STATE(NAME, 1), body(1, 1.0, 0.0))
    assert all(map(isnan, seen(shown, 1, *OF_AGENT, now_ns=now_ns + 1)))
    assert not any(map(isnan, seen(shown, 1, *OF_BODY, now_ns=now_ns + 1)))


def test_no_ages_and_no_ticks_are_no_numbers() -> None:
    shown, _ = motion()
    key = key_expressions.status(NAME, 1)
    shown.feed(START, key, status(1, (2_000,), (150,)))
    shown.feed(START, key, status(1, (), ()))
    assert all(map(isnan, seen(shown, 1, "age_ms", "tick_us")))


def test_of_one_to_whom_there_is_no_connection_nothing_is_known() -> None:
    shown, _ = motion()
    for robot in (1, 2):
        shown.feed(START, STATE(NAME, robot), body(robot, 1.0, 0.0))
        shown.feed(START, key_expressions.hand(NAME, robot), hand(robot))
    shown.forget(1)
    assert all(map(isnan, seen(shown, 1, *OF_BODY, "navigation_x")))
    assert not any(map(isnan, seen(shown, 2, *OF_BODY, "navigation_x")))


@given(
    st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6), st.booleans()), min_size=6, max_size=6),
    st.integers(1, 40),
)
def test_pairs_that_are_near(places: list[tuple[int, int, bool]], tenths: int) -> None:
    fleet = replace(FLEET, robots=tuple(replace(each, hand_offset_m=0.0) for each in FLEET.robots))
    shown, _ = motion(fleet)
    at = {}
    for robot, (x, y, is_heard) in zip(FLEET.ids, places, strict=True):
        if is_heard:
            at[robot] = 0.25 * x, 0.25 * y
            shown.feed(START, STATE(NAME, robot), body(robot, *at[robot]))
    limit_m = tenths / 10
    shown.look(START, None)
    found = {(i, j): apart for apart, i, j in shown.near(limit_m)}
    wanted = {(i, j): hypot(at[i][0] - at[j][0], at[i][1] - at[j][1]) for i in at for j in at if i < j}
    assert found == {pair: pytest.approx(apart) for pair, apart in wanted.items() if apart < limit_m}


def told(watch: Watch, mission: Mission) -> None:
    watch.feed(key_expressions.mission(NAME), mission)


def test_places_are_those_of_the_mission() -> None:
    shown, watch = motion()
    row = shown.look(START, None)[INDEX[1]]
    told(watch, first_mission(FLEET, 1, EPOCH - 2 * S, EPOCH, 60 * S))
    row = shown.look(START, 10.0)[INDEX[3]]
    assert row[[AT["place_x"], AT["place_y"]]] == pytest.approx([5.0 + 3.0 + 1.0, 6.0 + 1.0 + 1.0])
    assert np.isnan(shown.look(START, 10.0)[INDEX[7], [AT["place_x"], AT["place_y"]]]).all()
    assert np.isnan(row[AT["x"]])  # where it should be is not where it is


def test_edges_are_those_of_the_plan_each_once() -> None:
    shown, watch = motion()
    plan = first_plan(FLEET)
    told(watch, plan.mission)
    places = [[INDEX[i], INDEX[j], round(apart, PLACE_DIGITS)] for (i, j), apart in plan.edges.items()]
    assert sorted(shown.edges(10.0)) == sorted(places)
    assert [0, 2, 1.414] in places
    left, _ = after(order("leave", robot=3), plan, FLEET, at_s=20.0)
    told(watch, left)
    assert sorted(shown.edges(10.0)) == sorted(places)  # not yet
    assert {(i, j) for i, j, _ in shown.edges(30.0)} == {(0, 1), (0, 3)}


def test_a_new_edge_comes_with_its_plan() -> None:
    shown, watch = motion()
    plan = first_plan(FLEET)
    told(watch, plan.mission)
    more = plan.mission._replace(
        version=2,
        from_ns=EPOCH + 20 * S,
        blend_ns=10 * S,
        robots=tuple(Place(robot, *plan.offsets[robot]) for robot in plan.members),
        edges=tuple(Distance(i, j, apart) for (i, j), apart in [*plan.edges.items(), ((2, 4), 2**0.5)]),
    )
    told(watch, more)
    pairs = {(i, j) for i, j, _ in shown.edges(19.0)}
    assert (INDEX[2], INDEX[4]) not in pairs
    assert (INDEX[2], INDEX[4]) in {(i, j) for i, j, _ in shown.edges(31.0)}
