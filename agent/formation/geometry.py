"""Formation graph: where every robot's place is, which pairs hold a distance, and is that enough.

Pure (numpy only). Positions and offsets are in W (world ENU), m; arrays hold one robot or one edge
a row, in the order of the fleet file.

Slots
    Robot k's place in the file is slot k. With ``assign = true`` robots take slots by the least
    total squared distance between their hand points at the start and the slots' places at t = 0.
    The formation graph belongs to the slots: edge [1, 2] of the file then joins whichever robots
    take the first and the second robot's slot. So the shape and its graph are always the file's,
    and only who stands where changes. `resolve` gives offsets in the order of robots and edges
    between robots; order and distances of the edges stay the file's.

Realisation
    Without offsets the places are found from the edges and their distances. A graph has in general
    many realisations (a triangle can fold over an edge that it shares); the one sought spreads out:
    it starts from the stress majorisation of the graph's shortest-path distances (Kamada & Kawai
    1989, Gansner, Koren & North 2004), which pushes apart what no edge joins. Of several attempts, the
    first is taken that meets the distances and keeps every pair further apart than the safe distance.
    It is a search: it found 400 of 400 random rigid graphs of 3 to 16 robots and lattices of 190, but
    it can miss for a large irregular graph, which then had better be given by offsets.
    The shape is then free to be turned, mirrored and moved: it is centred on the reference point
    and turned (mirrored) so that the robots have the least to drive (Procrustes).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, sin
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent.common.schema import Problem
from agent.fleet.fleet import Fleet, FleetError
from agent.formation.trajectory import make_trajectory

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

DISTANCE_TOLERANCE: Final = 0.01
"""Largest |realised - wanted| / wanted of an edge. Looser than rounding: users type 1.41 for sqrt 2."""

_RANK_TOLERANCE: Final = 1e-7  # of the largest singular value of the rigidity matrix with unit rows
_MOTION_TOLERANCE: Final = 1e-6  # of a unit motion: what a robot must move by to count as moving
_ATTEMPTS: Final = 60  # starts of the realisation; fewer for large fleets
_FLATTENING: Final = (0.0, 0.03, 0.3, 3.0)  # weights on a point's height while a shape is unfolded
_GOLDEN: Final = 0.618033988749895
_PLASTIC: Final = 0.754877666246693


class FormationError(FleetError):
    """The file's formation is not one: the message names the field, the values and what is wrong."""

    def __init__(self, message: str) -> None:
        super().__init__("[formation]", [Problem("", message)])
        self.message = message

    def __str__(self) -> str:
        return self.message


@dataclass(frozen=True, eq=False)
class Geometry:
    """A resolved formation: robots with the places that they take. Arrays are read-only.

    Attributes:
        ids: members' ids, in the order of the fleet file.
        offsets: (n, 2), place of each robot relative to the reference point c(t), W, m.
        edges: (m, 2), rows of the robots that each edge joins, in the file's order of edges.
        distances: (m,), wanted distance of each edge, m.
    """

    ids: tuple[int, ...]
    offsets: Floats
    edges: Indices
    distances: Floats


@dataclass(frozen=True, eq=False)
class Realisation:
    """Offsets found from edges and distances.

    Attributes:
        offsets: (n, 2), m.
        error: (m,), realised minus wanted distance, m.
    """

    offsets: Floats
    error: Floats


