"""Converts NED, FRD and geodetic coordinates to the world and back, here and nowhere else (PURE).

W is the world: ENU about the fleet's datum, x east, y north, heading counter-clockwise from x. A vehicle
speaks NED about its own EKF origin, yaw clockwise from north, and of its body in FRD; the robot's frame is
FLU. Angles in rad, lengths in m, latitude and longitude in degrees (WGS 84).

Between a vehicle's NED and latitude and longitude ArduPilot has its own arithmetic (``Location::offset``,
``Location::get_distance_NE``): a sphere, with the longitude's scale at the middle latitude. It is repeated
here as it is, since that is what the vehicle did to its GPS's latitude and longitude. From there to W a
geodesy library takes over (pymap3d, ellipsoid). So two vehicles with different origins agree about one place,
which they would not if the offset between their origins were merely added (0.3 % of it at middle latitudes).
"""

from __future__ import annotations

from math import cos, degrees, pi, radians, remainder, sin, tau
from typing import Final, NamedTuple

from pymap3d import enu2geodetic, geodetic2enu

from handfast.agent.fleet.model import Fleet

METRES_PER_DEGREE: Final = 0.011131884502145034e7
"""Of latitude, in ArduPilot's arithmetic (``LOCATION_SCALING_FACTOR``)."""
_LONGITUDE_SCALE_MIN: Final = 0.01
ANCHOR_M: Final = 10.0
"""How far from where it was taken the linear form of `LocalToWorld` is used."""


class Geodetic(NamedTuple):
    """A place: latitude and longitude in degrees (WGS 84), altitude above mean sea level in m."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


def datum_of(fleet: Fleet) -> Geodetic:
    """The fleet's datum. A fleet with a robot whose plant is `mavlink` has one."""
    assert fleet.datum is not None
    return Geodetic(fleet.datum.latitude_deg, fleet.datum.longitude_deg, fleet.datum.altitude_m)


def _longitude_scale(latitude_deg: float) -> float:
    return max(cos(radians(latitude_deg)), _LONGITUDE_SCALE_MIN)


def _turn_deg(difference_deg: float) -> float:
    """A difference of longitudes within -180 to 180 degrees."""
    return remainder(difference_deg, 360.0)


def local_to_geodetic(origin: Geodetic, north: float, east: float) -> Geodetic:
    """The place `north` and `east` (m) of a vehicle's EKF origin, as ArduPilot has it."""
    latitude = origin.latitude_deg + north / METRES_PER_DEGREE
    middle = 0.5 * (origin.latitude_deg + latitude)
    longitude = origin.longitude_deg + east / (METRES_PER_DEGREE * _longitude_scale(middle))
    return Geodetic(latitude, _turn_deg(longitude), origin.altitude_m)


def geodetic_to_local(origin: Geodetic, place: Geodetic) -> tuple[float, float]:
    """North and east (m) of a place from a vehicle's EKF origin, as ArduPilot has it."""
    middle = 0.5 * (origin.latitude_deg + place.latitude_deg)
    north = (place.latitude_deg - origin.latitude_deg) * METRES_PER_DEGREE
    turn = _turn_deg(place.longitude_deg - origin.longitude_deg)
    return north, turn * METRES_PER_DEGREE * _longitude_scale(middle)


def geodetic_to_world(datum: Geodetic, place: Geodetic) -> tuple[float, float]:
    """x and y (m, W) of a place. Heights are those of the datum: the world is flat, its ground level."""
    height = datum.altitude_m
    east, north, _ = geodetic2enu(
        place.latitude_deg, place.longitude_deg, height, datum.latitude_deg, datum.longitude_deg, height
    )
    return float(east), float(north)


def world_to_geodetic(datum: Geodetic, x: float, y: float) -> Geodetic:
    """The place at x and y (m, W), at the height of the datum."""
    height = datum.altitude_m
    latitude, longitude, _ = enu2geodetic(x, y, 0.0, datum.latitude_deg, datum.longitude_deg, height)
    return Geodetic(float(latitude), float(longitude), height)


def local_to_world(datum: Geodetic, origin: Geodetic, north: float, east: float) -> tuple[float, float]:
    """x and y (m, W) of what a vehicle has `north` and `east` (m) of its EKF origin."""
    return geodetic_to_world(datum, local_to_geodetic(origin, north, east))


class LocalToWorld:
    """`local_to_world` of one vehicle's places, cheaply: linear about an anchor that follows the vehicle.

    Within `ANCHOR_M` of the anchor that is off by `ANCHOR_M`^2 / the Earth's radius, times the tangent of the
    latitude: 0.02 mm at middle ones, 1 mm 100 km from a pole.
    """

    def __init__(self, datum: Geodetic, origin: Geodetic) -> None:
        self._datum, self._origin = datum, origin
        self._anchor(0.0, 0.0)

    def _anchor(self, north: float, east: float) -> None:
        def place(north: float, east: float) -> tuple[float, float]:
            return local_to_world(self._datum, self._origin, north, east)

        self._north, self._east = north, east
        self._x, self._y = place(north, east)
        (x, y), (back_x, back_y) = place(north + ANCHOR_M, east), place(north - ANCHOR_M, east)
        self._x_north, self._y_north = 0.5 * (x - back_x) / ANCHOR_M, 0.5 * (y - back_y) / ANCHOR_M
        (x, y), (back_x, back_y) = place(north, east + ANCHOR_M), place(north, east - ANCHOR_M)
        self._x_east, self._y_east = 0.5 * (x - back_x) / ANCHOR_M, 0.5 * (y - back_y) / ANCHOR_M

    def __call__(self, north: float, east: float) -> tuple[float, float]:
        """x and y (m, W) of what the vehicle has `north` and `east` (m) of its EKF origin."""
        if not (abs(north - self._north) <= ANCHOR_M and abs(east - self._east) <= ANCHOR_M):
            self._anchor(north, east)
        north, east = north - self._north, east - self._east
        return (
            self._x + self._x_north * north + self._x_east * east,
            self._y + self._y_north * north + self._y_east * east,
        )


def wrapped(angle: float) -> float:
    """The angle within -pi to pi."""
    return remainder(angle, tau)


def heading_from_yaw(yaw: float) -> float:
    """Heading (W, counter-clockwise from east) of a vehicle with a yaw clockwise from north."""
    return wrapped(0.5 * pi - yaw)


def yaw_from_heading(heading: float) -> float:
    """Yaw (clockwise from north) of a robot with a heading in W. Its own inverse is `heading_from_yaw`."""
    return wrapped(0.5 * pi - heading)


def yaw_rate(rate: float) -> float:
    """Between a yaw rate about the axis down (FRD, NED) and one about the axis up (FLU, ENU): both ways."""
    return -rate


def forward_speed(yaw: float, v_north: float, v_east: float) -> float:
    """Speed along the heading (m/s), negative in reverse, of a velocity in NED."""
    return v_north * cos(yaw) + v_east * sin(yaw)


def yaw_degrees(yaw: float) -> float:
    """A yaw in degrees from 0 to 360, as people read a compass."""
    return degrees(yaw) % 360.0 % 360.0  # a tiny negative one is 360.0 after the first
