"""Formation over any points and graphs: assignment is optimal, distances are met, rigidity is invariant."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import (
    ControlSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.formation.points import assign_slots, edge_lengths
from handfast.agent.formation.realisation import DISTANCE_TOLERANCE, realise

SEEDS = st.integers(0, 2**32 - 1)


def scattered(seed: int, n: int, gap: float = 0.3) -> np.ndarray:
    """n points at least `gap` apart on a square that leaves room."""
    generator = np.random.default_rng(seed)
    points: list[np.ndarray] = []
    while len(points) < n:
        candidate = generator.random(2) * 1.2 * np.sqrt(n)
        if all(np.hypot(*(candidate - other)) > gap for other in points):
            points.append(candidate)
    return np.array(points)


def grown(points: np.ndarray) -> np.ndarray:
    """A rigid graph: each point joined to its three nearest earlier ones (trilateration)."""
    edges = []
    for k in range(1, len(points)):
        nearest = np.argsort(np.hypot(*(points[:k] - points[k]).T))[:3]
        edges += [(int(j), k) for j in nearest]
    return np.array(edges)


@given(st.integers(1, 6), SEEDS, st.sampled_from([1.0, 1e-6, 1e6]), st.booleans())
@settings(max_examples=80, deadline=None)
def test_assignment_is_the_best_of_all_permutations(n: int, seed: int, scale: float, ties: bool):
    cost = np.random.default_rng(seed).normal(size=(n, n)) * scale
    if ties:
        cost = np.round(cost / scale)
    slots = assign_slots(cost)
    assert sorted(slots) == list(range(n))
    best = min(sum(cost[i, p[i]] for i in range(n)) for p in permutations(range(n)))
    assert sum(cost[i, slots[i]] for i in range(n)) <= best + 1e-9 * scale


@given(st.integers(3, 16), SEEDS)
@settings(max_examples=60, deadline=None)
def test_distances_of_a_real_shape_are_met(n: int, seed: int):
    points = scattered(seed, n)
    edges = grown(points)
    wanted = edge_lengths(points, edges)
    shape = realise(n, edges, wanted, 0.2)
    assert np.abs(shape.error / wanted).max() <= DISTANCE_TOLERANCE
    assert np.allclose(edge_lengths(shape.offsets, edges) - wanted, shape.error, atol=1e-12)


@given(st.integers(3, 10), SEEDS, st.booleans(), st.booleans())
@settings(max_examples=60, deadline=None)
def test_resolve_keeps_the_shape_and_writes_out_exactly(n: int, seed: int, given_offsets: bool, assign: bool):
    points, starts = scattered(seed, n), scattered(seed + 1, n)
    edges = grown(points)
    wanted = tuple(edge_lengths(points, edges).tolist())
    fleet = Fleet(
        FleetSection("any"),
        FormationSection(
            edges=tuple((int(i) + 1, int(j) + 1) for i, j in edges),
            safe_distance_m=0.2,
            offsets=tuple(map(tuple, points.tolist())) if given_offsets else None,
            distance_m=None if given_offsets else wanted,
            assign=assign,
        ),
        ControlSection(),
        TrajectorySection(),
        tuple(Robot(id=k, x_m=float(x), y_m=float(y)) for k, (x, y) in enumerate(starts, 1)),
    )
    geometry = resolve(fleet)
    lengths = edge_lengths(geometry.offsets, geometry.edges)
    assert np.allclose(lengths, wanted, rtol=DISTANCE_TOLERANCE)
    assert np.allclose(geometry.distances, wanted, rtol=1e-12)
    if not assign:
        assert np.array_equal(geometry.edges, edges)
    again = resolve(resolved(fleet))
    assert np.array_equal(again.offsets, geometry.offsets)
    assert np.array_equal(again.edges, geometry.edges)
    assert np.array_equal(again.distances, geometry.distances)
