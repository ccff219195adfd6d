"""What Foxglove is given of a fleet's messages: which, how often, and each once."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from math import isclose
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.fleet.safety import GeofenceSection, ObstacleSection
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import CLASSES, Beacon, Mission, PlantState, Silent, Status
from handfast.deploy.recording.foxglove import schemas
from handfast.deploy.recording.foxglove.channels import PERIOD_NS, Channels
from handfast.deploy.recording.foxglove.schemas import (
    DIAGNOSTICS,
    EDGES,
    GROUND,
    LOG,
    PLACES,
    PLOTS,
    POSES,
    ROBOTS,
    SILENT,
    TOPICS,
)
from tests.declared_messages import messages_of
from tests.unit.deploy.recording.foxglove.derived import conforms, last, lines, of
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)

FLEET = make_fleet(*triangle(2), duration_s=1.0)
NAME = FLEET.fleet.name
S = 10**9
STILL = (*(0.0,) * 7, True, True, True, "")


def at(robot: int, x: float, y: float = 0.0, time_ns: int = EPOCH_NS, **other: Any) -> tuple[str, PlantState]:
    state = PlantState(robot, 0, time_ns, *STILL)._replace(x=x, y=y, **other)
    return key_expressions.plant_state(NAME, robot), state


def status(
    robot: int, state: str = "running", reason: str = "", time_ns: int = EPOCH_NS
) -> tuple[str, Status]:
    said = Status(robot, 0, time_ns, state, "epoch", reason, 1, 0, (), (), (), (("overruns", 3),))
    return key_expressions.status(NAME, robot), said


def test_a_drive_fills_every_topic_that_it_has_something_for() -> None:
    moving = make_fleet(*triangle(3), duration_s=1.0, velocity=(0.4, 0.1))
    shown = of(Channels(moving), messages(moving, in_formation(moving, 0.2)))
    assert set(shown) == set(TOPICS) - {GROUND, SILENT}
    assert len(shown[ROBOTS]) == 1
    for topic in (POSES, EDGES, PLOTS):
        times = [now_ns for now_ns, _ in shown[topic]]
        assert len(times) > 12
        assert all(b // PERIOD_NS > a // PERIOD_NS for a, b in pairwise(times)), topic
    assert len(shown[PLACES]) == 1  # they move with their frame
    assert len(shown[DIAGNOSTICS]) <= 3


def test_what_does_not_change_is_not_sent_again_but_for_plots() -> None:
    fleet = make_fleet(*triangle(2), duration_s=3.0)
    shown = of(Channels(fleet), messages(fleet, [standing(1, 2), standing(3, 2), standing(2, 4)]))
    first_ns = shown[PLOTS][0][0]
    for topic, values in shown.items():
        if topic == PLOTS:
            assert len([now_ns for now_ns, _ in values if now_ns > first_ns + S]) == 3, "once a second"
        elif topic != LOG:
            contents = [re.sub(r'"sec": \d+, "nsec": \d+', "", json.dumps(value)) for _, value in values]
            assert all(before != after for before, after in pairwise(contents)), topic
    assert len(shown[POSES]) == 2, "of the first that was heard, of all"
    assert len(lines(shown)) == len(set(lines(shown)))


def test_robots_stand_where_their_bodies_are_and_edges_join_hand_points() -> None:
    fleet = replace(FLEET, robots=tuple(replace(robot, hand_offset_m=0.2) for robot in FLEET.robots))
    shown = of(Channels(fleet), messages(fleet, [standing(1, 2, 0.5), standing(3, 2), standing(2, 4)]))
    first, *others = shown[POSES][-1][1]["transforms"]
    assert (first["parent_frame_id"], first["child_frame_id"]) == ("world", "robot/1")
    assert first["translation"] == {"x": 1.0, "y": 2.0, "z": 0}
    assert isclose(first["rotation"]["z"], 0.2474)  # sin(0.25)
    assert [each["child_frame_id"] for each in others] == ["robot/2", "robot/3", "formation"]
    frames = [entity["frame_id"] for entity in shown[ROBOTS][0][1]["entities"]]
    assert frames == ["robot/1", "robot/2", "robot/3"]
    points = [point for line in shown[EDGES][-1][1]["entities"][0]["lines"] for point in line["points"]]
    ends = [(point["x"], point["y"]) for point in points]
    # Those of robots that were measured a tick before are carried on by it.
    hands = {1: (1.176, 2.096), 2: (3.2, 2.0), 3: (2.2, 4.0)}
    assert ends == [pytest.approx(hands[i], abs=3e-3) for edge in fleet.formation.edges for i in edge]


def test_edges_are_those_of_the_mission_in_force() -> None:
    channels = Channels(FLEET)

    def edges(t: float) -> int:
        now_ns = EPOCH_NS + round(t * S)
        drawn = [last(channels, now_ns + robot * PERIOD_NS, *at(robot, robot * t)) for robot in (1, 2, 3)]
        return sum(len(line["points"]) // 2 for line in drawn[-1][EDGES]["entities"][0]["lines"])

    places = ((1, 0.0, 0.0), (2, 1.0, 0.0), (3, 0.0, 1.0))
    mission = Mission(
        1, EPOCH_NS, EPOCH_NS, 10**10, "", EPOCH_NS + 2 * S, S, robots=places, edges=((1, 2, 1.0),)
    )
    key = key_expressions.mission(NAME)
    assert edges(-1.0) == 3
    for sent in (mission, mission._replace(version=2, robots=((99, 0.0, 0.0),))):  # one of nobody's fleet
        relayed = sent._replace(time_ns=EPOCH_NS + 5)
        of_robot = key_expressions.relayed(NAME, 2)
        shown = of(channels, [(EPOCH_NS, key, sent), (EPOCH_NS, of_robot, relayed)])
        said = [(2, "operator", "mission: a drive of 10 s")]
        assert lines(shown) == (said if sent is mission else [])
    assert [edges(t) for t in (0.1, 2.5, 4.0)] == [3, 3, 1]


def test_edges_are_those_of_assigned_slots() -> None:
    """Robots that start in each other's slots swap them, edges and all."""
    base = make_fleet([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], [(1, 2), (2, 3)])
    robots = (replace(base.robots[0], x_m=1.0), replace(base.robots[1], x_m=0.0), base.robots[2])
    fleet = replace(base, robots=robots, formation=replace(base.formation, assign=True))
    shown = of(Channels(fleet), messages(fleet, [standing(1, 0), standing(0, 0), standing(2, 0)]))
    lines = shown[EDGES][-1][1]["entities"][0]["lines"]
    ends = [round(point["x"], 1) for line in lines for point in line["points"]]
    assert {frozenset(ends[k : k + 2]) for k in (0, 2)} == {frozenset({1.1, 0.1}), frozenset({1.1, 2.1})}


