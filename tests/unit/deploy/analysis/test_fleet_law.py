"""The constraint-force law for all edges at once: each equation against an independent computation."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from handfast.agent.control.law import RELAXATION_MIN, Gains
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis import fleet_law as law

GAINS = Gains(kd=1.8, k2=5.0, kp=1.0)
PAPER = Gains(kd=1.8, k2=5.0, kp=0.0)
RS = 0.22
C1, C2 = 0.4, 0.6
DELTA = np.array([[0, 1], [0, 2], [1, 2], [1, 3], [1, 4], [2, 4], [2, 5], [3, 4], [4, 5]])


class Group(NamedTuple):
    """A group of n robots at one instant: arrays (2, n); graph (m, 2) of indices; distances (m,)."""

    r: Floats
    v: Floats
    fn: Floats
    graph: NDArray[np.intp]
    d: Floats

    @property
    def n(self) -> int:
        return self.r.shape[1]

    def edges(self, gains: Gains = GAINS) -> law.Edges:
        i, j = self.graph.T
        return law.edges(
            self.r[:, i] - self.r[:, j],
            self.v[:, i] - self.v[:, j],
            self.fn[:, i] - self.fn[:, j],
            self.d,
            RS,
            gains,
        )


def group(seed: int, n: int = 6, graph: NDArray[np.intp] = DELTA) -> Group:
    """Anything but special: no edge is shorter than 0.3 m."""
    generator = np.random.default_rng(seed)
    while True:
        r = generator.uniform(-1.5, 1.5, (2, n))
        rho = np.hypot(*(r[:, graph[:, 0]] - r[:, graph[:, 1]]))
        if rho.min() > 0.3:
            break
    return Group(
        r,
        generator.normal(size=(2, n)),
        generator.normal(size=(2, n)),
        graph,
        generator.uniform(0.5, 1.5, len(graph)),
    )


# The paper's own constraint function and its matrices, one edge at a time, nothing shared with
# the code.


def phi(ri: Floats, rj: Floats, d: float) -> float:
    """(7)."""
    rho = float(np.linalg.norm(ri - rj))
    return (rho - d) / (rho - RS)


def derivative(f: Callable[[float], float], h: float = 1e-4) -> float:
    """f'(0) by a five-point stencil, error of order h^4."""
    return (f(-2 * h) - 8 * f(-h) + 8 * f(h) - f(2 * h)) / (12 * h)


def second_derivative(f: Callable[[float], float], h: float = 1e-3) -> float:
    return (-f(-2 * h) + 16 * f(-h) - 30 * f(0.0) + 16 * f(h) - f(2 * h)) / (12 * h * h)


def row(g: Group, k: int) -> Floats:
    """A_ij of edge k as a row of 4, [d phi / d r_i, d phi / d r_j], by differences (10)."""
    i, j = g.graph[k]
    out = np.zeros(4)
    for axis in range(4):
        step = np.zeros(4)
        step[axis] = 1.0
        out[axis] = derivative(
            lambda h, step=step: phi(g.r[:, i] + h * step[:2], g.r[:, j] + h * step[2:], g.d[k])
        )
    return out


def stacked(vectors: Floats, g: Group, k: int) -> Floats:
    """[x_i; x_j], the paper's x_ij."""
    i, j = g.graph[k]
    return np.concatenate([vectors[:, i], vectors[:, j]])


@pytest.fixture(params=range(4))
def state(request: pytest.FixtureRequest) -> Group:
    return group(request.param)


# ---------------------------------------------------------------------- equations (7) to (11)


def test_constraint_function_7(state: Group):
    e = state.edges()
    expected = [phi(state.r[:, i], state.r[:, j], d) for (i, j), d in zip(state.graph, state.d, strict=True)]
    assert e.phi == pytest.approx(expected)


def test_rate_9_is_the_derivative_along_the_motion(state: Group):
    e = state.edges()
    for k, (i, j) in enumerate(state.graph):

        def along(t: float, i: int = i, j: int = j, k: int = k) -> float:
            return phi(state.r[:, i] + t * state.v[:, i], state.r[:, j] + t * state.v[:, j], state.d[k])

        assert e.rate[k] == pytest.approx(derivative(along), rel=1e-7, abs=1e-7)


def test_gradient_10(state: Group):
    e = state.edges()
    for k in range(len(state.graph)):
        a = e.slope[k] * e.normal[:, k]
        assert np.concatenate([a, -a]) == pytest.approx(row(state, k), rel=1e-7, abs=1e-7)


