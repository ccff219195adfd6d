"""Shapes: distances of many points from a boundary, rigidity of a formation, and lattices (numpy only).

Offsets have shape (n, 2), in m; edges have shape (m, 2) and hold rows of the robots that they join. The
lattice is a fleet file of any size, to study large fleets with.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import hypot, sqrt
from random import Random
from textwrap import fill
from typing import Any, Final

import numpy as np

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.formation.points import Floats, as_edges, as_places


def distances(boundary: Circle | Polygon, points: Floats) -> Floats:
    """Signed distance (m) of points (k, 2) from a boundary, (k,): above 0 on its allowed side.

    That is the `distance` of the first one that `agent.control.boundaries.Boundary.near` returns. Points
    that are not finite give nan.
    """
    x, y = points[:, 0], points[:, 1]
    if isinstance(boundary, Circle):
        round_one: Floats = np.hypot(x - boundary.x, y - boundary.y) - boundary.radius
        return round_one
    corners = boundary.points
    least = np.full(len(points), np.inf)
    is_inside = np.zeros(len(points), np.bool_)
    for (ax, ay), (bx, by) in zip(corners, (*corners[1:], corners[0]), strict=True):
        dx, dy = bx - ax, by - ay
        rx, ry = x - ax, y - ay
        along = np.clip((rx * dx + ry * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        least = np.minimum(least, np.hypot(rx - along * dx, ry - along * dy))
        # A ray to the east crosses the side: an odd number of times from inside.
        is_across = (ay > y) != (by > y)
        is_left = (rx * dy < ry * dx) == (dy > 0.0)
        is_inside ^= is_across & is_left
    return np.where(is_inside == boundary.inside, least, -least)


_RANK_TOLERANCE: Final = 1e-7  # of the largest singular value of the rigidity matrix with unit rows

_MOTION_TOLERANCE: Final = 1e-6  # of a unit motion: what a robot must move by to count as moving


def rigidity_matrix(offsets: Any, edges: Any) -> Floats:
    """Rows of unit edges, (m, 2n): row e times the robots' velocities is the rate of e's distance.

    Columns are x and y of robot 0, x and y of robot 1, ... An edge of no length has a row of zeros.
    """
    places = as_places(offsets)
    rows = as_edges(edges)
    difference = places[rows[:, 0]] - places[rows[:, 1]]
    length = np.hypot(difference[:, 0], difference[:, 1])
    normal = difference / np.where(length > 0.0, length, 1.0)[:, None]
    matrix = np.zeros((len(rows), 2 * len(places)))
    edge = np.arange(len(rows))
    for axis in (0, 1):
        matrix[edge, 2 * rows[:, 0] + axis] = normal[:, axis]
        matrix[edge, 2 * rows[:, 1] + axis] = -normal[:, axis]
    return matrix


def rigidity_rank(offsets: Any, edges: Any) -> int:
    """Rank of the rigidity matrix: how many independent motions the distances hold."""
    matrix = rigidity_matrix(offsets, edges)
    if not matrix.size:
        return 0
    values = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(values > _RANK_TOLERANCE * max(values[0], 1e-300)))


def is_rigid(offsets: Any, edges: Any) -> bool:
    """Infinitesimally rigid in the plane: rank 2n - 3, so only moving and turning as one is free.

    One robot is rigid; so are two with an edge. Robots all in one line are not, unless they are two:
    a small move across the line changes no distance to first order.
    """
    n = len(as_places(offsets))
    return n <= 1 or rigidity_rank(offsets, edges) == 2 * n - 3


def is_collinear(offsets: Any) -> bool:
    """Do all places lie on one line (or point), within 1e-6 of their spread."""
    places = as_places(offsets)
    if len(places) <= 2:
        return True
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(values[1] <= 1e-6 * values[0])


def loose(offsets: Any, edges: Any) -> tuple[int, ...]:
    """Robots (rows) that can move, to first order, while no edge changes its length.

    Seen from the largest rigid part: the robots that stand still in every motion of the null space
    of the rigidity matrix, once the motion of an edge's two ends as one body is taken off. Empty when
    the formation is rigid; of equally large parts, the one with the first edge is taken as fixed.
    """
    places = as_places(offsets)
    rows = as_edges(edges)
    n = len(places)
    if is_rigid(places, rows):
        return ()
    if not len(rows):
        return tuple(range(1, n))
    _, values, turned = np.linalg.svd(rigidity_matrix(places, rows))
    rank = int(np.count_nonzero(values > _RANK_TOLERANCE * values[0]))
    motions = turned[rank:].reshape(-1, n, 2)  # (f, n, 2)
    best = np.zeros(n, bool)
    for i, j in rows.tolist():
        arm = places[j] - places[i]
        square = float(arm @ arm)
        if square == 0.0:
            continue
        slide = motions[:, j] - motions[:, i]  # across the arm only: the edge keeps its length
        turn = (arm[0] * slide[:, 1] - arm[1] * slide[:, 0]) / square  # rad/s of the edge, (f,)
        reach = places - places[i]
        body = np.stack([-np.outer(turn, reach[:, 1]), np.outer(turn, reach[:, 0])], axis=2)
        left = motions - motions[:, i : i + 1] - body
        still = np.abs(left).max(axis=(0, 2)) < _MOTION_TOLERANCE
        if np.count_nonzero(still) > np.count_nonzero(best):
            best = still
    if not best.any():  # every edge has no length
        return tuple(range(1, n))
    return tuple(int(robot) for robot in np.flatnonzero(~best))


ROBOTS_MIN: Final = 3
ROBOTS_MAX: Final = 1000
SIDE_M: Final = 1.0
REACH_M: Final = 1.1 * SIDE_M
"""Robots are joined by an edge whose places are nearer: the six next to each, and no others."""
ASPECT: Final = 0.93
"""Columns of a patch that is as wide as high are so many times the root of the robots."""
SCATTER_M: Final = 0.15
SEED: Final = 1
RATE_HZ: Final = 10.0
DURATION_S: Final = 60.0
TIMEOUT_S: Final = 0.2
TIMEOUT_PERIODS: Final = 3.0
"""Agent and plant wait so long for each other, and so many periods at least."""
FALLING_HZ: Final = 8.0
"""From this rate on the fleet can fall to half of it (4 Hz is the lowest to which any can,
`agent.control.limits`). Many robots of one machine need that: where it is late, and the fleet cannot fall to
a lower rate, all stand."""
FALLING_PERIODS: Final = 4.5
"""Then agent and plant wait so many periods for each other: two of the lower rate, and a little more."""
SPEED_M: Final = 0.15
"""Robots go so far in a period of the lowest rate at most: those that may be faster listen to each other from
further away."""
KP: Final = 1.0
KP_BY_HZ: Final = 0.125
"""Slower robots are pulled into shape less: else they may fold it (docs/theory.md)."""


def places(robots: int) -> list[tuple[float, float]]:
    """The places (x, y) of a patch that is about as wide as high, row by row from the top, around (0, 0)."""
    columns = max(1, round(ASPECT * sqrt(robots)))
    rough = []
    for k in range(robots):
        row, column = divmod(k, columns)
        # Of a last row that is not full, even its first robot hangs on two of the row above.
        shift = 0.5 if row % 2 else float(robots - row * columns < columns)
        rough.append((SIDE_M * (column + shift), -SIDE_M * sqrt(0.75) * row))
    middle_x, middle_y = (sum(values) / robots for values in zip(*rough, strict=True))
    return [(round(x - middle_x, 4), round(y - middle_y, 4)) for x, y in rough]


def edges(spots: list[tuple[float, float]]) -> list[tuple[int, int]]:
    """Numbers (from 1) of those whose places are next to each other."""
    return [
        (i + 1, j + 1)
        for i, (x, y) in enumerate(spots)
        for j, (u, v) in enumerate(spots[i + 1 :], i + 1)
        if hypot(x - u, y - v) < REACH_M
    ]


def lattice(
    name: str, robots: int, *, rate_hz: float = RATE_HZ, duration_s: float = DURATION_S, seed: int = SEED
) -> str:
    """The text of a fleet file: `robots` in a lattice of 1 m that drives round a circle.

    Each starts within `SCATTER_M` of its place in x and in y, drawn from `seed`, and heads east.
    """
    spots, random = places(robots), Random(seed)
    joined = edges(spots)
    falls = rate_hz >= FALLING_HZ
    lowest_hz = 0.5 * rate_hz if falls else rate_hz
    timeout_s = max(TIMEOUT_S, (FALLING_PERIODS if falls else TIMEOUT_PERIODS) / rate_hz)
    limits = f"\nrate_min_hz = {lowest_hz:g}" if falls else ""
    limits += f"\nmax_speed_mps = {SPEED_M * lowest_hz:g}" if lowest_hz < RATE_HZ else ""
    rows = []
    for number, (x, y) in enumerate(spots, 1):
        at = x + random.uniform(-SCATTER_M, SCATTER_M), y + random.uniform(-SCATTER_M, SCATTER_M)
        rows.append(f"    {{ id = {number}, x_m = {at[0]:.3f}, y_m = {at[1]:.3f} }},")
    return f"""\
