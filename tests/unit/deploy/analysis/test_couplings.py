"""What analyses ask of a coupling. That its modes are the law's: `tests/unit/deploy/check/test_check.py`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import ControlSection
from handfast.agent.formation.geometry import resolve
from handfast.deploy.analysis.couplings import COUPLINGS, _dies_away, _radius
from tests.unit.deploy.synthetic_run import make_fleet

PAIR = make_fleet([(0.0, 0.0), (2.0, 0.0)], [(1, 2)])
TRIANGLE = make_fleet([(0.0, 0.0), (1.0, 0.0), (0.5, 0.8)], [(1, 2), (2, 3), (1, 3)])


def of(name: Any, kp: float = 1.0) -> Any:
    return COUPLINGS[name](replace(TRIANGLE, control=ControlSection(coupling=name, kp=kp)))


@pytest.mark.parametrize(("name", "most"), [("joint", 1.0), ("edge", 2.0), ("penalty", 1e4)])
def test_modes_are_two_for_each_robot_and_weak_ones_are_navigation(name: str, most: float):
    geometry = resolve(TRIANGLE)
    coupling = of(name, kp=2.0)
    modes = coupling.modes(geometry)
    control = coupling.control
    assert len(modes) == 6
    assert sum(mode.shape for mode in modes) == 3
    for mode in modes:
        if mode.shape:
            share = (mode.k1 - control.c1) / (control.kp - (control.c1 if name != "penalty" else 0.0))
            assert 0.0 < share < most
        else:
            assert (mode.k1, mode.k2) == (control.c1, control.c2)


def test_only_the_edge_law_overcorrects_and_only_where_edges_share_robots():
    def largest(name: Any, fleet: Fleet) -> float:
        coupling = COUPLINGS[name](replace(fleet, control=ControlSection(coupling=name, kp=1.4, k2=0.01)))
        return max(mode.k1 - 0.4 for mode in coupling.modes(resolve(fleet)))

    assert largest("edge", TRIANGLE) > 1.2
    assert largest("edge", PAIR) < 1.0
    assert largest("joint", TRIANGLE) < 1.0


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 1.5, 2.0, 3.0, 10.0, 50.0])
@pytest.mark.parametrize("kp", [0.0, 1.0, 3.0])
def test_sweeps_are_stable_whose_largest_eigenvalue_is_below_1(rate_hz: float, kp: float):
    geometry = resolve(TRIANGLE)
    for name in COUPLINGS:
        law = of(name, kp)
        assert law.sweeps_stably(geometry, rate_hz) == (law.sweep_radius(geometry, rate_hz) < 1.0)


@given(
    st.integers(0, 2**32),
    st.integers(1, 8),
    st.one_of(
        st.sampled_from((0.0, 0.5, 0.999, 0.9999999, 1.0000001, 1.001, 2.0, 1e60)), st.floats(0.9, 1.1)
    ),
    st.sampled_from((0.0, 1.0, 100.0)),
)
def test_powers_die_away_of_a_matrix_whose_eigenvalues_are_all_below_1(
    seed: int, size: int, largest: float, skew: float
):
    """However far from normal it is, so that its powers grow at first."""
    generator = np.random.default_rng(seed)
    matrix = generator.normal(size=(size, size))
    if abs(largest - 1.0) > 0.05:  # else rounding decides, for eigenvalues that depend so much on the entries
        matrix += skew * np.triu(generator.normal(size=(size, size)), 1)
    else:
        matrix += matrix.T
    matrix *= largest / _radius(matrix)
    if abs(_radius(matrix) - 1.0) < 1e-9:
        return
    assert _dies_away(matrix) == (_radius(matrix) < 1.0)