def test_demand_holds_the_drift_11_the_push_the_damping_and_the_stiffness(state: Group):
    """phiddot = A rddot + Adot rdot: along a straight motion, rddot = 0, it is (11)."""
    e = state.edges()
    for k, (i, j) in enumerate(state.graph):

        def along(t: float, i: int = i, j: int = j, k: int = k) -> float:
            return phi(state.r[:, i] + t * state.v[:, i], state.r[:, j] + t * state.v[:, j], state.d[k])

        drift = second_derivative(along)
        push = row(state, k) @ stacked(state.fn, state, k)
        expected = -drift - push - GAINS.kd * e.rate[k] - GAINS.kp * e.phi[k]
        scale = abs(drift) + abs(push) + GAINS.kd * abs(e.rate[k]) + GAINS.kp * abs(e.phi[k])
        assert abs(e.demand[k] - expected) < 1e-5 * scale


# ---------------------------------------------------------------------- multipliers and forces


def test_edge_multipliers_33(state: Group):
    e = state.edges(PAPER)
    expected = []
    for k in range(len(state.graph)):
        a = row(state, k)
        expected.append(e.demand[k] / (PAPER.k2 + a @ a))
    assert law.multipliers_edge(e) == pytest.approx(expected, rel=1e-6)


def test_forces_29_and_their_sum_32(state: Group):
    e = state.edges()
    lam = np.random.default_rng(5).normal(size=len(state.graph))
    expected = np.zeros((2, state.n))
    force = law.forces(e, lam)
    for k, (i, j) in enumerate(state.graph):
        pair = row(state, k) * lam[k]  # F_cij = A_ij^T lambda_ij
        assert force[:, k] == pytest.approx(pair[:2], rel=1e-6)
        assert pair[:2] == pytest.approx(-pair[2:])  # (31)
        expected[:, i] += pair[:2]
        expected[:, j] += pair[2:]
    i, j = state.graph.T
    total = law.total_forces(force, i, j, state.n)
    assert total == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert total.sum(axis=1) == pytest.approx(np.zeros(2), abs=1e-12)  # internal forces cancel


def test_everything_is_antisymmetric_in_the_two_ends_31(state: Group):
    turned = state._replace(graph=state.graph[:, ::-1])
    e, f = state.edges(), turned.edges()
    assert np.array_equal(e.normal, -f.normal)
    for name in ("distance", "phi", "slope", "rate", "demand"):
        assert np.array_equal(getattr(e, name), getattr(f, name)), name
    lam = law.multipliers_edge(e)
    assert np.array_equal(lam, law.multipliers_edge(f))
    assert np.array_equal(law.forces(e, lam), -law.forces(f, lam))


def test_joint_multipliers_solve_the_coupled_equations(state: Group):
    e = state.edges()
    lam = law.multipliers_joint(e, *state.graph.T, state.n)
    a = np.zeros((len(state.graph), 2 * state.n))
    for k, (i, j) in enumerate(state.graph):
        gradient = row(state, k)
        a[k, 2 * i : 2 * i + 2], a[k, 2 * j : 2 * j + 2] = gradient[:2], gradient[2:]
    expected = np.linalg.solve(GAINS.k2 * np.eye(len(e.phi)) + a @ a.T, e.demand)
    assert lam == pytest.approx(expected, rel=1e-6, abs=1e-7)


def test_with_joint_multipliers_every_constraint_obeys_its_own_equation(state: Group):
    """phiddot = -k_d phidot - k_p phi - k_2 lambda for every edge, (18) with (24): what (36) supposes."""
    e = state.edges()
    i, j = state.graph.T
    lam = law.multipliers_joint(e, i, j, state.n)
    u = state.fn + law.total_forces(law.forces(e, lam), i, j, state.n)
    for k, (a, b) in enumerate(state.graph):

        def along(t: float, a: int = a, b: int = b, k: int = k) -> float:
            ends = (state.r[:, end] + t * state.v[:, end] + 0.5 * t * t * u[:, end] for end in (a, b))
            return phi(*ends, state.d[k])

        expected = -GAINS.kd * e.rate[k] - GAINS.kp * e.phi[k] - GAINS.k2 * lam[k]
        scale = abs(e.demand[k]) + abs(expected)
        assert abs(second_derivative(along) - expected) < 1e-4 * scale


def test_sweep_edge_by_edge(state: Group):
    e = state.edges()
    i, j = state.graph.T
    lam = np.random.default_rng(9).normal(size=len(state.graph))
    fc = law.total_forces(law.forces(e, lam), i, j, state.n)
    degree = np.bincount(state.graph.ravel(), minlength=state.n)
    swept = law.multipliers_sweep(e, lam, fc[:, i] - fc[:, j], (degree[i] + degree[j]).astype(float))
    for k, (a, b) in enumerate(state.graph):
        gradient = row(state, k)
        half = gradient[:2] @ gradient[:2]
        rest = e.demand[k] - GAINS.k2 * lam[k] - gradient @ stacked(fc, state, k)
        assert swept[k] == pytest.approx(
            lam[k] + rest / (GAINS.k2 + half * (degree[a] + degree[b])), rel=1e-6
        )


