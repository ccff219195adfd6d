"""Realisation: places found from the edges of a formation graph and their distances (PURE, numpy only).

A graph has in general many realisations (a triangle can fold over an edge that it shares); the one sought
spreads out: it starts from the stress majorisation of the graph's shortest-path distances (Kamada & Kawai
1989, Gansner, Koren & North 2004), which pushes apart what no edge joins. Of several attempts, the
first is taken that meets the distances and keeps every pair further apart than the safe distance.
It is a search: it found 400 of 400 random rigid graphs of 3 to 16 robots and lattices of 190, but
it can miss for a large irregular graph, which then had better be given by offsets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from handfast.agent.fleet.model import FormationError
from handfast.agent.formation.points import (
    Floats,
    Indices,
    as_edges,
    as_places,
    best_turn,
    components,
    connected,
    distance_table,
    edge_lengths,
    pair_distances,
)

DISTANCE_TOLERANCE: Final = 0.01
"""Largest |realised - wanted| / wanted of an edge. Looser than rounding: users type 1.41 for sqrt 2."""

_ATTEMPTS: Final = 60  # starts of the realisation; fewer for large fleets

_FLATTENING: Final = (0.0, 0.03, 0.3, 3.0)  # weights on a point's height while a shape is unfolded

_GOLDEN: Final = 0.618033988749895

_PLASTIC: Final = 0.754877666246693


@dataclass(frozen=True, eq=False)
class Realisation:
    """Offsets found from edges and distances.

    Attributes:
        offsets: (n, 2), m.
        error: (m,), realised minus wanted distance, m.
    """

    offsets: Floats
    error: Floats


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
    rows = as_edges(edges)
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
        closest = float(pair_distances(places).min())
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
    before = as_places(places)
    rows, wanted = as_edges(edges), np.array(distances, np.float64)
    centre = before.mean(axis=0)
    shape = _refine(before - centre, rows, wanted)
    misfit = np.abs(edge_lengths(shape, rows) / wanted - 1.0).max()
    if misfit > DISTANCE_TOLERANCE or pair_distances(shape).min() <= safe_distance:
        shape = realise(len(before), rows, wanted, safe_distance).offsets
    near = best_turn(shape - shape.mean(axis=0), before - centre) + centre
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
        distance = distance_table(places)
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
