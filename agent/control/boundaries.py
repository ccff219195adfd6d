"""Boundaries that stand still and must be kept away from: circles, polygons, the fence around all (PURE).

`Boundary.near` says how far a point is from a boundary, and which way is away from it: what a one-sided
constraint (docs/theory.md) is made of. It runs for every robot in every tick: plain floats, and whatever is
far is dropped by one comparison.

Lengths in m, frame W. Distances are signed: above 0 on the allowed side, which is outside of an obstacle
and inside of a fence.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf
from operator import attrgetter
from typing import Final, NamedTuple, Protocol

from handfast.agent.fleet.model import Fleet

_SAME_PLACE_M: Final = 1e-6
"""Two places of a boundary nearer to each other than this, felt from the same side, are one."""
_STRAIGHT: Final = 1e-9
_AT_M: Final = 1e-9
"""Nearer to a boundary than this, the way to it has no direction: the boundary's own normal is taken."""


class Near(NamedTuple):
    """A place of a boundary as a point feels it.

    Attributes:
        name: the boundary's.
        distance: signed, m.
        nx: with `ny` the unit vector, at that place, to the allowed side: the gradient of `distance`.
        ny: see `nx`.
        side: number of the side, or of the one that begins at the corner, that is felt; 0 of a circle.
        ahead: it is a wall beyond a bend, which the point is not over yet: `distance` is to its line.
    """

    name: str
    distance: float
    nx: float
    ny: float
    side: int = 0
    ahead: bool = False


class Boundary(Protocol):
    """The edge of where a hand point may be."""

    @property
    def name(self) -> str:
        """What messages call it."""
        ...

    def near(self, x: float, y: float, within: float) -> list[Near]:
        """What the point (x, y) feels of it that is nearer than `within` m (may be inf), nearest first.

        From the allowed side: each place to which the distance is less than to the places beside it, and
        which nothing of the same boundary hides. A corner that sticks out is felt once, both walls of a
        notch are. Where a wall bends towards the point, the walls beyond the bend are felt as well, as if
        they went on: who meets them only at the bend cannot brake in time. They are no nearer than the
        wall itself. From the wrong side, and however deep: the nearest way back, with a
        negative distance.
        """
        ...


class Circle:
    """A round obstacle: the allowed side is outside."""

    __slots__ = ("name", "radius", "x", "y")

    def __init__(self, name: str, x: float, y: float, radius: float) -> None:
        self.name, self.x, self.y, self.radius = name, x, y, radius

    def near(self, x: float, y: float, within: float) -> list[Near]:
        """See `Boundary.near`. From its centre all ways are as long: east is taken."""
        dx, dy = x - self.x, y - self.y
        away = hypot(dx, dy)
        distance = away - self.radius
        if distance >= within:
            return []
        if away == 0.0:
            return [Near(self.name, distance, 1.0, 0.0)]
        return [Near(self.name, distance, dx / away, dy / away)]


class _Side(NamedTuple):
    """A side of a polygon, from the corner (x, y) on for `length` along the unit vector (ux, uy)."""

    x: float
    y: float
    ux: float
    uy: float
    length: float
    nx: float  # unit normal to the allowed side
    ny: float
    cx: float  # normal of its first corner: half way between those of the sides that meet there
    cy: float


class _Place(NamedTuple):
    """A place of a polygon that may be felt."""

    distance: float  # >= 0
    is_allowed: bool  # whether the point is on its allowed side
    x: float
    y: float
    nx: float
    ny: float
    side: int
    is_corner: bool  # the first one of `side`