def test_poses_that_are_not_to_be_used_are_not_shown() -> None:
    channels = Channels(FLEET)
    assert POSES not in last(channels, EPOCH_NS, *at(1, 0.0, healthy=False))
    shown = last(channels, EPOCH_NS + S, *at(1, 5.0))
    assert shown[POSES]["transforms"][0]["translation"]["x"] == 5.0
    foreign = at(1, 5.0)[0], at(2, 7.0)[1]
    assert "robot/2" not in json.dumps(last(channels, EPOCH_NS + 2 * S, *foreign))
    assert not channels.feed(EPOCH_NS + 3 * S, "another/fleet", at(1, 5.0)[1])


def test_a_clock_that_is_set_back_does_not_end_the_pictures() -> None:
    channels = Channels(FLEET)
    assert POSES in last(channels, EPOCH_NS + 3600 * S, *at(1, 1.0))
    assert POSES in last(channels, EPOCH_NS, *at(1, 2.0))
    assert POSES not in last(channels, EPOCH_NS + 1, *at(1, 3.0))


def test_obstacles_and_the_fence_are_there_once() -> None:
    circle = ObstacleSection("tree", centre_m=(3.0, 4.0), radius_m=0.5)
    wall = ObstacleSection("wall", points_m=((5.0, 5.0), (6.0, 5.0), (6.0, 6.0)))
    fence = GeofenceSection(points_m=((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)))
    fleet = replace(FLEET, obstacles=(circle, wall), geofence=fence)
    shown = of(Channels(fleet), messages(fleet, in_formation(fleet)))
    ((_, ground),) = shown[GROUND]
    tree, corners, around = ground["entities"]
    assert [each["id"] for each in (tree, corners, around)] == ["obstacle tree", "obstacle wall", "geofence"]
    assert tree["cylinders"][0]["size"]["x"] == 1.0
    assert tree["cylinders"][0]["pose"]["position"]["x"] == 3.0
    assert [len(each["lines"][0]["points"]) for each in (corners, around)] == [3, 4]


