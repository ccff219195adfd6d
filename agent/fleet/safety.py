"""The tables of a fleet file about safety, and what can be wrong in them (PURE).

Avoidance, obstacles, geofence, supervision. Lengths in m, times in s; frame W (ENU: x east, y north).
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from handfast.agent.common.quantities import FAR_M, Vector
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import about, setting
from handfast.agent.common.wording import show

CORNERS_MAX: Final = 200
"""Corners of one polygon: every robot measures its way to each side in every tick."""

BEACON_HZ: Final = 5.0
"""Rate at which a robot tells all others where it is while that is news to them, 1/s."""
BEACONS_MANY: Final = 24
"""Robots of a larger fleet tell where they are less often, where nothing is new of it..."""
BEACONS_HZ: Final = 25
"""...so that each hears so many beacons a second, as many as of one neighbour's hand states at 50 Hz."""
BEACON_HORIZONS: Final = 2.0
"""Two beacons of one robot are at most so many prediction horizons apart: who tells that it will be silent is
given up as much later."""
ORDERS_HZ: Final = 100
"""So many a second of all robots of such a fleet say that they lack an order that another has, where all do:
that one needs to hear it from one of them. And so many begin to say where they are."""
ORDERS_ROBOTS: Final = 100
"""Of more robots than this fewer say it in a second, as all of them hear each: of twice as many robots a
quarter of those, so that all together hear no more. But none later than after the longest interval of its
beacons."""

SLOW_SHARE: Final = 0.75
"""Share of the prediction horizon after which a robot slows down for a silent neighbour."""


@dataclass(frozen=True, slots=True)
class AvoidanceSection:
    """``[avoidance]``: how far robots keep from what they share no edge with, and the safety filter."""

    enabled: bool = setting(
        True,
        "Robots keep away from robots that they share no edge with, from obstacles and from the geofence, "
        "and what the law asks for passes the safety filter. false: the bare law, as published.",
    )
    distance_m: float | None = setting(
        None,
        "d_a: robots that share no edge push each other apart when they are nearer than this. Left out: half "
        "way between the safe distance and the shortest edge, at most 2.8 safe distances, and less than what "
        "the formation itself puts between two such robots.",
        unit="m",
        gt=0,
        le=FAR_M,
        example="0.6",
    )
    clearance_m: float | None = setting(
        None,
        "No hand point comes nearer to an obstacle than this. Left out: half of `formation.safe_distance_m`.",
        unit="m",
        gt=0,
        le=FAR_M,
        example="0.3",
    )
    beacon_interval_max_s: float | None = setting(
        None,
        "A robot tells all others where it is less often while it moves as they expect, has nothing new to "
        "tell and lacks nothing: so long after the last time at the latest. At most "
        f"{BEACON_HORIZONS:g} times `control.prediction_horizon_s`. Left out: {1 / BEACON_HZ:g} s; of more "
        f"than {BEACONS_MANY} robots so many seconds that each of them hears {BEACONS_HZ} beacons a second.",
        unit="s",
        gt=0,
        le=60,
        example="1.0",
    )
    margin_m: float = setting(
        0.05, "The safety filter keeps this much more than the safe distance.", unit="m", ge=0, le=100
    )


@dataclass(frozen=True, slots=True)
class ObstacleSection:
    """One ``[[obstacle]]``: a circle, or a polygon."""

    name: str = setting(
        "",
        "What messages call it; left out: `obstacle 1`, `obstacle 2`, ...",
        pattern=r"[^\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]{0,40}",
        pattern_says="up to 40 printable characters",
        example='"shed"',
    )
    centre_m: Vector | None = setting(
        None, "Of a circle: its centre.", unit="m", ge=-FAR_M, le=FAR_M, example="[2.0, 1.0]"
    )
    radius_m: float | None = setting(
        None, "Of a circle: its radius.", unit="m", gt=0, le=FAR_M, example="0.4"
    )
    points_m: tuple[Vector, ...] | None = setting(
        None,
        f"Of a polygon: its corners in order, either way round, 3 to {CORNERS_MAX}; it need not be convex.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
        example="[[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]",
    )


FENCE_WARN_M: Final = 0.5
"""Nearer to the geofence than this, a robot is pushed back, and says so."""


