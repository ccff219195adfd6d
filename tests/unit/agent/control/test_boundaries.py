"""handfast.agent.control.boundaries: what a point feels of circles, corners, notches, bends and fences."""

from __future__ import annotations

from math import hypot, inf, isclose, sqrt

import numpy as np
import pytest

from handfast.agent.control.boundaries import Circle, Near, Polygon, fence_of, obstacles_of
from handfast.deploy.analysis.shapes import distances
from tests.unit.agent.fleet.fleet_texts import SMALL, small

BOX = ((0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (0.0, 2.0))
L_SHAPE = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 4.0), (0.0, 4.0))
V_SHAPE = ((0.0, 0.0), (3.0, 5.0), (2.6, 5.0), (0.0, 0.6), (-2.6, 5.0), (-3.0, 5.0))


def rounded(felt: list[Near]) -> list[tuple[float, float, float]]:
    return [(round(near.distance, 9), round(near.nx, 9) + 0.0, round(near.ny, 9) + 0.0) for near in felt]


# --- circles ---


def test_a_circle_is_felt_from_outside_and_from_inside() -> None:
    tree = Circle("tree", 1.0, 2.0, 0.5)
    assert tree.near(1.0, 4.0, 2.0) == [Near("tree", 1.5, 0.0, 1.0)]
    assert tree.near(0.8, 2.0, 0.1) == [Near("tree", pytest.approx(-0.3), -1.0, 0.0)]


def test_what_is_as_far_as_the_limit_or_further_is_not_felt() -> None:
    tree = Circle("tree", 0.0, 0.0, 0.5)
    assert tree.near(2.0, 0.0, 1.5) == []
    assert Polygon("box", BOX).near(5.0, 1.0, 1.0) == []
    assert Polygon("box", BOX).near(5.0, 2.5, 1.1) == []  # within the circle about it, and yet too far
    assert Polygon("fence", BOX, inside=True).near(2.0, 1.0, 1.0) == []
    assert len(Polygon("fence", BOX, inside=True).near(2.0, 1.0, 1.01)) == 2


# --- polygons ---


@pytest.mark.parametrize("points", [BOX, BOX[::-1]])
def test_a_side_is_felt_straight_and_a_corner_once(points) -> None:
    box = Polygon("box", points)
    assert rounded(box.near(2.0, -0.5, 9.0)) == [(0.5, 0.0, -1.0)]  # and not the far side, through the box
    assert rounded(box.near(-3.0, -4.0, 9.0)) == [(5.0, -0.6, -0.8)]
    assert rounded(box.near(2.0, 0.5, 9.0)) == [(-0.5, 0.0, -1.0)]  # inside: the nearest way out, only


def test_in_a_notch_both_walls_are_felt() -> None:
    corner = Polygon("corner", L_SHAPE)
    assert rounded(corner.near(1.3, 1.2, 1.0)) == [(0.2, 0.0, 1.0), (0.3, 1.0, 0.0)]
    assert rounded(corner.near(1.3, 1.2, 0.25)) == [(0.2, 0.0, 1.0)]


def test_what_the_obstacle_itself_hides_is_not_felt() -> None:
    funnel = Polygon("funnel", V_SHAPE)
    outside, between = funnel.near(-3.0, 3.0, inf), funnel.near(0.0, 3.0, inf)
    assert len(outside) == 1
    assert outside[0].nx < 0.0
    across = 4.4 / hypot(4.4, 2.6)
    assert sorted(near.nx for near in between) == pytest.approx([-across, across])


RAMP = ((0.0, 0.0), (4.0, 0.0), (6.0, 1.0), (9.0, 1.0), (9.0, 5.0), (0.0, 5.0))