class Polygon:
    """A closed line of straight sides that do not cross. `inside`: whether the allowed side is inside.

    Args:
        points: corners, either way round, as `agent.fleet.safety` lets them pass.
    """

    __slots__ = ("_centre_x", "_centre_y", "_radius", "_sides", "inside", "name", "points")

    def __init__(self, name: str, points: Sequence[tuple[float, float]], *, inside: bool = False) -> None:
        self.name, self.inside = name, inside
        self.points = tuple(points)
        self._sides = _sides(self.points, inside)
        xs, ys = [x for x, _ in points], [y for _, y in points]
        self._centre_x, self._centre_y = 0.5 * (min(xs) + max(xs)), 0.5 * (min(ys) + max(ys))
        # A circle about the middle: of an obstacle nothing lies outside of it, of a fence nothing inside.
        self._radius = max(hypot(x - self._centre_x, y - self._centre_y) for x, y in points)
        if inside:
            self._radius = 0.0
            self._radius = max(0.0, self.near(self._centre_x, self._centre_y, inf)[0].distance)

    def near(self, x: float, y: float, within: float) -> list[Near]:
        """See `Boundary.near`."""
        away = hypot(x - self._centre_x, y - self._centre_y)
        if (self._radius - away if self.inside else away - self._radius) >= within:
            return []
        places = self._places(x, y)
        nearest = min(places, key=_DISTANCE)
        if not nearest.is_allowed:
            return [self._felt(nearest, x, y)]
        if nearest.distance >= within:
            return []
        seen: list[_Place] = []
        felt: list[Near] = []
        for place in sorted(places, key=_DISTANCE):
            if place.distance >= within:
                break
            if not place.is_allowed or (seen and self._is_hidden(place, x, y)):
                continue
            one = self._felt(place, x, y)
            if not any(_same(place, one, other, near) for other, near in zip(seen, felt, strict=True)):
                seen.append(place)
                felt.append(one)
        ahead: dict[int, Near] = {}
        for place, one in zip(seen, felt, strict=True):
            self._look_ahead(ahead, place, one, 1, x, y, within)
            self._look_ahead(ahead, place, one, -1, x, y, within)
        return sorted([*felt, *ahead.values()], key=_DISTANCE) if ahead else felt

    def _look_ahead(
        self, ahead: dict[int, Near], place: _Place, felt: Near, step: int, x: float, y: float, within: float
    ) -> None:
        """Adds the sides beyond a place that rise from its tangent, more and more, before one is over them.

        Where they cease to, one that sticks out hides the others.

        Args:
            ahead: by number of the side.
            step: 1 along the sides, -1 against.
        """
        sides = self._sides
        nx, ny, number = felt.nx, felt.ny, place.side
        facing = step * (sides[number].ux * sides[number].ny - sides[number].uy * sides[number].nx)
        tx, ty = facing * ny, -facing * nx  # the tangent, away from the place
        if step < 0 or not place.is_corner:
            number += step
        risen = _STRAIGHT  # sine
        for _ in range(len(sides) - 1):
            number %= len(sides)
            ax, ay, ux, uy, length, its_nx, its_ny, _, _ = sides[number]
            if nx * its_nx + ny * its_ny <= 0.0:
                return
            rx, ry = x - ax, y - ay
            along = rx * ux + ry * uy
            if along > 0.0 if step > 0 else along < length:
                return  # it is over it: a place of its own
            rise = -tx * its_nx - ty * its_ny
            if rise > risen + _STRAIGHT:
                risen = rise
                off = rx * its_nx + ry * its_ny
                if off < within:
                    ahead[number] = Near(self.name, off, its_nx, its_ny, number, True)
            elif risen > _STRAIGHT and rise < risen - _STRAIGHT:
                return
            number += step

    def _places(self, x: float, y: float) -> list[_Place]:
        """Every local minimum of the distance from (x, y) along the boundary: at least one."""
        places: list[_Place] = []
        sides = self._sides
        last = sides[-1]
        was_beyond = (x - last.x) * last.ux + (y - last.y) * last.uy >= last.length
        for number, (ax, ay, ux, uy, length, nx, ny, cx, cy) in enumerate(sides):
            rx, ry = x - ax, y - ay
            along = rx * ux + ry * uy
            if along >= length:
                was_beyond = True
                continue
            if along > 0.0:
                off = rx * nx + ry * ny
                places.append(
                    _Place(abs(off), off >= 0.0, ax + along * ux, ay + along * uy, nx, ny, number, False)
                )
            elif was_beyond:
                places.append(_Place(hypot(rx, ry), rx * cx + ry * cy >= 0.0, ax, ay, cx, cy, number, True))
            was_beyond = False
        return places

    def _felt(self, place: _Place, x: float, y: float) -> Near:
        distance, is_allowed, px, py, nx, ny, side, is_corner = place
        sign = 1.0 if is_allowed else -1.0
        if is_corner and distance > _AT_M:  # of a side its own normal is the way, and more exact
            nx, ny = sign * (x - px), sign * (y - py)
            norm = hypot(nx, ny)
            nx, ny = nx / norm, ny / norm
        return Near(self.name, sign * distance, nx, ny, side)

    def _is_hidden(self, place: _Place, x: float, y: float) -> bool:
        """Whether another side lies across the straight way from (x, y) to a place."""
        wx, wy = place.x - x, place.y - y
        count = len(self._sides)
        own = (place.side, (place.side - 1) % count if place.is_corner else place.side)
        for number, (ax, ay, ux, uy, length, *_) in enumerate(self._sides):
            if number in own:
                continue
            rx, ry = ax - x, ay - y
            bx, by = rx + length * ux, ry + length * uy
            if (wx * ry - wy * rx) * (wx * by - wy * bx) < 0.0 and (
                (ux * ry - uy * rx) * (ux * (ry - wy) - uy * (rx - wx)) < 0.0
            ):
                return True
        return False


