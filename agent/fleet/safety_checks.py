"""What is wrong with obstacles, geofence, avoidance and supervision whose fields are valid each (PURE)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from agent.common.reader import Reader
from agent.common.wording import show
from agent.fleet.safety import CORNERS_MAX, Pair

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
    _check_supervision(values, reader)


# --- shapes --------------------------------------------------------------------------------------


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


def _check_polygon(points: Sequence[Pair | None], place: str, reader: Reader) -> None:
    count = len(points)
    if not 3 <= count <= CORNERS_MAX:
        reader.add(place, f"must have 3 to {CORNERS_MAX} corners, got {count}")
        return
    corners = [point for point in points if point is not None]
    if len(corners) < count:
        return  # one has a problem of its own
    first: dict[Pair, int] = {}
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


def _is_flat(corners: Sequence[Pair]) -> bool:
    a, b = corners[0], max(corners, key=lambda corner: _square(corners[0], corner))
    return all(_turn(a, b, corner) == 0 for corner in corners)


def _crossing(corners: Sequence[Pair]) -> tuple[int, int] | None:
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


def _corner(corners: Sequence[Pair], a: int, b: int) -> tuple[Pair, Pair, Pair]:
    """The corner that two next sides a < b share, with the corners before and after it."""
    count = len(corners)
    at = b if b - a == 1 else 0
    return corners[at - 1], corners[at], corners[(at + 1) % count]


def _meet(a: Pair, b: Pair, c: Pair, d: Pair) -> bool:
    """Whether the segments ab and cd have a point in common."""
    turns = (_turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b))
    if turns[0] * turns[1] < 0 and turns[2] * turns[3] < 0:
        return True
    ends = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(turn == 0 and _is_between(*three) for turn, three in zip(turns, ends, strict=True))


def _turn(a: Pair, b: Pair, c: Pair) -> int:
    """1 when c lies to the left of the way from a to b, -1 to the right, 0 on it within rounding."""
    first, second = (b[0] - a[0]) * (c[1] - a[1]), (b[1] - a[1]) * (c[0] - a[0])
    if abs(first - second) <= 1e-12 * (abs(first) + abs(second)):
        return 0
    return 1 if first > second else -1


def _ahead(a: Pair, b: Pair, c: Pair) -> float:
    """Above 0 when the way from b to c goes on as that from a to b, below when it goes back."""
    return (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1])


def _is_between(a: Pair, b: Pair, c: Pair) -> bool:
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])


def _square(a: Pair, b: Pair) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2


# --- settings ------------------------------------------------------------------------------------


def _check_avoidance(avoidance: Mapping[str, Any], safe: float | None, reader: Reader) -> None:
    distance, sensing = avoidance.get("distance_m"), avoidance.get("sensing_m")
    if distance is not None and safe is not None and distance <= safe:
        reader.add(
            "avoidance.distance_m",
            f"{show(distance)} is too small: robots begin to part at this distance, which must be above "
            f"formation.safe_distance_m = {show(safe)}, that they must not come below",
        )
    least, name = (
        (distance, "avoidance.distance_m") if distance is not None else (safe, "formation.safe_distance_m")
    )
    if sensing is not None and least is not None and sensing <= least:
        reader.add(
            "avoidance.sensing_m",
            f"{show(sensing)} is too small: a robot must be listened to before it comes as near as "
            f"{name} = {show(least)}",
        )


def _check_supervision(values: Mapping[str, Any], reader: Reader) -> None:
    slow = values.get("supervision", {}).get("slow_after_s")
    horizon = values.get("control", {}).get("prediction_horizon_s")
    rate = values.get("fleet", {}).get("rate_hz")
    if slow is None:
        return
    if horizon is not None and slow >= horizon:
        reader.add(
            "supervision.slow_after_s",
            f"{show(slow)} is too long: a robot slows down before it gives a neighbour up, which it does "
            f"after control.prediction_horizon_s = {show(horizon)}; leave it out for three quarters of that",
        )
    elif rate is not None and slow < 2 / rate * (1 - 1e-9):
        reader.add(
            "supervision.slow_after_s",
            f"must be at least two periods, {2 / rate:.6g} s at fleet.rate_hz = {show(rate)}, "
            f"got {show(slow)}",
        )