def resolve(fleet: Fleet) -> Geometry:
    """The formation that the fleet drives: offsets found, distances written out, slots assigned.

    Offsets and distances that the file gives are taken as they are, also where they contradict each
    other (`deploy.check.check` says so); what it does not give comes from the other.

    Raises:
        FormationError: fields that do not fit together (an edge names an unknown robot or joins a robot
            with itself or twice the same pair, numbers of offsets or distances that differ from the
            numbers of robots or edges, neither offsets nor distances, not finite, distances not
            above zero), or distances that no placement in the plane meets within `DISTANCE_TOLERANCE`.
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """
    ids = tuple(robot.id for robot in fleet.members)
    edges = edge_indices(fleet)
    offsets = given_offsets(fleet)
    distances = given_distances(fleet)
    hands = start_hands(fleet)
    x, y = make_trajectory(fleet.trajectory).at(0.0)[:2]
    starts = hands - (x, y)  # as seen from the reference; sums of squares do not depend on it
    slots = np.arange(len(ids))
    if offsets is not None:
        if distances is None:
            distances = edge_lengths(offsets, edges)
        if fleet.formation.assign:
            slots = np.array(assign_slots(_square_distances(starts, offsets)), np.intp)
    elif distances is not None:
        shape = realise(len(ids), edges, distances, fleet.formation.safe_distance_m)
        _refuse_misfit(fleet, shape, distances)
        offsets, slots = _place(shape.offsets, starts, fleet.formation.assign)
    else:
        raise FormationError("formation needs offsets, distance_m, or both: neither is given")
    robot_of_slot = np.empty(len(ids), np.intp)
    robot_of_slot[slots] = np.arange(len(ids))
    return Geometry(
        ids, _frozen(offsets[slots]), _frozen(robot_of_slot[edges]), _frozen(np.array(distances, np.float64))
    )


def resolved(fleet: Fleet) -> Fleet:
    """The same fleet with its formation written out, so that robots need not resolve it again.

    Offsets in the order of robots, edges by the robots that take their slots, one distance an edge,
    ``assign = false``. Nothing is rounded: `resolve` of the result is the same geometry.

    Raises:
        FormationError, ValueError: as `resolve`.
    """
    geometry = resolve(fleet)
    ids = geometry.ids
    formation = replace(
        fleet.formation,
        offsets=tuple((float(x), float(y)) for x, y in geometry.offsets),
        edges=tuple((ids[i], ids[j]) for i, j in geometry.edges.tolist()),
        distance_m=tuple(geometry.distances.tolist()),
        assign=False,
    )
    return replace(fleet, formation=formation)


def edge_indices(fleet: Fleet) -> Indices:
    """Edges of the file as rows of [[robot]], (m, 2), before any assignment.

    Raises:
        FormationError: ids not unique, an edge with an unknown robot, with itself, or listed twice.
    """
    members = fleet.members
    row = {robot.id: k for k, robot in enumerate(members)}
    if not members:
        raise FormationError("the fleet has no [[robot]] that is not in reserve")
    if len(row) != len(members):
        raise FormationError("robot.id must be unique")
    seen: set[frozenset[int]] = set()
    for i, j in fleet.formation.edges:
        for robot in (i, j):
            if robot not in row:
                raise FormationError(
                    f"formation.edges: [{i}, {j}] names robot {robot}, which does not exist, or is in reserve"
                )
        if i == j:
            raise FormationError(f"formation.edges: [{i}, {j}] joins a robot with itself")
        if frozenset((i, j)) in seen:
            raise FormationError(f"formation.edges: [{i}, {j}] is listed twice")
        seen.add(frozenset((i, j)))
    return np.array([(row[i], row[j]) for i, j in fleet.formation.edges], np.intp).reshape(-1, 2)


def given_offsets(fleet: Fleet) -> Floats | None:
    """The file's offsets, (n, 2), m, slot by slot; None when it gives none (a single robot's is zero)."""
    if fleet.formation.offsets is None:
        return np.zeros((1, 2)) if len(fleet.members) == 1 else None
    offsets = np.array(fleet.formation.offsets, np.float64).reshape(-1, 2)
    if len(offsets) != len(fleet.members):
        raise FormationError(f"formation.offsets has {len(offsets)} places for {len(fleet.members)} robots")
    if not np.isfinite(offsets).all():
        raise FormationError("formation.offsets must be finite")
    return offsets


def given_distances(fleet: Fleet) -> Floats | None:
    """The file's distances, (m,), m, one an edge; None when it gives none."""
    wanted = fleet.formation.distance_m
    if wanted is None:
        return None
    edges = len(fleet.formation.edges)
    distances = np.full(edges, wanted) if isinstance(wanted, int | float) else np.array(wanted, np.float64)
    if distances.shape != (edges,):
        raise FormationError(f"formation.distance_m has {len(distances)} distances for {edges} edges")
    if not (np.isfinite(distances).all() and (distances > 0.0).all()):
        raise FormationError(f"formation.distance_m must be above zero, not {wanted}")
    return distances


