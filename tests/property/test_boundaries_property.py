"""Boundaries of any shape, from any point: the whole-array distance, the gradient, and what is felt."""

from __future__ import annotations

from math import cos, hypot, inf, pi, sin

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.deploy.analysis.shapes import distances

COORDINATE = st.floats(-20.0, 20.0)


@st.composite
def stars(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Corners at growing angles about a middle, either way round: notches and spikes, but no crossings."""
    count = draw(st.integers(3, 12))
    shares = draw(st.lists(st.floats(0.2, 1.0), min_size=count, max_size=count))
    angles = np.cumsum(shares) / sum(shares) * 2.0 * pi
    assume(float(np.diff([0.0, *angles]).max()) < 0.9 * pi)
    radii = draw(st.lists(st.floats(0.3, 6.0), min_size=count, max_size=count))
    cx, cy = draw(COORDINATE), draw(COORDINATE)
    points = [(cx + r * cos(a), cy + r * sin(a)) for r, a in zip(radii, angles.tolist(), strict=True)]
    return points if draw(st.booleans()) else points[::-1]


POLYGONS = st.builds(lambda points, inside: Polygon("wall", points, inside=inside), stars(), st.booleans())
CIRCLES = st.builds(Circle, st.just("tree"), COORDINATE, COORDINATE, st.floats(0.01, 10.0))
BOUNDARIES = st.one_of(POLYGONS, CIRCLES)


def distance(boundary: Circle | Polygon, x: float, y: float) -> float:
    return float(distances(boundary, np.array([[x, y]]))[0])


@given(BOUNDARIES, COORDINATE, COORDINATE)
def test_what_is_felt_first_is_the_distance(boundary, x, y):
    first = boundary.near(x, y, inf)[0]
    assert abs(first.distance - distance(boundary, x, y)) < 1e-9


@given(BOUNDARIES, COORDINATE, COORDINATE, st.floats(0.01, 5.0))
def test_no_less_is_felt_within_a_limit_than_without(boundary, x, y, within):
    everything = boundary.near(x, y, inf)
    assert boundary.near(x, y, within) == [near for near in everything if near.distance < within]
    assert [near.distance for near in everything] == sorted(near.distance for near in everything)


@given(BOUNDARIES, COORDINATE, COORDINATE, st.floats(0.0, 2.0 * pi))
def test_the_normals_are_the_gradient(boundary, x, y, way):
    step = 1e-6
    felt = boundary.near(x, y, inf)
    assume(felt[0].distance > 1e-2)
    dx, dy = step * cos(way), step * sin(way)
    # The least of what is felt is the distance, also when another place becomes the nearest on the way.
    predicted = min(near.distance + near.nx * dx + near.ny * dy for near in felt)
    assert abs(predicted - distance(boundary, x + dx, y + dy)) < 1e-9


@given(BOUNDARIES, COORDINATE, COORDINATE)
def test_every_place_is_on_the_boundary_and_in_sight(boundary, x, y):
    for near in boundary.near(x, y, inf):
        assert abs(hypot(near.nx, near.ny) - 1.0) < 1e-12
        if near.ahead:
            continue
        way = np.linspace(0.0, 1.0, 201)[:, None]
        foot = np.array([x - near.distance * near.nx, y - near.distance * near.ny])
        along = distances(boundary, (1.0 - way) * (x, y) + way * foot)
        assert abs(along[-1]) < 1e-6
        sign = 1.0 if near.distance >= 0.0 else -1.0
        assert (sign * along > -1e-6).all()  # nothing of the boundary in between


@given(POLYGONS, st.data())
def test_a_point_on_the_boundary_has_a_way_off_it(polygon, data):
    number = data.draw(st.integers(0, len(polygon.points) - 1))
    share = data.draw(st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0]))
    (ax, ay), (bx, by) = polygon.points[number - 1], polygon.points[number]
    x, y = ax + share * (bx - ax), ay + share * (by - ay)
    felt = polygon.near(x, y, 1e-3)
    assert felt
    assert abs(felt[0].distance) < 1e-12
    assert abs(hypot(felt[0].nx, felt[0].ny) - 1.0) < 1e-12
    if 0.0 < share < 1.0:  # at the corner of a notch the way off one wall may end in the other
        step = 1e-5
        assert distance(polygon, x + step * felt[0].nx, y + step * felt[0].ny) > 0.5 * step


@given(stars(), COORDINATE, COORDINATE)
def test_inside_and_outside_are_each_other_turned(points, x, y):
    first = Polygon("wall", points).near(x, y, inf)[0]
    other = Polygon("fence", points, inside=True).near(x, y, inf)[0]
    assert abs(first.distance + other.distance) < 1e-9