def test_penalty_is_minus_the_gradient_of_its_potential(state: Group):
    still = state._replace(v=np.zeros_like(state.v))
    e = still.edges()
    i, j = state.graph.T
    force = law.total_forces(law.forces(e, law.multipliers_penalty(e, GAINS)), i, j, state.n)

    def potential(r: Floats) -> float:
        return (
            0.5
            * GAINS.kp
            * sum(phi(r[:, a], r[:, b], d) ** 2 for (a, b), d in zip(state.graph, state.d, strict=True))
        )

    for axis in (0, 1):
        for robot in range(state.n):
            step = np.zeros_like(state.r)
            step[axis, robot] = 1.0
            slope = derivative(lambda h, step=step: potential(state.r + h * step))
            assert force[axis, robot] == pytest.approx(-slope, rel=1e-6, abs=1e-6)


# ---------------------------------------------------------------------- vectorised, energy, navigation


def test_energy_35(state: Group):
    e = state.edges()
    error, error_rate = state.r - 0.3, state.v + 0.1
    expected = sum(
        0.5 * (C1 * error[:, k] @ error[:, k] + error_rate[:, k] @ error_rate[:, k]) for k in range(state.n)
    ) + sum(
        (0.5 * rate * rate + 0.5 * GAINS.kp * value * value) / GAINS.k2
        for rate, value in zip(e.rate, e.phi, strict=True)
    )
    assert law.energy(e, error, error_rate, C1, GAINS) == pytest.approx(expected)


def test_navigation_force_21():
    assert law.navigation_force(0.3, 2.0, -1.0, 0.4, 0.6) == pytest.approx(0.3 - 0.8 + 0.6)
    acceleration, error, rate = np.random.default_rng(1).normal(size=(3, 2, 5))
    assert law.navigation_force(acceleration, error, rate, C1, C2) == pytest.approx(
        acceleration - C1 * error - C2 * rate
    )


# ---------------------------------------------------------------------- at and below the safe distance


def two(rho: float, closing: float = 0.0, gains: Gains = GAINS, d: float = 1.0) -> law.Edges:
    """Robot i on the right of j, at rho, both at rest or closing, and no navigation."""
    return law.edges(
        np.array([[rho], [0.0]]), np.array([[-closing], [0.0]]), np.zeros((2, 1)), np.array([d]), RS, gains
    )


@pytest.mark.parametrize("relaxation", [0.0, RELAXATION_MIN, 0.2, 0.5])
def test_near_the_safe_distance_phi_goes_on_along_its_tangent(relaxation: float):
    """(B1): phi and its slope do not jump there, and from there down the slope is the same."""
    gains = GAINS._replace(relaxation=relaxation)
    limit = RS + max(relaxation, RELAXATION_MIN) * (1.0 - RS)
    above, below = two(limit * (1 + 1e-9), 0.0, gains), two(limit * (1 - 1e-9), 0.0, gains)
    assert above.phi == pytest.approx(below.phi, rel=1e-5)
    assert above.slope == pytest.approx(below.slope, rel=1e-5)
    for rho in (0.1, RS, 0.5 * (RS + limit)):
        e = two(rho, 0.0, gains)
        assert e.slope == pytest.approx(below.slope, rel=1e-6)
        assert e.phi == pytest.approx(below.phi + below.slope * (rho - limit), rel=1e-5)


@pytest.mark.parametrize("rho", [0.1, RS, 0.3, 0.4, 0.9, 2.0])
def test_the_demand_is_what_makes_phis_second_derivative_right(rho: float):
    """phiddot of a pair driven by F_n + F_c is -kd phidot - kp phi - k2 lambda, on the tangent too."""
    gains = GAINS._replace(relaxation=0.2)
    x, v, f = np.array([[rho], [0.0]]), np.array([[-0.4], [0.3]]), np.array([[0.2], [-0.1]])

    def edge(t: float, u: Floats) -> law.Edges:
        return law.edges(x + v * t + 0.5 * u * t * t, v + u * t, f, np.array([1.0]), RS, gains)

    e = edge(0.0, f)
    lam = law.multipliers_edge(e)
    u = f + 2.0 * law.forces(e, lam)  # of one robot against the other
    step = 1e-6
    second = (edge(step, u).rate - edge(-step, u).rate) / (2.0 * step)
    wanted = -gains.kd * e.rate - gains.kp * e.phi - gains.k2 * lam
    assert second == pytest.approx(wanted, rel=1e-4, abs=1e-6)


def test_coincident_points_give_finite_numbers_and_no_force():
    offset = np.zeros((2, 1))
    for velocity in (np.zeros((2, 1)), np.array([[1.0], [-2.0]])):
        e = law.edges(offset, velocity, np.ones((2, 1)), np.array([1.0]), RS, GAINS)
        lam = law.multipliers_edge(e)
        assert all(np.isfinite(x).all() for x in e)
        assert np.isfinite(lam).all()
        assert law.forces(e, lam).tolist() == [[0.0], [0.0]]
        assert np.isfinite(law.multipliers_joint(e, np.array([0]), np.array([1]), 2)).all()
    assert offset.tolist() == [[0.0], [0.0]]