def start_hands(fleet: Fleet) -> Floats:
    """Hand points of the members at the start, (n, 2), W, m: x + L cos, y + L sin, (2)-(3)."""
    return np.array(
        [
            (r.x_m + r.hand_offset_m * cos(r.heading_rad), r.y_m + r.hand_offset_m * sin(r.heading_rad))
            for r in fleet.members
        ]
    ).reshape(-1, 2)


def edge_lengths(offsets: Floats, edges: Indices) -> Floats:
    """Distance between the two ends of every edge, (m,), m."""
    difference = offsets[edges[:, 0]] - offsets[edges[:, 1]]
    return np.hypot(difference[:, 0], difference[:, 1])


def assign_slots(cost: Any) -> tuple[int, ...]:
    """Slot of every robot, so that the total cost is least (linear assignment problem).

    Shortest augmenting paths with dual potentials (Jonker & Volgenant 1987; Crouse 2016), O(n^3), each
    step vectorised over the slots. Deterministic: of equal costs the lowest slot is tried first.

    Args:
        cost: (n, n), cost of robot (row) in slot (column).

    Raises:
        ValueError: not square, or not finite.
    """
    table = np.array(cost, np.float64)
    if table.ndim != 2 or table.shape[0] != table.shape[1]:
        raise ValueError(f"cost must be square, not of shape {table.shape}")
    if not np.isfinite(table).all():
        raise ValueError("cost must be finite")
    n = len(table)
    robot_price = np.zeros(n)
    slot_price = table.min(axis=0) if n else np.zeros(0)
    slot_of = np.full(n, -1)
    robot_in = np.full(n, -1)
    for start in range(n):
        shortest = np.full(n, np.inf)  # cheapest way to each slot from `start`
        closed = np.zeros(n, bool)  # slots whose way is final
        before = np.full(n, -1)  # robot that each way comes from
        tree = []  # robots on the ways, `start` aside
        robot, reached = start, 0.0
        while True:
            way = reached + table[robot] - robot_price[robot] - slot_price
            better = (way < shortest) & ~closed
            shortest[better] = way[better]
            before[better] = robot
            slot = int(np.argmin(np.where(closed, np.inf, shortest)))
            reached = float(shortest[slot])
            closed[slot] = True
            if robot_in[slot] < 0:
                break
            robot = int(robot_in[slot])
            tree.append(robot)
        robot_price[start] += reached
        if tree:
            robot_price[tree] += reached - shortest[slot_of[tree]]
        slot_price[closed] -= reached - shortest[closed]
        while True:  # hand the slots on, back along the way
            robot = int(before[slot])
            robot_in[slot] = robot
            slot, slot_of[robot] = int(slot_of[robot]), slot
            if robot == start:
                break
    return tuple(int(slot) for slot in slot_of)


# --- graph ---------------------------------------------------------------------------------------


def components(n: int, edges: Any) -> tuple[tuple[int, ...], ...]:
    """Connected parts of a graph of n vertices with edges (m, 2), each sorted, by their least vertex."""
    parent = list(range(n))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = parent[vertex]
        return vertex

    for i, j in _edge_rows(edges).tolist():
        a, b = root(i), root(j)
        parent[max(a, b)] = min(a, b)
    parts: dict[int, list[int]] = {}
    for vertex in range(n):
        parts.setdefault(root(vertex), []).append(vertex)
    return tuple(tuple(part) for part in parts.values())


def connected(n: int, edges: Any) -> bool:
    """Is there a way along edges (m, 2) between any two of n vertices. One vertex alone is connected."""
    return len(components(n, edges)) <= 1


def rigidity_matrix(offsets: Any, edges: Any) -> Floats:
    """Rows of unit edges, (m, 2n): row e times the robots' velocities is the rate of e's distance.

    Columns are x and y of robot 0, x and y of robot 1, ... An edge of no length has a row of zeros.
    """
    places = _places(offsets)
    rows = _edge_rows(edges)
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
    n = len(_places(offsets))
    return n <= 1 or rigidity_rank(offsets, edges) == 2 * n - 3


