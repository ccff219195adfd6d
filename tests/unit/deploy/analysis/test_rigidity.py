"""Rigidity: which graphs are rigid, and who is loose."""

from __future__ import annotations

import numpy as np

from handfast.deploy.analysis.shapes import is_collinear, is_rigid, loose, rigidity_rank
from tests.unit.agent.formation.delta import DELTA, DELTA_EDGES, RING, SQUARE, H


def test_a_triangle_is_rigid_and_a_square_without_diagonal_is_not():
    assert rigidity_rank(DELTA, np.array(DELTA_EDGES) - 1) == 9
    assert is_rigid(DELTA, np.array(DELTA_EDGES) - 1)
    assert not is_rigid(SQUARE, RING)
    assert rigidity_rank(SQUARE, RING) == 4
    assert is_rigid(SQUARE, (*RING, (0, 2)))


def test_too_few_robots_to_bend_are_rigid():
    assert is_rigid([(0.0, 0.0)], [])
    assert is_rigid([(0.0, 0.0), (1.0, 0.0)], [(0, 1)])
    assert not is_rigid([(0.0, 0.0), (1.0, 0.0)], [])


def test_robots_in_one_line_are_not_rigid_however_many_edges():
    line = [(0.0, 0.0), (0.6, 0.8), (1.2, 1.6)]
    assert is_collinear(line)
    assert not is_collinear(SQUARE)
    assert not is_rigid(line, [(0, 1), (1, 2), (0, 2)])
    assert loose(line, [(0, 1), (1, 2), (0, 2)]) == (2,)


def test_the_smallest_singular_value_of_a_long_truss_still_counts():
    places = [(k * 0.5, H * (k % 2)) for k in range(300)]
    edges = [(k, k + step) for step in (1, 2) for k in range(300 - step)]
    assert is_rigid(places, edges)
    assert not is_rigid(places, [edge for edge in edges if edge != (150, 151)])


def test_loose_robots_are_those_outside_the_largest_rigid_part():
    arm = [(0.0, 0.0), (1.0, 0.0), (0.5, 1.0), (0.5, 2.0)]
    assert loose(arm, [(0, 1), (1, 2), (0, 2), (2, 3)]) == (3,)
    assert loose(arm, [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]) == ()
    # Two triangles that share robot 2; the second one is the larger part with its extra robot.
    butterfly = [(-1.0, 1.0), (-1.0, -1.0), (0.0, 0.0), (1.0, 1.0), (1.0, -1.0), (2.0, 0.0)]
    edges = [(0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)]
    assert loose(butterfly, edges) == (0, 1)


def test_without_edges_all_but_the_first_are_loose():
    assert loose(SQUARE, []) == (1, 2, 3)
