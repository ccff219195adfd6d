"""handfast.agent.fleet.model: `[[obstacle]]`, `[geofence]`, `[avoidance]`, `[supervision]`; what does not go
together."""

from __future__ import annotations

from math import cos, pi, sin

import pytest
import tomli_w

from handfast.agent.fleet.loading import parse_fleet, to_dict
from handfast.agent.fleet.safety import CORNERS_MAX, GeofenceSection, ObstacleSection
from tests.unit.agent.fleet.fleet_texts import SMALL, problems, small

TREE = "[[obstacle]]\ncentre_m = [5, 6]\nradius_m = 0.5\n"
SHED = "[[obstacle]]\nname = 'shed'\npoints_m = [[9, 9], [10, 9], [10, 10]]\n"
FENCE = "[geofence]\npoints_m = [[-30, -30], [30, -30], [30, 30], [-30, 30]]\n"


def polygon(points: str) -> str:
    return SMALL + f"[[obstacle]]\npoints_m = {points}\n"


def meet(what: str, one: str, other: str) -> str:
    return (
        f"{what}.points_m: the sides from corner {one} and from corner {other} meet: give the corners in the "
        "order in which one walks around"
    )


def test_obstacles_and_fence_are_read_and_written() -> None:
    fleet = small(text=SMALL + TREE + SHED + FENCE)
    assert fleet.obstacles == (
        ObstacleSection(centre_m=(5.0, 6.0), radius_m=0.5),
        ObstacleSection("shed", points_m=((9.0, 9.0), (10.0, 9.0), (10.0, 10.0))),
    )
    assert fleet.geofence == GeofenceSection(((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)))
    assert parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again") == fleet


def test_any_simple_polygon_is_taken() -> None:
    comb = [(float(x), float(x % 2) * 5.0) for x in range(40)] + [(39.0, -1.0), (0.0, -1.0)]
    disc = [(cos(2 * pi * k / CORNERS_MAX), sin(2 * pi * k / CORNERS_MAX)) for k in range(CORNERS_MAX)]
    with_a_corner_on_a_side = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0)]
    for points in (comb, disc, with_a_corner_on_a_side):
        for way in (points, points[::-1], points[2:] + points[:2]):
            assert len(small(text=polygon(str([list(p) for p in way]))).obstacles) == 1


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (
            SMALL + "[[obstacle]]\nname = 'shed'\n",
            "obstacle[1]: has no shape: a circle has centre_m and radius_m, a polygon points_m: write for "
            "example centre_m = [2.0, 1.0] and radius_m = 0.4",
        ),
        (
            SMALL + TREE + "points_m = [[9, 9], [10, 9], [10, 10]]\n",
            "obstacle[1]: has centre_m and radius_m beside points_m: a circle has centre_m and radius_m, "
            "a polygon points_m: write for example centre_m = [2.0, 1.0] and radius_m = 0.4; leave one "
            "kind out",
        ),
        (
            SMALL + TREE + "[[obstacle]]\nradius_m = 0.5\n",
            "obstacle[2].centre_m: is missing: a circle, which radius_m makes it, needs it, for example "
            "centre_m = [2.0, 1.0]",
        ),
        (
            SMALL + "[[obstacle]]\ncentre_m = [1, 1]\n",
            "obstacle[1].radius_m: is missing: a circle, which centre_m makes it, needs it, for example "
            "radius_m = 0.4",
        ),
        (polygon("[[0, 0], [1, 0]]"), "obstacle[1].points_m: must have 3 to 200 corners, got 2"),
        (
            polygon(str([[k, k * k] for k in range(201)])),
            "obstacle[1].points_m: must have 3 to 200 corners, got 201",
        ),
        (
            polygon("[[0, 0], [1, 0], [1, 1], [0, 0]]"),
            "obstacle[1].points_m[4]: [0.0, 0.0] is corner 1 again: the last side closes by itself",
        ),
        (
            polygon("[[0, 0], [1, 0], [1, 0], [1, 1]]"),
            "obstacle[1].points_m[3]: [1.0, 0.0] is corner 2 again: leave it out",
        ),
        (
            polygon("[[0, 0], [1, 0], [1, 0.0001], [1, 1]]"),
            "obstacle[1].points_m[3]: [1.0, 0.0001] is nearer than 1 mm to the corner before it: leave "
            "one out",
        ),
        (
            polygon("[[0, 0], [0.1, 0.3], [0.2, 0.6]]"),
            "obstacle[1].points_m: all corners lie on one line: a polygon needs an area",
        ),
        (  # a bow tie
            polygon("[[0, 0], [1, 1], [1, 0], [0, 1]]"),
            meet("obstacle[1]", "1 to 2", "3 to 4"),
        ),
        (  # a side that goes back on the one before
            polygon("[[0, 0], [2, 0], [1, 0], [1, 1]]"),
            meet("obstacle[1]", "1 to 2", "2 to 3"),
        ),
        (  # the last side goes back on the first
            polygon("[[0, 0], [1, 0], [1, 1], [2, 0]]"),
            meet("obstacle[1]", "1 to 2", "4 to 1"),
        ),
        (  # a corner that touches a side
            polygon("[[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]]"),
            meet("obstacle[1]", "1 to 2", "3 to 4"),
        ),
        (
            SMALL + "[geofence]\npoints_m = [[0, 0], [9, 9], [9, 0], [0, 9]]\n",
            meet("geofence", "1 to 2", "3 to 4"),
        ),
        (
            SMALL + SHED + SHED,
            'obstacle[2].name: obstacle[1] has the name "shed" already: messages could mean either',
        ),
        (
            SMALL + SHED.replace("shed", "obstacle 2") + TREE,
            'obstacle[2].name: obstacle[1] has the name "obstacle 2" already: messages could mean either',
        ),
        (
            SMALL + SHED.replace("shed", "geofence"),
            'obstacle[1].name: the fence has the name "geofence" already: messages could mean either',
        ),
        (
            SMALL + SHED.replace("'shed'", '"a\\u001b[2J"'),
            'obstacle[1].name: must be up to 40 printable characters, got "a\\u001b[2J"',
        ),
        (
            SMALL + "[avoidance]\ndistance_m = 0.2\n",
            "avoidance.distance_m: 0.2 is too small: robots begin to part at this distance, which must be "
            "above formation.safe_distance_m = 0.2, that they must not come below",
        ),
        (
            SMALL + "[supervision]\ndeadman_s = 0.1\n",
            "supervision.deadman_s: must be between 0.2 and 600 s, got 0.1",
        ),
    ],
)
def test_what_does_not_go_together_is_said_once(text: str, found: str) -> None:
    assert problems(text=text) == [found]


def test_a_value_with_a_problem_of_its_own_is_not_blamed_twice() -> None:
    text = SMALL + "[[obstacle]]\ncentre_m = [1, 1]\nradius_m = -1\n"
    assert problems(text=text) == ["obstacle[1].radius_m: must be more than 0 and at most 1000000 m, got -1"]
    assert len(problems(text=polygon('[[0, 0], [1, "a"], [1, 1]]'))) == 1
    assert len(problems(text=SMALL + "[geofence]\n")) == 1