@pytest.mark.parametrize("points", [RAMP, RAMP[::-1]])
def test_a_wall_beyond_a_bend_is_felt_before_the_bend_and_only_there(points) -> None:
    room = Polygon("room", points, inside=True)
    rise = 1.0 / sqrt(5.0), 2.0 / sqrt(5.0)  # of the ramp: along, up
    floor, ramp = room.near(3.0, 0.5, 1.0)
    assert (floor.distance, floor.ahead) == (0.5, False)
    assert ramp[1:4] == pytest.approx((rise[0] + 0.5 * rise[1], -rise[0], rise[1]))
    assert ramp.ahead
    over = room.near(4.5, 0.8, 1.0)[0]  # it has the same number when the point is over it
    assert (over.side, over.ahead) == (ramp.side, False)
    # The ramp falls away behind its top, and the floor is no higher than the top.
    assert [near.ahead for near in room.near(7.0, 1.5, 1.0)] == [False]
    assert room.near(4.5, 0.8, 0.5) == [over]


def test_a_wall_beyond_a_bend_is_felt_from_round_a_corner_but_not_through_it() -> None:
    # A short side between a corner that sticks out and a bend.
    shelf = Polygon("shelf", ((0.0, -1.0), (0.0, 0.0), (-0.2, 0.1), (-3.0, 0.0), (-3.0, -1.0)))
    assert not any(near.ahead for near in shelf.near(0.5, 0.0, inf))
    bent = Polygon("bent", ((0.0, -1.0), (0.0, 0.0), (-0.2, 0.0), (-3.0, 1.5), (-3.0, -1.0)))
    corner, wall = bent.near(0.03, 0.3, 1.0)
    assert not corner.ahead
    assert wall.ahead
    assert wall.nx > 0.0
    assert len(bent.near(0.3, 0.03, 1.0)) == 1


@pytest.mark.parametrize("points", [BOX, BOX[::-1]])
def test_a_fence_is_felt_from_inside_and_pushes_back_from_outside(points) -> None:
    fence = Polygon("fence", points, inside=True)
    assert rounded(fence.near(3.5, 1.6, 1.0)) == [(0.4, 0.0, -1.0), (0.5, -1.0, 0.0)]
    assert rounded(fence.near(7.0, 6.0, 0.1)) == [(-5.0, -0.6, -0.8)]


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("place", [(0.0, 0.0), (2.0, 0.0), (4.0, 1.0), (1.0, 1.0)])
def test_on_the_boundary_the_normal_leads_off_it(place, inside) -> None:
    corner = Polygon("corner", L_SHAPE, inside=inside)
    near = corner.near(*place, 0.5)[0]
    assert near.distance == 0.0
    assert isclose(hypot(near.nx, near.ny), 1.0)
    after = distances(corner, np.array([[place[0] + 1e-3 * near.nx, place[1] + 1e-3 * near.ny]]))
    assert after[0] > 0.5e-3


# --- many points at once ---


# --- of a fleet file ---


def test_obstacles_and_fence_of_a_fleet() -> None:
    text = SMALL + (
        "[[obstacle]]\ncentre_m = [5, 6]\nradius_m = 0.5\n"
        "[[obstacle]]\nname = 'shed'\npoints_m = [[9, 9], [10, 9], [10, 10]]\n"
        "[[obstacle]]\npoints_m = [[19, 9], [20, 9], [20, 10]]\n"
        "[geofence]\npoints_m = [[-30, -30], [30, -30], [30, 30], [-30, 30]]\n"
    )
    fleet = small(text=text)
    tree, shed, third = obstacles_of(fleet)
    assert (tree.name, shed.name, third.name) == ("obstacle 1", "shed", "obstacle 3")
    assert tree.near(5.0, 7.0, 1.0)[0].distance == 0.5
    assert shed.near(9.5, 8.9, 1.0)[0].distance == pytest.approx(0.1)
    fence = fence_of(fleet)
    assert fence is not None
    assert (fence.name, fence.inside) == ("geofence", True)
    assert fence_of(small()) is None
    assert obstacles_of(small()) == ()