def is_collinear(offsets: Any) -> bool:
    """Do all places lie on one line (or point), within 1e-6 of their spread."""
    places = _places(offsets)
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
    places = _places(offsets)
    rows = _edge_rows(edges)
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


# --- realisation ---------------------------------------------------------------------------------


def realise(n: int, edges: Any, distances: Any, safe_distance: float = 0.0) -> Realisation:
    """Places of n robots in the plane that meet the edges' distances as nearly as they can.

    The first attempt that meets them within `DISTANCE_TOLERANCE` and keeps all pairs further apart
    than `safe_distance` is taken; else the best of all: distances met first, closest pair second. The
    centroid is zero, the orientation arbitrary. Never raises on distances that
    cannot be met: see `Realisation.error`.

    Args:
        edges: (m, 2) rows; distances: (m,), m, above zero; safe_distance: m.

    Raises:
        FormationError: the graph is not connected (its parts have no place relative to one another).
    """
    rows = _edge_rows(edges)
    wanted = np.array(distances, np.float64)
    if not connected(n, rows):
        parts = components(n, rows)
        raise FormationError(
            f"formation.edges leave {len(parts)} parts without an edge between them: no offsets can be found"
        )
    if n <= 1:
        return Realisation(np.zeros((n, 2)), np.zeros(len(rows)))
    targets = _path_lengths(n, rows, wanted)
    scale = float(wanted.mean())
    first = _classical_scaling(targets)
    best: tuple[tuple[bool, float], Realisation] | None = None
    for attempt in range(max(4, min(_ATTEMPTS, 1000 // n))):
        if attempt == 0:
            places = _refine(_majorise(first, targets), rows, wanted)
        else:
            places = _unfold(first, attempt, scale, rows, wanted)
        places -= places.mean(axis=0)
        error = edge_lengths(places, rows) - wanted
        misfit = float(np.abs(error / wanted).max())
        closest = float(_pair_distances(places).min())
        met = misfit <= DISTANCE_TOLERANCE
        found = Realisation(places, error)
        if met and closest > safe_distance:
            return found
        merit = (met, closest if met else -misfit)
        if best is None or merit > best[0]:
            best = (merit, found)
    assert best is not None
    return best[1]


def realise_near(places: Any, edges: Any, distances: Any, safe_distance: float = 0.0) -> Realisation:
    """Places that meet other distances, as near to the given ones as they can be.

    First from the given places on, so that the formation is stretched and not folded; where that misses the
    distances, or brings a pair within `safe_distance`, as `realise`. The centroid stays, and
    the shape is turned (mirrored) so that the robots have the least to drive.

    Args:
        places: (n, 2), m; edges: (m, 2) rows, at least one; distances: (m,), m, above zero; safe_distance: m.

    Raises:
        FormationError: it must be as `realise`, and the graph is not connected.
    """
    before = _places(places)
    rows, wanted = _edge_rows(edges), np.array(distances, np.float64)
    centre = before.mean(axis=0)
    shape = _refine(before - centre, rows, wanted)
    misfit = np.abs(edge_lengths(shape, rows) / wanted - 1.0).max()
    if misfit > DISTANCE_TOLERANCE or _pair_distances(shape).min() <= safe_distance:
        shape = realise(len(before), rows, wanted, safe_distance).offsets
    near = _turn(shape - shape.mean(axis=0), before - centre) + centre
    return Realisation(near, edge_lengths(near, rows) - wanted)


def _path_lengths(n: int, edges: Indices, distances: Floats) -> Floats:
    """Shortest-path lengths between all vertices, (n, n) (Floyd & Warshall)."""
    table = np.full((n, n), np.inf)
    table[edges[:, 0], edges[:, 1]] = table[edges[:, 1], edges[:, 0]] = distances
    np.fill_diagonal(table, 0.0)
    for via in range(n):
        np.minimum(table, table[:, via : via + 1] + table[via], out=table)
    return table


def _classical_scaling(targets: Floats) -> Floats:
    """Points in the plane whose distances are near `targets` (n, n): Torgerson's classical scaling."""
    n = len(targets)
    centring = np.eye(n) - 1.0 / n
    values, vectors = np.linalg.eigh(-0.5 * centring @ (targets * targets) @ centring)
    points = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    # An eigenvector's sign is the library's choice: fix it, so that every machine finds the same.
    for axis in range(points.shape[1]):
        if points[np.argmax(np.abs(points[:, axis])), axis] < 0.0:
            points[:, axis] *= -1.0
    # Points all in one line (a chain) give no way out of it to what must leave it: shake a little.
    shaken: Floats = points + _scatter(n, 0) * 1e-3 * targets.max()
    return shaken


def _scatter(n: int, seed: int) -> Floats:
    """n points spread evenly over [-1/2, 1/2]^2, (n, 2): an additive recurrence, no randomness."""
    index = np.arange(1, n + 1) + n * seed
    return np.column_stack([(index * _PLASTIC) % 1.0, (index * _PLASTIC * _PLASTIC) % 1.0]) - 0.5


def _majorise(places: Floats, targets: Floats) -> Floats:
    """Stress majorisation with weights 1 / target^2 over all pairs (Gansner, Koren & North 2004)."""
    n = len(places)
    weights = 1.0 / np.where(targets > 0.0, targets, np.inf) ** 2
    laplacian = np.diag(weights.sum(axis=1)) - weights
    # Its null space is known, so this is the pseudo-inverse.
    inverse: Floats = np.asarray(np.linalg.inv(laplacian + 1.0 / n) - 1.0 / n, np.float64)
    pull = weights * targets
    for _ in range(100):
        distance = _distance_table(places)
        ratio = pull / np.where(distance > 1e-12, distance, np.inf)
        moved: Floats = np.asarray(inverse @ (np.diag(ratio.sum(axis=1)) - ratio) @ places, np.float64)
        if np.abs(moved - places).max() < 1e-5 * targets.max():
            return moved
        places = moved
    return places


def _unfold(first: Floats, attempt: int, scale: float, edges: Indices, wanted: Floats) -> Floats:
    """Another realisation: lifted out of the plane, met there, pressed flat step by step; (n, 2).

    In the plane a robot that starts on the wrong side of an edge cannot pass it without passing through
    worse misfits; in space it goes round.
    """
    n = len(first)
    spread = np.ptp(first, axis=0).max() + scale
    shake = np.column_stack([_scatter(n, attempt), _scatter(n, attempt + _ATTEMPTS)[:, :1]])
    places = np.column_stack([first, np.zeros(n)]) + shake * spread * (0.2 + 0.2 * (attempt % 5))
    for weight in _FLATTENING:
        places = _refine(places, edges, wanted, weight, steps=60)
    return _refine(places[:, :2], edges, wanted)


def _refine(places: Floats, edges: Indices, wanted: Floats, flatten: float = 0.0, steps: int = 200) -> Floats:
    """Levenberg-Marquardt on the residuals |p_i - p_j| - d of the edges alone; (n, k) -> (n, k), k = 2 or 3.

    Args:
        flatten: weight of the residual flatten z of every point's third coordinate.
    """
    n, dimensions = places.shape
    edge, heights = np.arange(len(edges)), np.arange(2, 3 * n, 3)
    floor = (1e-14 * float(wanted.max())) ** 2 * len(wanted)
    damping = 1e-3

    def misfit(candidate: Floats) -> tuple[float, Floats, Floats, Floats]:
        difference = candidate[edges[:, 0]] - candidate[edges[:, 1]]
        length = np.maximum(np.sqrt(np.sum(difference * difference, axis=1)), 1e-12 * float(wanted.max()))
        error = length - wanted
        height = flatten * candidate[:, 2] if flatten else np.zeros(0)
        return float(error @ error + height @ height), error, difference / length[:, None], height

    cost, error, normal, height = misfit(places)
    for _ in range(steps):
        if cost <= floor:
            break
        jacobian = np.zeros((len(edges), dimensions * n))
        for axis in range(dimensions):
            jacobian[edge, dimensions * edges[:, 0] + axis] = normal[:, axis]
            jacobian[edge, dimensions * edges[:, 1] + axis] = -normal[:, axis]
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ error
        if flatten:
            hessian[heights, heights] += flatten * flatten
            gradient[heights] += flatten * height
        while True:
            damped = hessian.copy()
            damped[np.diag_indices_from(damped)] += damping  # also what fixes the free motion as a body
            trial = places - np.linalg.solve(damped, gradient).reshape(n, dimensions)
            candidate = misfit(trial)
            if candidate[0] < cost or damping > 1e6:
                break
            damping *= 4.0
        if not candidate[0] < cost:
            break
        stalled = candidate[0] > cost * (1.0 - 1e-7)
        places, (cost, error, normal, height) = trial, candidate
        damping = max(damping * 0.2, 1e-12)
        if stalled:
            break
    return places


def worst_edge(shape: Realisation, distances: Floats) -> int:
    """The edge whose length is furthest off, as a share of its distance (m, m >= 1); of equals the first.

    Equal but for rounding, that is, which differs from machine to machine.
    """
    share = np.abs(shape.error) / distances
    return int(np.argmax(share >= np.max(share) * (1.0 - 1e-6)))


def _refuse_misfit(fleet: Fleet, shape: Realisation, distances: Floats) -> None:
    if not len(distances):
        return
    worst = worst_edge(shape, distances)
    if abs(shape.error[worst]) <= DISTANCE_TOLERANCE * distances[worst]:
        return
    i, j = fleet.formation.edges[worst]
    raise FormationError(
        f"formation.distance_m: found no places in the plane that meet all {len(distances)} distances; in "
        f"the nearest [{i}, {j}] is {distances[worst] + shape.error[worst]:.4g} m long instead of "
        f"{distances[worst]:.4g} m "
        f"(root mean square over all edges {np.sqrt(np.mean(shape.error**2)):.3g} m)"
    )


def _place(shape: Floats, starts: Floats, assign: bool) -> tuple[Floats, Indices]:
    """Turn (and mirror) a centred shape so that the robots have the least to drive; and their slots.

    With `assign`, turning and assigning take turns until nothing changes, which lowers the total
    squared distance each time; from several angles, as it ends in a local minimum.
    """
    n = len(shape)
    slots = np.arange(n)
    if not assign:
        return _turn(shape, starts), slots
    best, best_cost = (_turn(shape, starts), slots), np.inf
    angles = max(1, min(8, 160 // max(n, 1)))
    for start in range(2 * angles):
        angle = np.pi * 2.0 * (start // 2) / angles
        turned = shape @ np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])
        if start % 2:
            turned[:, 0] *= -1.0
        for _ in range(20):
            new = np.array(assign_slots(_square_distances(starts, turned)), np.intp)
            moved = np.empty_like(starts)
            moved[new] = starts
            turned = _turn(shape, moved)
            cost = float(np.sum((moved - turned) ** 2))
            if cost < best_cost * (1.0 - 1e-12):
                best, best_cost = (turned, new), cost
            if np.array_equal(new, slots):
                break
            slots = new
    return best


def _turn(shape: Floats, starts: Floats) -> Floats:
    """`shape` turned and mirrored to come nearest to `starts`, row by row (Procrustes), (n, 2)."""
    left, _, right = np.linalg.svd(shape.T @ starts)
    turned: Floats = shape @ (left @ right)
    return turned


def _square_distances(a: Floats, b: Floats) -> Floats:
    """|a_i - b_k|^2, (n, n)."""
    difference = a[:, None, :] - b[None, :, :]
    squares: Floats = np.sum(difference * difference, axis=2)
    return squares


def _distance_table(places: Floats) -> Floats:
    table: Floats = np.sqrt(_square_distances(places, places))
    return table


def _pair_distances(places: Floats) -> Floats:
    """Distances of all pairs, (n (n - 1) / 2,)."""
    i, j = np.triu_indices(len(places), 1)
    apart: Floats = np.hypot(places[i, 0] - places[j, 0], places[i, 1] - places[j, 1])
    return apart


def _places(offsets: Any) -> Floats:
    return np.asarray(offsets, np.float64).reshape(-1, 2)


def _edge_rows(edges: Any) -> Indices:
    return np.asarray(edges, np.intp).reshape(-1, 2)


def _frozen(array: Any) -> Any:
    array.setflags(write=False)
    return array
