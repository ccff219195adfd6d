"""Places are found from distances."""

from __future__ import annotations

from math import hypot

import numpy as np
import pytest

from handfast.agent.fleet.model import FormationError
from handfast.agent.formation.realisation import realise
from tests.unit.agent.formation.delta import DELTA_EDGES, RING


def test_the_delta_is_found_from_its_distances():
    shape = realise(6, np.array(DELTA_EDGES) - 1, np.ones(9), 0.22)
    assert np.abs(shape.error).max() < 1e-9
    assert shape.offsets.mean(axis=0) == pytest.approx((0.0, 0.0), abs=1e-12)
    # unfolded: the corners of the triangle are 2 m apart, which no edge says
    corners = shape.offsets[[0, 3, 5]]
    for a in range(3):
        assert hypot(*(corners[a] - corners[a - 1])) == pytest.approx(2.0)


def test_a_chain_spreads_out():
    shape = realise(5, [(k, k + 1) for k in range(4)], np.ones(4))
    assert np.abs(shape.error).max() < 1e-9
    assert hypot(*(shape.offsets[4] - shape.offsets[0])) > 3.5


def test_rounded_distances_of_a_square_are_met_as_nearly_as_possible():
    edges = (*RING, (0, 2), (1, 3))
    shape = realise(4, edges, [1.0, 1.0, 1.0, 1.0, 1.41, 1.41])
    assert 1e-4 < np.abs(shape.error).max() < 0.004


def test_distances_that_no_plane_has_leave_an_error():
    shape = realise(4, [(a, b) for a in range(4) for b in range(a)], np.ones(6))  # a tetrahedron
    assert np.abs(shape.error).max() > 0.1


def test_a_graph_in_parts_has_no_realisation():
    with pytest.raises(FormationError, match="2 parts"):
        realise(4, [(0, 1), (2, 3)], [1.0, 1.0])