_DISTANCE: Final = attrgetter("distance")


def _same(place: _Place, felt: Near, other: _Place, its: Near) -> bool:
    return (
        hypot(place.x - other.x, place.y - other.y) < _SAME_PLACE_M
        and felt.nx * its.nx + felt.ny * its.ny > 0.99
    )


def _sides(points: Sequence[tuple[float, float]], inside: bool) -> tuple[_Side, ...]:
    x0, y0 = points[0]
    ends = [*points[1:], points[0]]
    area = sum(
        (ax - x0) * (by - y0) - (bx - x0) * (ay - y0) for (ax, ay), (bx, by) in zip(points, ends, strict=True)
    )
    turn = 1.0 if (area > 0.0) is not inside else -1.0  # counter-clockwise, outside is to the right
    bare: list[tuple[float, float, float, float, float]] = []
    for (ax, ay), (bx, by) in zip(points, ends, strict=True):
        length = hypot(bx - ax, by - ay)
        bare.append((ax, ay, (bx - ax) / length, (by - ay) / length, length))
    sides = []
    for number, (ax, ay, ux, uy, length) in enumerate(bare):
        nx, ny = turn * uy, -turn * ux
        vx, vy = bare[number - 1][2:4]
        cx, cy = nx + turn * vy, ny - turn * vx
        norm = hypot(cx, cy)
        sides.append(_Side(ax, ay, ux, uy, length, nx, ny, cx / norm, cy / norm))
    return tuple(sides)


def obstacles_of(fleet: Fleet) -> tuple[Circle | Polygon, ...]:
    """The obstacles of a fleet file, in its order; one without a name is "obstacle" and its number."""
    found: list[Circle | Polygon] = []
    for number, section in enumerate(fleet.obstacles, 1):
        name = section.name or f"obstacle {number}"
        if section.points_m is not None:
            found.append(Polygon(name, section.points_m))
        elif section.centre_m is not None and section.radius_m is not None:
            found.append(Circle(name, *section.centre_m, section.radius_m))
    return tuple(found)


def fence_of(fleet: Fleet) -> Polygon | None:
    """The geofence of a fleet file; None when it has none."""
    return None if fleet.geofence is None else Polygon("geofence", fleet.geofence.points_m, inside=True)
