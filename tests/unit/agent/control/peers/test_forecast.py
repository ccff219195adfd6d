"""Where a robot goes from a message on: step by step, to its place, and along its reference to the end."""

from __future__ import annotations

from math import dist, hypot

import pytest

from handfast.agent.control.peers.forecast import DRIVEN_MAX, STEP_S, Forecast
from handfast.agent.control.peers.prediction import coasting
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import plan_of
from handfast.agent.formation.reference import Reference
from handfast.agent.messages.types import HandState, Mission

FLEET = """
robot = [
  { id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 5, y_m = 5 }, { id = 3, x_m = 0, y_m = 5, reserve = true },
]
fleet = { name = "pair" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [0, 2]], safe_distance_m = 0.2 }
trajectory = { kind = "waypoints", waypoints_m = [[0, 0], [10, 0], [10, 10]], speed_mps = 0.5 }
"""
S = 1_000_000_000
T0 = 1000 * S


def scene() -> tuple[Forecast, Reference]:
    fleet = parse_fleet(FLEET, source="here")
    geometry = resolve(fleet)
    reference = Reference(fleet, geometry)
    reference.take(plan_of(Mission(1, 0, T0, 60 * S, ""), fleet, geometry))
    forecast = Forecast(0.4, 0.9, reference.instant, 0.5, 1.0, 3.0)
    forecast.epoch_ns = T0
    return forecast, reference


def at(x: float, y: float, robot: int = 2, speed: float = 0.0, follows: bool = True) -> HandState:
    return HandState.placed(robot, 0, T0, follows, 0, (x, y, speed, 0.0))


@pytest.mark.parametrize("x", [-6.0, -0.5, 0.0])
@pytest.mark.parametrize("robot", [2, 3], ids=["with a place", "in reserve"])
@pytest.mark.parametrize("since_s", [-0.25, 0.0, 3.0], ids=["before the epoch", "at it", "in the drive"])
def test_its_way_is_made_of_the_steps_of_which_each_prediction_is(x: float, robot: int, since_s: float):
    forecast, _ = scene()
    said = HandState.placed(robot, 0, T0 + round(since_s * S), True, 0, (x, 1.0, 0.3, -0.2))
    message = said = said._replace(constraint_x=0.4, correction_y=-0.3)
    points, step_ns = [(message.x, message.y)], round(STEP_S * S)
    for _ in range(40):
        then_ns = message.time_ns + step_ns
        found = forecast.following(message, then_ns) or coasting(message, STEP_S)
        points.append(found.position)
        place = *found.position, *found.velocity
        message = HandState.placed(robot, 0, then_ns, True, 0, place)
    assert forecast.stood(said, 40 * STEP_S).way == tuple(points)


@pytest.mark.parametrize("x", [-6.0, -0.5])
@pytest.mark.parametrize("since_s", [-0.25, 0.0, 3.0, 19.5], ids=["early", "epoch", "driving", "new place"])
def test_its_course_is_what_it_is_predicted_by_at_each_time(x: float, since_s: float):
    """Also of one that gets its place only after its message, and of a time before it."""
    forecast, reference = scene()
    fleet = parse_fleet(FLEET, source="here")
    joins = Mission(
        2, 0, T0, 60 * S, "", T0 + 20 * S, 2 * S, robots=((1, 0.0, 0.0), (2, 0.0, 2.0), (3, 2.0, 0.0))
    )
    reference.take(plan_of(joins, fleet, resolve(fleet)))
    for robot in (2, 3):
        said = HandState.placed(robot, 0, T0 + round(since_s * S), True, 0, (x, 1.0, 0.3, -0.2))
        said = said._replace(constraint_x=0.4, correction_y=-0.3)
        course = forecast.course(said)
        for after_s in (-0.5, 0.0, 0.1, 1.0, 3.0):
            then_ns = said.time_ns + round(after_s * S)
            expected, instant = forecast.following(said, then_ns), reference.instant(then_ns)
            assert (expected is not None) == (robot in instant.offsets)
            if expected is not None:
                found = forecast.on(course, then_ns, instant)
                for part in ("position", "velocity", "navigation", "constraint"):
                    assert getattr(found, part) == getattr(expected, part)


def test_a_robot_far_from_its_place_does_not_go_beyond_it():
    """In one step the pull at the start would carry it through."""
    forecast, reference = scene()
    belief = forecast.stood(at(-6.0, 2.0), 20.0)
    place = reference.motion(2, T0 + 20 * S)
    assert max(each.end[0] for each in belief.stretches) < place[0] + 0.5
    assert dist(belief.stretches[-1].end, place[:2]) < 2.5


def test_the_lane_goes_to_the_place_and_on_along_all_corners_to_the_end_of_the_mission():
    forecast, reference = scene()
    lane = forecast.lane(at(-3.0, -3.0), reference)
    for t in (20, 25, 30, 35, 41, 45, 60):
        assert lane.distance(*reference.motion(2, T0 + t * S)[:2]) < 0.1
    assert lane.distance(-3.0, -3.0) == 0.0
    assert lane.distance(10.0, 12.0) < 0.01
    assert lane.distance(10.0, 14.0) > 1.9  # it ends there
    assert lane.distance(0.0, -3.0) > 1.0


def test_who_has_no_place_stands_and_one_that_brakes_rolls_out():
    forecast, reference = scene()
    assert forecast.lane(at(1.0, 1.0, robot=3), reference).distance(4.0, 5.0) == pytest.approx(5.0)
    (there,) = forecast.stood(at(1.0, 1.0, robot=3), 3.0).stretches
    assert hypot(there.dx, there.dy) + there.radius < 0.01
    moving = forecast.stood(at(1.0, 1.0, robot=3, speed=0.4, follows=False), 3.0)
    assert moving.stretches[-1].radius >= 0.4
    fast = forecast.stood(at(1.0, 1.0, robot=3, speed=9.0, follows=False), 3.0)
    assert DRIVEN_MAX <= fast.stretches[0].radius < DRIVEN_MAX + 0.5


def test_before_the_epoch_nobody_sets_out():
    forecast, _ = scene()
    waits = at(-6.0, 2.0)._replace(time_ns=T0 - 10 * S)
    (there,) = forecast.stood(waits, 5.0).stretches
    assert there.end == pytest.approx((-6.0, 2.0), abs=0.01)