def test_an_agent_that_says_nothing_is_stale_until_it_is_heard() -> None:
    channels = Channels(FLEET)
    shown = last(channels, EPOCH_NS, *status(1, "holding", "hears no neighbour"))
    (row,) = shown[DIAGNOSTICS]["status"]
    assert (row["level"], row["message"]) == (1, "holding: hears no neighbour")
    channels.feed(EPOCH_NS, *status(2))
    quiet = of(channels, ((EPOCH_NS + k * S // 10, *status(2)) for k in range(1, 31)))
    (row, _) = quiet[DIAGNOSTICS][-1][1]["status"]
    assert (row["level"], row["message"]) == (3, "not heard, was holding: hears no neighbour")
    assert lines(quiet) == [(2, "robot 2", "running"), (3, "robot 1", "not heard")][1:]
    again = of(channels, [(EPOCH_NS + 4 * S, *status(1, "holding", "hears no neighbour"))])
    assert lines(again) == [(2, "robot 1", "heard again")]
    assert again[DIAGNOSTICS][-1][1]["status"][0]["level"] == 1


def test_a_reason_that_changes_all_the_time_is_told_once_a_second() -> None:
    channels = Channels(FLEET)
    sent = ((EPOCH_NS + k * S // 10, *status(1, "holding", f"for {k}")) for k in range(30))
    shown = of(channels, sent)
    assert len(shown[DIAGNOSTICS]) == 3
    assert len(lines(shown)) == 1


def test_where_silent_robots_are_believed_to_be_is_shown_while_it_is_said() -> None:
    channels = Channels(FLEET)
    row = Silent(3, EPOCH_NS, True, 1.0, 2.0, 0.0, 0.0, 1.0, 4.0, 0.25)
    beacon = Beacon(1, 0, EPOCH_NS, True, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 1, -1, -1, (row,))
    key = key_expressions.beacon(NAME, 1)
    (entity,) = last(channels, EPOCH_NS, key, beacon)[SILENT]["entities"]
    assert [(point["x"], point["y"]) for point in entity["lines"][0]["points"]] == [(1.0, 2.0), (1.0, 4.0)]
    assert entity["cylinders"][0]["size"]["x"] == 0.5
    assert entity["texts"][0]["text"] == "3 not heard"
    (entity,) = last(channels, EPOCH_NS + S, *at(3, 1.0))[SILENT]["entities"]
    assert not entity["lines"], "its plant is heard"
    later = beacon._replace(silent=(row._replace(robot=2),))
    assert SILENT in last(channels, EPOCH_NS + 2 * S, key, later)
    (entity,) = last(channels, EPOCH_NS + 8 * S, key, beacon._replace(silent=()))[SILENT]["entities"]
    assert not entity["lines"], "nobody says so any more"


@given(st.lists(st.one_of(*map(messages_of, CLASSES)), min_size=1, max_size=6), st.data())
def test_any_message_on_any_key_gives_valid_json(sent: list[Any], data: st.DataObject) -> None:
    channels = Channels(FLEET)
    keys = sorted(channels._takes)
    for k, message in enumerate(sent):
        robot = data.draw(st.sampled_from((1, 2, 3)))
        message = message._replace(robot=robot) if "robot" in message._fields else message
        for key in data.draw(st.lists(st.sampled_from(keys), min_size=1, max_size=2)) + keys[:0]:
            for _, name, content in channels.feed(EPOCH_NS + k * S, key, message):
                assert conforms(json.loads(content), schemas.SCHEMAS[name])
