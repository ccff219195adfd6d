"""The scene: what is drawn, where, in which colour."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import pytest

from handfast.deploy.console.data_files import PAGE
from handfast.deploy.recording.foxglove import scene
from handfast.deploy.recording.foxglove.json_text import stamped
from handfast.deploy.recording.foxglove.moment import Body, Link, Moment
from tests.unit.deploy.synthetic_run import make_fleet, triangle

FLEET = make_fleet(*triangle(2))
SAFE_M = 0.22


def moment(hands: dict[int, tuple[float, float]], links: list[Link], **other: Any) -> Moment:
    bodies = [Body(robot, *place, 0.0, place, (0.0, 0.0), 0.0, 0, 0) for robot, place in hands.items()]
    nothing: Moment = Moment(bodies, hands, links, (10.0, 20.0), {}, {}, 0.25, {}, None, {}, {})
    return nothing._replace(**other)


def read(content: str) -> Any:
    return json.loads(stamped(content, 5))


def lines(content: str, entity: int = 0) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = read(content)["entities"][entity]["lines"]
    return found


@pytest.mark.parametrize(
    ("distance", "error", "color"),
    [
        (1.0, "holds", "#009e73"),
        (1.049, "holds", "#009e73"),
        (1.06, "too long", "#e69f00"),
        (0.94, "too short", "#cc79a7"),
        (0.21, "unsafe", "#d55e00"),
    ],
)
def test_edges_have_the_colour_of_their_error(distance: float, error: str, color: str) -> None:
    link = Link(1, 2, distance, 1.0, True)
    assert scene.error_of(link, SAFE_M) == error
    (line,) = lines(scene.edges(moment({1: (0.0, 0.0), 2: (distance, 0.0)}, [link]), SAFE_M))
    drawn = "#" + "".join(f"{round(line['color'][each] * 255):02x}" for each in "rgb")
    assert drawn == color
    assert line["type"] == 2  # pairs of points


def test_an_edge_of_no_length_within_a_change_of_mission_is_drawn() -> None:
    assert scene.error_of(Link(1, 2, 0.5, 0.0, False), SAFE_M) == "too long"


def test_colours_are_those_of_the_page_where_it_has_them() -> None:
    found = re.search(r"COLORS = \{([^}]*)\}", (PAGE / "drawing.js").read_text())
    assert found
    page = dict(re.findall(r'(\w+): "(#\w+)"', found[1]))
    ours = scene.EDGE_COLORS
    assert (ours["holds"], ours["too long"], ours["unsafe"]) == (page["holds"], page["off"], page["bad"])
    assert len(set(ours.values())) == 4


def test_robots_that_are_not_at_their_places_have_a_line_to_them() -> None:
    hands = {1: (10.0, 20.0), 2: (12.0, 20.0)}
    off = moment(hands, [], places={1: (0.1, 0.0), 2: (1.0, 0.0)}, place_errors={1: 0.1, 2: 1.0})
    (line,) = lines(scene.edges(off, SAFE_M), 1)
    assert [(point["x"], point["y"]) for point in line["points"]] == [(12.0, 20.0), (11.0, 20.0)]


def test_places_are_crosses_in_a_frame_that_moves_with_the_formation() -> None:
    here = moment({1: (0.0, 0.0)}, [], places={1: (0.5, 0.0)})
    (entity,) = read(scene.places(here, 0.2))["entities"]
    assert entity["frame_id"] == "formation"
    points = entity["lines"][0]["points"]
    assert len(points) == 4
    assert [sum(point[each] for point in points) / 4 for each in "xy"] == [pytest.approx(0.5), 0.0]
    frames = {each["child_frame_id"]: each["translation"] for each in read(scene.poses(here))["transforms"]}
    assert frames["formation"] == {"x": 10.0, "y": 20.0, "z": 0}
    nowhere = moment({1: (0.0, 0.0)}, [])
    assert not lines(scene.places(nowhere, 0.2))
    assert len(read(scene.poses(nowhere))["transforms"]) == 1


def test_discs_of_robots_at_the_safe_distance_touch() -> None:
    """Each about its hand point, half the safe distance wide to every side; also behind the body."""
    robots = (replace(FLEET.robots[0], hand_offset_m=-0.3), *FLEET.robots[1:])
    entities = read(scene.robots(replace(FLEET, robots=robots)))["entities"]
    discs = [entity["cylinders"][1] for entity in entities]
    assert [disc["pose"]["position"]["x"] for disc in discs] == [-0.3, 0.1, 0.1]
    assert {disc["size"]["x"] for disc in discs} == {SAFE_M}
    assert [entity["arrows"][0]["pose"]["orientation"]["z"] for entity in entities] == [1.0, 0.0, 0.0]
    assert [entity["texts"][0]["text"] for entity in entities] == ["1", "2", "3"]


def test_a_field_without_obstacles_has_no_ground() -> None:
    assert scene.ground(FLEET) is None