# {robots} robots in a triangular lattice of {SIDE_M:g} m, each tied to those next to it, on a circle.
#
#     handfast check {name}.toml       what is wrong with it, what it will do, and what it costs
#     handfast simulate {name}.toml    drive it in virtual time, however many there are
#     handfast run {name}.toml         drive it as processes on this machine
#
# Every field is described in docs/fleet-file.md.

# One line per robot, to keep the file short: the same as {robots} [[robot]] tables.
robot = [
{chr(10).join(rows)}
]

[fleet]
name = "{name}"
description = "{robots} robots in a triangular lattice, on a circle"
rate_hz = {rate_hz:g}
duration_s = {duration_s:g}

[formation]
safe_distance_m = 0.22
distance_m = {SIDE_M:g}
offsets = [
{_lines(f"[{x}, {y}]" for x, y in spots)}
]
edges = [
{_lines(f"[{i}, {j}]" for i, j in joined)}
]

[control]
coupling = "joint"
kp = {min(KP, KP_BY_HZ * rate_hz):g}
plant_timeout_s = {timeout_s:g}
wrench_timeout_s = {timeout_s:g}{limits}

[trajectory]
kind = "circle"
centre_m = [0.0, 4.0]
radius_m = 4.0
speed_mps = 0.3
phase_rad = "-90deg"  # starts at the origin, amid the robots

[robot_defaults]
hand_offset_m = 0.15  # one that is nearer to the axle would turn too fast for low rates
"""


def _lines(items: Iterable[str]) -> str:
    """Items of an array, as many on a line as are read at a glance."""
    text = ", ".join(item.replace(" ", "\0") for item in items) + ","
    return fill(text, 100, initial_indent="    ", subsequent_indent="    ").replace("\0", " ")
