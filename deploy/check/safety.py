"""Checks of obstacles, geofence and avoidance against the places and paths of a fleet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import dist, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handfast.agent.control.boundaries import Circle, Polygon, fence_of, obstacles_of
from handfast.agent.control.hand import Pose, hand
from handfast.agent.control.limits import avoidance_distance, clearance, least_apart
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import FENCE_WARN_M
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.points import Floats
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.analysis.shapes import distances
from handfast.deploy.check.braking import check_braking, check_room, check_sudden
from handfast.deploy.check.finding import Finding, Level
from handfast.deploy.console.wording import NAMES_SHOWN, robots

_CELLS: Final = 256
"""Pieces that a drive is cut into at first."""
_NEAR_M: Final = 0.01
"""Ways are looked at until nothing deeper than this can be missed."""
_CELLS_MAX: Final = 200_000
_BISECTIONS: Final = 20


class Paths:
    """Where each member of a fleet is to be, over the whole drive; later orders are not looked at.

    Raises:
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        section = fleet.trajectory
        self.ids, self._offsets = geometry.ids, geometry.offsets
        self._trajectory = make_trajectory(section)
        self._speed = trajectory.maximum_speed(section)
        ends = trajectory.duration(section)
        self.end = min(fleet.fleet.duration_s, ends) if ends is not None else fleet.fleet.duration_s
        if section.kind == "circle" and section.radius_m is not None and self._speed > 0.0:
            self.end = min(self.end, 2.0 * pi * section.radius_m / self._speed)  # it comes round again

    def below(self, boundary: Circle | Polygon, limit: float) -> list[tuple[int, float]]:
        """Ids of members that are to be nearer than `limit` (m) to it at some time, each with the first one.

        Times in s. Between two looks a distance changes by no more than the way driven: so what may be missed
        is looked at again, until it is less than `_NEAR_M`.
        """
        half = 0.5 * self.end / _CELLS
        times = np.append((np.arange(_CELLS) + 0.5) * 2.0 * half, (0.0, self.end))
        who = np.repeat(np.arange(len(self.ids)), len(times))
        when = np.tile(times, len(self.ids))
        first = np.full(len(self.ids), np.inf)
        while len(when):
            away = distances(boundary, self._at(who, when))
            is_below = away < limit
            np.minimum.at(first, who[is_below], when[is_below])
            reach = self._speed * half
            again = ~is_below & (away - reach < limit)
            if reach <= _NEAR_M or 2 * np.count_nonzero(again) > _CELLS_MAX:
                break
            half *= 0.5
            who, when = np.repeat(who[again], 2), np.repeat(when[again], 2)
            when[::2] -= half
            when[1::2] += half
            when = np.clip(when, 0.0, self.end)
        rows = np.flatnonzero(np.isfinite(first))
        last, first = first[rows], np.maximum(first[rows] - self.end / _CELLS, 0.0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (first + last)
            is_below = distances(boundary, self._at(rows, middle)) < limit
            first, last = np.where(is_below, first, middle), np.where(is_below, middle, last)
        return [(self.ids[row], t) for row, t in zip(rows.tolist(), last.tolist(), strict=True)]

    def ends_below(self, boundary: Circle | Polygon, limit: float) -> list[int]:
        """Members whose last place is nearer than `limit` to the boundary."""
        rows = np.arange(len(self.ids))
        away = distances(boundary, self._at(rows, np.full(len(rows), self.end)))
        return [self.ids[row] for row in np.flatnonzero(away < limit).tolist()]

    def _at(self, who: NDArray[np.intp], when: Floats) -> Floats:
        times, back = np.unique(when, return_inverse=True)
        centre = np.array([self._trajectory.at(t)[:2] for t in times.tolist()]).reshape(-1, 2)
        places: Floats = centre[back] + self._offsets[who]
        return places


_GAPS_OBSTACLES_MAX: Final = 100
"""With more obstacles than this, gaps between them are not looked for: pairs grow with the square."""


def check_safety(fleet: Fleet, geometry: Geometry | None) -> Iterator[Finding]:
    """Everything worth saying about them; `geometry` is None for a formation that cannot be resolved."""
    obstacles, fence = obstacles_of(fleet), fence_of(fleet)
    keep = clearance(fleet.avoidance.clearance_m, fleet.formation.safe_distance_m)
    if obstacles and not fleet.avoidance.enabled:
        yield Finding(
            "warning",
            "avoidance.enabled",
            f"false: nothing keeps the robots away from {_named(obstacles)}; leave it out, or the obstacles",
        )
    yield from _starts(fleet, obstacles, fence, keep)
    yield from _gaps(obstacles, keep)
    yield from check_braking(fleet)
    if geometry is None:
        return
    yield from _distances(fleet, geometry)
    try:
        ways = Paths(fleet, geometry)
    except ValueError:
        return  # a trajectory that cannot be made: `deploy.check.check` says so
    yield from check_room(fleet, geometry)
    yield from check_sudden(fleet, geometry)
    for number, obstacle in enumerate(obstacles, 1):
        yield from _way_past(fleet, ways, number, obstacle, keep)
    if fence is not None:
        yield from _way_inside(fleet, ways, fence)


def _named(obstacles: Sequence[Circle | Polygon]) -> str:
    names = [obstacle.name for obstacle in obstacles[:NAMES_SHOWN]]
    more = f" and {len(obstacles) - NAMES_SHOWN} more" if len(obstacles) > NAMES_SHOWN else ""
    return ", ".join(names) + more


# --- starts --------------------------------------------------------------------------------------


def start_points(fleet: Fleet) -> Floats:
    """Hand points of all robots at the start, those in reserve too, (n, 2), m, W."""
    poses = [
        (Pose(robot.x_m, robot.y_m, robot.heading_rad, 0.0, 0.0), robot.hand_offset_m)
        for robot in fleet.robots
    ]
    return np.array([hand(pose, offset)[:2] for pose, offset in poses]).reshape(-1, 2)


def _starts(
    fleet: Fleet, obstacles: Sequence[Circle | Polygon], fence: Polygon | None, keep: float
) -> Iterator[Finding]:
    hands = start_points(fleet)
    for obstacle in obstacles:
        away = distances(obstacle, hands)
        yield from _start(
            fleet,
            away < 0.0,
            "error",
            f"inside {obstacle.name}: move or turn the robot, or move the obstacle",
        )
        yield from _start(
            fleet,
            (away >= 0.0) & (away < keep),
            "warning",
            f"nearer to {obstacle.name} than the clearance of {keep:.4g} m: driving away from it comes first",
        )
    if fence is not None and fleet.geofence is not None:
        away, warn = distances(fence, hands), FENCE_WARN_M
        yield from _start(
            fleet,
            away < 0.0,
            "error",
            "outside the geofence, where a robot holds: move or turn the robot, or move the fence",
        )
        yield from _start(
            fleet,
            (away >= 0.0) & (away < warn),
            "warning",
            f"nearer to the geofence than {warn:.4g} m: driving away from it comes first",
        )


def _start(fleet: Fleet, which: NDArray[np.bool_], level: Level, where: str) -> Iterator[Finding]:
    rows = np.flatnonzero(which).tolist()
    if rows:
        who = robots([fleet.robots[row].id for row in rows])
        start = "starts with its hand point" if len(rows) == 1 else "start with their hand points"
        yield Finding(level, f"robot[{rows[0] + 1}]", f"{who} {start} {where}")


# --- distances -----------------------------------------------------------------------------------


def parting(fleet: Fleet, geometry: Geometry) -> tuple[float, float]:
    """d_a, and the least distance (inf: none) that the formation puts between robots without an edge, m."""
    edges, offsets = _formation(geometry)
    given, safe = fleet.avoidance.distance_m, fleet.formation.safe_distance_m
    return avoidance_distance(given, safe, edges, offsets), least_apart(edges, offsets)


def _formation(
    geometry: Geometry,
) -> tuple[dict[tuple[int, int], float], dict[int, tuple[float, float]]]:
    """Distance of each edge by the ids at its ends, and place of each robot by its id."""
    ids = geometry.ids
    ends = [(ids[i], ids[j]) for i, j in geometry.edges.tolist()]
    places = [(x, y) for x, y in geometry.offsets.tolist()]
    edges = dict(zip(ends, geometry.distances.tolist(), strict=True))
    return edges, dict(zip(ids, places, strict=True))


def _distances(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """The distance of avoidance against what the formation itself asks for."""
    settings = fleet.avoidance
    if not settings.enabled:
        return
    distance, least = parting(fleet, geometry)
    if settings.distance_m is not None and distance > least:
        edges, offsets = _formation(geometry)
        pairs = [
            (i, j)
            for (i, a), (j, b) in combinations(offsets.items(), 2)
            if (i, j) not in edges and (j, i) not in edges and dist(a, b) < distance
        ]
        i, j = pairs[0]
        more = f" ({len(pairs)} such pairs in all)" if len(pairs) > 1 else ""
        yield Finding(
            "warning",
            "avoidance.distance_m",
            f"{distance:.4g} m is more than the formation puts between robots that share no edge, at least "
            f"{least:.4g} m: such robots, as {i} and {j}{more}, push each other from their places; take at "
            f"most {0.9 * least:.3g} m, leave it out, or join them by edges",
        )


def _gaps(obstacles: Sequence[Circle | Polygon], keep: float) -> Iterator[Finding]:
    """Gaps between obstacles that no hand point fits through."""
    if len(obstacles) > _GAPS_OBSTACLES_MAX:
        return
    gaps = [(_gap(a, b), a.name, b.name) for a, b in combinations(obstacles, 2)]
    narrow = [row for row in gaps if 0.0 < row[0] <= 2.0 * keep]
    if narrow:
        gap, a, b = min(narrow)
        more = f"; {len(narrow) - 1} more between obstacles are too narrow" if len(narrow) > 1 else ""
        yield Finding(
            "info",
            "obstacle",
            f"the gap between {a} and {b} is {gap:.3g} m wide, and a hand point needs more than twice the "
            f"clearance, {2.0 * keep:.3g} m: no robot drives through it{more}",
        )


def _gap(a: Circle | Polygon, b: Circle | Polygon) -> float:
    """Distance between two obstacles, m; not above 0 when they touch, or when one is inside the other."""
    gap = np.inf
    for one, other in ((a, b), (b, a)):
        if isinstance(one, Circle):
            gap = min(gap, float(distances(other, np.array([[one.x, one.y]]))[0]) - one.radius)
        else:  # the way between two polygons begins at a corner of one of them, unless they cross
            gap = min(gap, float(distances(other, np.array(one.points)).min()))
    return gap


# --- ways ----------------------------------------------------------------------------------------


def _way_past(
    fleet: Fleet, ways: Paths, number: int, obstacle: Circle | Polygon, keep: float
) -> Iterator[Finding]:
    found = ways.below(obstacle, keep)
    if not found:
        return
    near = f"{obstacle.name} or within {keep:.3g} m of it"
    lasting = fleet.trajectory.kind in ("hold", "waypoints")
    stay = ways.ends_below(obstacle, keep) if lasting else []
    if stay:
        message = (
            f"the formation comes to rest with the places of {robots(stay)} in {near}: nobody can stand "
            "there; move the end of the trajectory, the offsets or the obstacle"
        )
    else:
        message = f"the way of {_who(found)} leads through {near}: " + (
            "the law leads robots round it, which bends the formation, or it holds them up; best is a "
            "trajectory that goes clear"
            if fleet.avoidance.enabled
            else "with avoidance.enabled = false they would hit it"
        )
    yield Finding("warning", f"obstacle[{number}]", message)


def _way_inside(fleet: Fleet, ways: Paths, fence: Polygon) -> Iterator[Finding]:
    warn = FENCE_WARN_M
    outside, near = ways.below(fence, 0.0), ways.below(fence, warn)
    if outside:
        yield Finding(
            "error",
            "geofence.points_m",
            f"the way of {_who(outside)} leads out of the geofence, where robots hold: move the fence or the "
            "trajectory",
        )
    elif near:
        yield Finding(
            "warning",
            "geofence.points_m",
            f"the way of {_who(near)} leads nearer to the geofence than {warn:.4g} m, where robots are "
            "pushed back, off their places: take a wider fence",
        )


def _who(found: Sequence[tuple[int, float]]) -> str:
    """'robots 2 and 3 (first 3, at 4.2 s)'."""
    robot, t = min(found, key=lambda row: row[1])
    first = f"first {robot}, at" if len(found) > 1 else "at"
    return f"{robots([one for one, _ in found])} ({first} {t:.3g} s)"