@dataclass(frozen=True, slots=True)
class GeofenceSection:
    """``[geofence]``: where robots may be. A robot nearer to it than 0.5 m is pushed back, and says so."""

    points_m: tuple[Vector, ...] = field(
        metadata=about(
            f"Its corners in order, either way round, 3 to {CORNERS_MAX}. A robot whose hand point is "
            "outside holds.",
            unit="m",
            ge=-FAR_M,
            le=FAR_M,
            example="[[-10.0, -10.0], [30.0, -10.0], [30.0, 30.0], [-10.0, 30.0]]",
        )
    )


@dataclass(frozen=True, slots=True)
class SupervisionSection:
    """``[supervision]``: what robots do about silent neighbours and absent operators."""

    silence: Literal["drop", "hold"] = setting(
        "drop",
        "What a robot does when it has given up a neighbour: `drop`: drives on without that edge, and keeps "
        "away from where that neighbour may be, but holds when it hears nobody any more; "
        "`hold`: brakes until it hears all of them.",
    )
    deadman_s: float | None = setting(
        None,
        "Dead-man's switch: robots hold when no operator's heartbeat has come for so long. `handfast run` "
        "sends it, and `handfast heartbeat`. Left out: robots need no operator.",
        unit="s",
        ge=0.2,
        le=600,
        example="1.0",
    )


_CIRCLE = ("centre_m", "radius_m")

_EITHER = (
    "a circle has centre_m and radius_m, a polygon points_m: write for example centre_m = [2.0, 1.0] and "
    "radius_m = 0.4"
)

_SIDE_M: Final = 1e-3
"""Shortest side of a polygon: shorter ones have no direction worth the name."""


def check_safety(values: Mapping[str, Any], reader: Reader) -> None:
    """Adds to `reader` what is wrong with valid values that do not go together."""
    _check_obstacles(values.get("obstacles", ()), reader)
    fence = values.get("geofence")
    if fence and fence.get("points_m") is not None:
        _check_polygon(fence["points_m"], "geofence.points_m", reader)
    _check_avoidance(values.get("avoidance", {}), values.get("formation", {}).get("safe_distance_m"), reader)
    _check_beacons(values, reader)


def _check_obstacles(rows: Sequence[Mapping[str, Any]], reader: Reader) -> None:
    first: dict[str, int] = {"geofence": 0}
    for number, row in enumerate(rows, 1):
        place = f"obstacle[{number}]"
        _check_kind(row, place, reader)
        if row.get("points_m") is not None:
            _check_polygon(row["points_m"], f"{place}.points_m", reader)
        if "name" not in row:
            continue
        name = row["name"] or f"obstacle {number}"  # as `agent.control.boundaries.obstacles_of` calls it
        other = first.setdefault(name, number)
        if other != number:
            whose = f"obstacle[{other}]" if other else "the fence"
            reader.add(
                f"{place}.name", f"{whose} has the name {show(name)} already: messages could mean either"
            )


def _check_kind(row: Mapping[str, Any], place: str, reader: Reader) -> None:
    if not {*_CIRCLE, "points_m"} <= row.keys():
        return  # one has a problem of its own
    given = [key for key in _CIRCLE if row[key] is not None]
    if row["points_m"] is not None:
        if given:
            reader.add(place, f"has {' and '.join(given)} beside points_m: {_EITHER}; leave one kind out")
    elif not given:
        reader.add(place, f"has no shape: {_EITHER}")
    elif len(given) == 1:
        (missing,) = set(_CIRCLE) - set(given)
        example = "[2.0, 1.0]" if missing == "centre_m" else "0.4"
        reader.add(
            f"{place}.{missing}",
            f"is missing: a circle, which {given[0]} makes it, needs it, for example {missing} = {example}",
        )


def _check_polygon(points: Sequence[Vector | None], place: str, reader: Reader) -> None:
    count = len(points)
    if not 3 <= count <= CORNERS_MAX:
        reader.add(place, f"must have 3 to {CORNERS_MAX} corners, got {count}")
        return
    corners = [point for point in points if point is not None]
    if len(corners) < count:
        return  # one has a problem of its own
    first: dict[Vector, int] = {}
    for number, corner in enumerate(corners, 1):
        if first.setdefault(corner, number) != number:
            again = (
                "the last side closes by itself" if number == count and first[corner] == 1 else "leave it out"
            )
            reader.add(f"{place}[{number}]", f"{show(corner)} is corner {first[corner]} again: {again}")
    if len(first) < count:
        return
    for number, corner in enumerate(corners, 1):
        if _square(corners[number - 2], corner) < _SIDE_M**2:
            reader.add(
                f"{place}[{number}]",
                f"{show(corner)} is nearer than {1000 * _SIDE_M:g} mm to the corner before it: leave one out",
            )
            return
    if _is_flat(corners):
        reader.add(place, "all corners lie on one line: a polygon needs an area")
        return
    crossing = _crossing(corners)
    if crossing is not None:
        i, j = crossing
        reader.add(
            place,
            f"the sides from corner {i + 1} to {(i + 1) % count + 1} and from corner {j + 1} to "
            f"{(j + 1) % count + 1} meet: give the corners in the order in which one walks around",
        )


