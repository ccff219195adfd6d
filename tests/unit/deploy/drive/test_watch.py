"""What is made of the latest words of a fleet."""

from __future__ import annotations

from math import dist

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import CheckLine, Checks, HandState, PlantState, Stop
from handfast.deploy.drive.news import ORDERED, Happening
from handfast.deploy.drive.readiness import Line
from handfast.deploy.drive.watch import PLANT_SILENT_NS, Watch, at_once, closest, nearest_of_each
from tests.unit.deploy.orders.order_fleets import EPOCH, after, first_plan, order, square
from tests.unit.deploy.synthetic_run import EPOCH_NS, make_fleet


def at(robot: int, x: float, y: float) -> HandState:
    return HandState.placed(robot, 1, EPOCH_NS, True, 0, (x, y, 0.0, 0.0))


@given(st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.booleans()), max_size=12))
def test_the_nearest_are_any_two_of_which_one_is_heard(places: list[tuple[int, int, bool]]) -> None:
    hands = {robot: at(robot, 0.1 * x, 0.1 * y) for robot, (x, y, _) in enumerate(places, 1)}
    silent = {robot for robot, (_, _, is_silent) in enumerate(places, 1) if is_silent}
    found = nearest_of_each(hands, silent)
    distances = {
        (i, j): dist(hands[i].place[:2], hands[j].place[:2])
        for i in hands
        for j in hands
        if i != j and not {i, j} <= silent
    }
    assert found.keys() == {i for i, _ in distances}
    for robot, (distance, other) in found.items():
        assert distance == pytest.approx(min(d for (i, _), d in distances.items() if i == robot))
        assert distances[robot, other] == pytest.approx(distance)
    pair = closest(found)
    assert (pair is None) == (not distances)
    if pair is not None:
        assert pair[0] == pytest.approx(min(distances.values()))
        assert distances[pair[1], pair[2]] == pytest.approx(pair[0])
        assert pair[1] < pair[2]


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


def test_places_and_edges_are_those_of_the_mission_then() -> None:
    """Of the robots that have a place, on the way of the formation."""
    fleet = square()
    watch = Watch(fleet, resolve(fleet))
    assert watch.place(2, None) == pytest.approx((6.0, 6.0))  # where the formation will begin
    plan = first_plan(fleet)
    watch.feed(key_expressions.mission("square"), plan.mission)
    assert watch.place(2, 10.0) == pytest.approx((6.0 + 3.0, 6.0 + 1.0))
    assert watch.place(7, 10.0) is None
    assert {edge.other: edge.distance for edge in watch.edges(2, 10.0)} == {1: 1.0, 3: 1.0}
    assert watch.edges(7, 10.0) == ()
    left, _ = after(order("leave", robot=3), plan, fleet, at_s=20.0)
    watch.feed(key_expressions.mission("square"), left)
    assert watch.place(3, 15.0) is not None
    assert watch.place(3, 30.0) is None
    assert [edge.other for edge in watch.edges(2, 15.0)] == [1, 3]
    assert [edge.other for edge in watch.edges(2, 30.0)] == [1]


def test_what_happened_is_told_once() -> None:
    fleet = square()
    watch = Watch(fleet, resolve(fleet))
    watch.feed(key_expressions.stop("square"), Stop(3, EPOCH, "a person"))
    watch.feed(key_expressions.relayed("square", 1), Stop(3, EPOCH, "a person"))
    assert watch.happenings(1.0) == [
        Happening(ORDERED, "every robot is told to stop: a person", time_ns=EPOCH)
    ]
    assert watch.happenings(1.0) == []
    assert watch.news(1.0) == []


FLEET = make_fleet([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], [(1, 2), (2, 3)])
NAME = FLEET.fleet.name


def measured(robot: int, speed: float, after_ns: int = 0, *, healthy: bool = True) -> PlantState:
    return PlantState(
        robot, 1, EPOCH_NS + after_ns, 0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0, True, healthy, True, ""
    )


def test_each_robot_has_its_speed_as_long_as_its_plant_says_so() -> None:
    watch = Watch(FLEET, resolve(FLEET))

    def speeds() -> list[float | None]:
        return [about.speed for about in watch.picture(1.0).robots.values()]

    assert speeds() == [None, None, None]
    for robot in (1, 2):
        watch.feed(key_expressions.plant_state(NAME, robot), measured(robot, -0.25 * robot))
    assert speeds() == [-0.25, -0.5, None]
    watch.feed(key_expressions.plant_truth(NAME, 1), measured(1, 9.0, 1))
    watch.feed(key_expressions.plant_state(NAME, 2), measured(1, 9.0, 1))
    assert speeds() == [-0.25, -0.5, None], "neither is what its plant measures"
    watch.feed(key_expressions.plant_state(NAME, 3), measured(3, 0.1, PLANT_SILENT_NS))
    assert speeds() == [-0.25, -0.5, 0.1]
    watch.feed(key_expressions.plant_state(NAME, 3), measured(3, 0.2, PLANT_SILENT_NS + 1))
    assert speeds() == [None, None, 0.2], "the others' plants have said nothing since"
    watch.feed(key_expressions.plant_state(NAME, 3), measured(3, 0.2, PLANT_SILENT_NS + 2, healthy=False))
    assert speeds() == [None, None, None]


def test_a_battery_is_the_last_that_its_own_plant_said_of_it() -> None:
    watch = Watch(FLEET, resolve(FLEET))
    full, empty = ("battery", "ok", "12.6 V, 99 %", ""), ("battery", "warning", "11.0 V, 20 %", "charge it")
    mode = CheckLine("mode", "ok", "GUIDED", "")
    key = key_expressions.checks(NAME, 2)
    watch.feed(key, Checks(2, 1, EPOCH_NS, (mode, CheckLine(*full))))
    watch.feed(key, Checks(2, 2, EPOCH_NS + 1, (mode, CheckLine(*empty))))
    watch.feed(key, Checks(3, 3, EPOCH_NS + 2, (CheckLine(*full),)))
    watch.feed(key, Checks(2, 4, EPOCH_NS + 3, (mode,)))
    batteries = [about.battery for about in watch.picture(1.0).robots.values()]
    assert batteries == [None, Line(*empty), None]


def test_of_a_robot_that_is_silent_nobody_says_how_near_or_fast_it_is() -> None:
    watch = Watch(FLEET, resolve(FLEET))
    for robot in FLEET.ids:
        watch.feed(key_expressions.plant_state(NAME, robot), measured(robot, 0.5))
        watch.feed(key_expressions.hand(NAME, robot), at(robot, 0.25 * robot, 0.0))
    watch.picture(0.0)
    watch.feed(key_expressions.hand(NAME, 1), at(1, 0.25, 0.0)._replace(time_ns=EPOCH_NS + 10**9))
    picture = watch.picture(5.0)
    assert [about.state for about in picture.robots.values()] == ["", "silent", "silent"]
    assert [about.nearest for about in picture.robots.values()] == [(0.25, 2), None, None]
    assert [about.speed for about in picture.robots.values()] == [0.5, None, None]
