"""NED, FRD and geodetic coordinates against the world, both ways, for all places and headings."""

from __future__ import annotations

from math import cos, hypot, isclose, pi, sin, tau

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymap3d import enu2geodetic, geodetic2ecef

from handfast.bridges.mavlink.ardupilot import frames
from handfast.bridges.mavlink.ardupilot.dynamics import RoverDynamics
from handfast.bridges.mavlink.ardupilot.frames import Geodetic

ANGLE = st.floats(-20.0, 20.0)
METRES = st.floats(-2000.0, 2000.0)
LATITUDE = st.floats(-80.0, 80.0)
LONGITUDE = st.floats(-180.0, 179.999)
PLACE = st.builds(Geodetic, LATITUDE, LONGITUDE, st.floats(-100.0, 3000.0))


def off(a: float, b: float) -> float:
    """Difference of two angles."""
    return abs(frames.wrapped(a - b))


def place_near(datum: Geodetic, east: float, north: float) -> Geodetic:
    latitude, longitude, _ = enu2geodetic(
        east, north, 0.0, datum.latitude_deg, datum.longitude_deg, datum.altitude_m
    )
    return Geodetic(float(latitude), float(longitude), datum.altitude_m)


@given(ANGLE)
def test_yaw_and_heading_are_one_anothers_inverse(angle):
    assert off(frames.yaw_from_heading(frames.heading_from_yaw(angle)), angle) < 1e-12
    assert off(frames.heading_from_yaw(frames.yaw_from_heading(angle)), angle) < 1e-12
    assert -pi <= frames.heading_from_yaw(angle) <= pi
    assert 0.0 <= frames.yaw_degrees(angle) <= 360.0


@given(ANGLE)
def test_a_direction_is_the_same_one_in_both_frames(yaw):
    """North and east of a unit vector along the yaw are y and x of one along the heading."""
    heading = frames.heading_from_yaw(yaw)
    assert isclose(cos(heading), sin(yaw), abs_tol=1e-12)
    assert isclose(sin(heading), cos(yaw), abs_tol=1e-12)


@pytest.mark.parametrize(
    ("yaw", "heading"), [(0.0, pi / 2), (pi / 2, 0.0), (pi, -pi / 2), (-pi / 2, pi), (tau, pi / 2)]
)
def test_compass(yaw: float, heading: float):
    assert off(frames.heading_from_yaw(yaw), heading) < 1e-12


@given(PLACE, METRES, METRES)
def test_world_and_geodetic_are_one_anothers_inverse(datum, x, y):
    again = frames.geodetic_to_world(datum, frames.world_to_geodetic(datum, x, y))
    assert again == pytest.approx((x, y), abs=1e-3)


@given(PLACE, METRES, METRES)
def test_local_and_geodetic_are_one_anothers_inverse(origin, north, east):
    again = frames.geodetic_to_local(origin, frames.local_to_geodetic(origin, north, east))
    assert again == pytest.approx((north, east), abs=1e-5)


@given(PLACE, METRES, METRES, METRES, METRES)
def test_local_and_world_are_one_anothers_inverse(datum, east, north, x, y):
    origin = place_near(datum, east, north)
    local = frames.geodetic_to_local(origin, frames.world_to_geodetic(datum, x, y))
    assert frames.local_to_world(datum, origin, *local) == pytest.approx((x, y), abs=1e-3)


@given(PLACE, METRES, METRES)
def test_distances_are_those_of_the_ellipsoid(datum, x, y):
    """Straight through the earth between the two places, which a tangent plane has right to 1e-7 at 3 km."""
    place = frames.world_to_geodetic(datum, x, y)
    a, b = (geodetic2ecef(p.latitude_deg, p.longitude_deg, p.altitude_m) for p in (datum, place))
    distance = hypot(*(float(q) - float(p) for p, q in zip(a, b, strict=True)))
    assert distance == pytest.approx(hypot(x, y), rel=1e-6, abs=1e-5)


@given(
    st.builds(Geodetic, LATITUDE, st.sampled_from([-180.0, 179.9999, 180.0]), st.just(0.0)), METRES, METRES
)
def test_across_the_antimeridian(datum, x, y):
    place = frames.world_to_geodetic(datum, x, y)
    assert -180.0 <= place.longitude_deg <= 180.0
    assert frames.local_to_world(datum, datum, *frames.geodetic_to_local(datum, place)) == pytest.approx(
        (x, y), abs=1e-3
    )


@given(PLACE, st.floats(-1.0, 1.0).filter(lambda v: abs(v) > 0.1))
def test_a_vehicle_heading_north_drives_towards_plus_y(datum, speed):
    rover = RoverDynamics(yaw=0.0)
    for _ in range(100):
        rover.step(0.02, speed, 0.0)
    x, y = frames.local_to_world(datum, datum, rover.north, rover.east)
    assert abs(x) < 1e-3
    assert y * speed > 0.0
    assert y == pytest.approx(rover.north, rel=0.011)
    assert frames.heading_from_yaw(rover.yaw) == pytest.approx(pi / 2)


@given(ANGLE, st.floats(0.3, 1.0), st.floats(-0.5, 0.5))
def test_a_vehicle_drives_along_its_heading(yaw, speed, rate):
    datum = Geodetic(-35.363261, 149.16523)
    rover = RoverDynamics(yaw=yaw)
    before = (0.0, 0.0)
    for _ in range(60):
        rover.step(0.02, speed, frames.yaw_rate(rate))
        here = frames.local_to_world(datum, datum, rover.north, rover.east)
        if rover.speed > 0.2:
            heading = frames.heading_from_yaw(rover.yaw)
            way = hypot(here[0] - before[0], here[1] - before[1])
            ahead = (here[0] - before[0]) * cos(heading) + (here[1] - before[1]) * sin(heading)
            assert ahead == pytest.approx(way, rel=1e-3)
        before = here
    turned = frames.wrapped(frames.heading_from_yaw(rover.yaw) - frames.heading_from_yaw(yaw))
    assert turned * rate >= 0.0  # counter-clockwise is positive in the world