def _is_flat(corners: Sequence[Vector]) -> bool:
    a, b = corners[0], max(corners, key=lambda corner: _square(corners[0], corner))
    return all(_turn(a, b, corner) == 0 for corner in corners)


def _crossing(corners: Sequence[Vector]) -> tuple[int, int] | None:
    """Numbers (from 0) of the first two sides that have a point in common which is not a corner of both."""
    count = len(corners)
    sides = [(corners[k], corners[(k + 1) % count]) for k in range(count)]
    order = sorted(range(count), key=lambda k: min(sides[k][0][0], sides[k][1][0]))
    found: list[tuple[int, int]] = []
    for position, i in enumerate(order):
        east = max(sides[i][0][0], sides[i][1][0])
        for j in order[position + 1 :]:
            if min(sides[j][0][0], sides[j][1][0]) > east:
                break  # this side, and all after it, begin further east
            a, b = min(i, j), max(i, j)
            if b - a == 1 or (a == 0 and b == count - 1):
                before, at, after = _corner(corners, a, b)
                touches = _turn(before, at, after) == 0 and _ahead(before, at, after) < 0.0
            else:
                touches = _meet(*sides[a], *sides[b])
            if touches:
                found.append((a, b))
    return min(found, default=None)


def _corner(corners: Sequence[Vector], a: int, b: int) -> tuple[Vector, Vector, Vector]:
    """The corner that two next sides a < b share, with the corners before and after it."""
    count = len(corners)
    at = b if b - a == 1 else 0
    return corners[at - 1], corners[at], corners[(at + 1) % count]


def _meet(a: Vector, b: Vector, c: Vector, d: Vector) -> bool:
    """Whether the segments ab and cd have a point in common."""
    turns = (_turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b))
    if turns[0] * turns[1] < 0 and turns[2] * turns[3] < 0:
        return True
    ends = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(turn == 0 and _is_between(*three) for turn, three in zip(turns, ends, strict=True))


def _turn(a: Vector, b: Vector, c: Vector) -> int:
    """1 when c lies to the left of the way from a to b, -1 to the right, 0 on it within rounding."""
    first, second = (b[0] - a[0]) * (c[1] - a[1]), (b[1] - a[1]) * (c[0] - a[0])
    if abs(first - second) <= 1e-12 * (abs(first) + abs(second)):
        return 0
    return 1 if first > second else -1


def _ahead(a: Vector, b: Vector, c: Vector) -> float:
    """Above 0 when the way from b to c goes on as that from a to b, below when it goes back."""
    return (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1])


def _is_between(a: Vector, b: Vector, c: Vector) -> bool:
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])


def _square(a: Vector, b: Vector) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2


def _check_avoidance(avoidance: Mapping[str, Any], safe: float | None, reader: Reader) -> None:
    distance = avoidance.get("distance_m")
    if distance is not None and safe is not None and distance <= safe:
        reader.add(
            "avoidance.distance_m",
            f"{show(distance)} is too small: robots begin to part at this distance, which must be above "
            f"formation.safe_distance_m = {show(safe)}, that they must not come below",
        )


def _check_beacons(values: Mapping[str, Any], reader: Reader) -> None:
    avoidance, place = values.get("avoidance", {}), "avoidance.beacon_interval_max_s"
    longest = avoidance.get("beacon_interval_max_s")
    horizon = values.get("control", {}).get("prediction_horizon_s")
    if longest is not None and longest < 1.0 / BEACON_HZ * (1.0 - 1e-9):
        reader.add(
            place,
            f"{show(longest)} is too short: must be at least {1.0 / BEACON_HZ:g} s",
        )
    if longest is not None and horizon is not None and longest > BEACON_HORIZONS * horizon:
        reader.add(
            place,
            f"{show(longest)} is too long: must be at most {BEACON_HORIZONS:g} times "
            f"control.prediction_horizon_s = {show(horizon)}, so that who is gone is given up in time",
        )
