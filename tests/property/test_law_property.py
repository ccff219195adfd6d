"""The law over any graph and state: sweeps find the joint multipliers, and the joint law is stable."""

from __future__ import annotations

from math import ceil, hypot, log, sqrt
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from agent.control import law
from agent.formation.points import Floats
from deploy.analysis import fleet_law

RS = 0.22
C1, C2 = 0.4, 0.6
ROBOTS_MAX = 12


class Group(NamedTuple):
    """n robots: r, e and edot are (2, n); graph (m, 2); distances d (m,)."""

    r: Floats
    error: Floats
    error_rate: Floats
    graph: NDArray[np.intp]
    d: Floats
    gains: law.Gains
    reference: Floats
    """Velocity (2,) of the common trajectory, which is straight: A rdot_d = 0, rddot_d = 0."""

    @property
    def n(self) -> int:
        return self.r.shape[1]

    def edges(self) -> fleet_law.Edges:
        i, j = self.graph.T
        v = self.error_rate + self.reference[:, None]
        fn = fleet_law.navigation_force(0.0, self.error, self.error_rate, C1, C2)
        return fleet_law.edges(
            self.r[:, i] - self.r[:, j], v[:, i] - v[:, j], fn[:, i] - fn[:, j], self.d, RS, self.gains
        )


@st.composite
def groups(draw: st.DrawFn, clearance_min: float = 0.05, robots_max: int = ROBOTS_MAX) -> Group:
    """Any graph of at least one edge, any state whose edges are longer than r_s + `clearance_min`."""
    n = draw(st.integers(2, robots_max), label="robots")
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1), label="seed"))
    pairs = np.array([(i, j) for i in range(n) for j in range(i)])
    chosen = generator.random(len(pairs)) < draw(st.sampled_from([0.15, 0.5, 1.0]), label="density")
    graph = pairs[chosen] if chosen.any() else pairs[:1]
    r = generator.normal(size=(2, n)) * draw(st.sampled_from([0.6, 1.5, 4.0]), label="scale")
    i, j = graph.T
    shortest = np.hypot(*(r[:, i] - r[:, j])).min()
    r *= max(1.0, (RS + clearance_min) / shortest)
    speed = draw(st.sampled_from([0.0, 0.3, 3.0]), label="speed")
    return Group(
        r,
        generator.normal(size=(2, n)),
        generator.normal(size=(2, n)) * speed,
        graph,
        generator.uniform(0.3, 2.0, len(graph)),
        law.Gains(
            kd=draw(st.sampled_from([0.0, 1.8, 10.0]), label="kd"),
            k2=draw(st.sampled_from([0.5, 5.0, 50.0]), label="k2"),
            kp=draw(st.sampled_from([0.0, 1.0, 4.0]), label="kp"),
            near=draw(st.sampled_from([0.0, 4.0]), label="near"),
            far=draw(st.sampled_from([0.0, 5.0]), label="far"),
        ),
        generator.normal(size=2),
    )


# ---------------------------------------------------------------------- the distributed solution


class Sweeper:
    """Every agent's sweeps on a frozen state, and the norm in which they contract.

    With M = K_2 + A A^T, K_2 diagonal, and the sweep's diagonal P, the error becomes (I - P^-1 M) error.
    Since
    x^T A A^T x = sum over robots |sum over its edges of +-a_k x_k|^2 <= sum over robots of
    deg sum |a_k x_k|^2 = sum over edges of phi'^2 (deg_i + deg_j) x_k^2, M <= P: all eigenvalues of
    P^-1/2 M P^-1/2 lie in [min K_2 / P, 1], and in the norm of P the error shrinks by 1 - min K_2 / P.
    """

    def __init__(self, g: Group) -> None:
        self.g, self.e = g, g.edges()
        self.i, self.j = g.graph.T
        degree = np.bincount(g.graph.ravel(), minlength=g.n).astype(float)
        self.degrees = degree[self.i] + degree[self.j]
        self.weights = self.e.softness + self.e.slope**2 * self.degrees
        self.rate = 1.0 - float((self.e.softness / self.weights).min())
        self.exact = fleet_law.multipliers_joint(self.e, self.i, self.j, g.n)

    def sweep(self, lam: Floats) -> Floats:
        force = fleet_law.forces(self.e, lam)
        constraint = fleet_law.total_forces(force, self.i, self.j, self.g.n)
        pull = constraint[:, self.i] - constraint[:, self.j]
        return fleet_law.multipliers_sweep(self.e, lam, pull, self.degrees)

    def norm(self, lam: Floats) -> float:
        return sqrt(float(self.weights @ (lam - self.exact) ** 2))


@given(groups(clearance_min=1e-3), st.integers(0, 2**32 - 1))
@settings(max_examples=150)
def test_every_sweep_shrinks_the_error(g: Group, seed: int):
    """From any multipliers, and however close the pairs: in the norm of P, by a known factor at least."""
    sweeper = Sweeper(g)
    lam = np.random.default_rng(seed).normal(size=len(g.graph)) * (1.0 + np.abs(sweeper.exact).max())
    rounding = 1e-9 * sweeper.norm(np.zeros_like(lam)) + 1e-9 * sweeper.norm(lam)
    for _ in range(20):
        before = sweeper.norm(lam)
        lam = sweeper.sweep(lam)
        assert sweeper.norm(lam) <= sweeper.rate * before + rounding


@given(groups(clearance_min=0.3))
@settings(max_examples=100)
def test_sweeps_converge_to_the_joint_multipliers(g: Group):
    """To 1e-8 of the start's error, in the number of sweeps that the factor gives."""
    sweeper = Sweeper(g)
    assume(sweeper.rate < 0.998)
    lam = np.zeros(len(g.graph))
    start = sweeper.norm(lam)
    for _ in range(ceil(log(1e-8) / log(sweeper.rate))):
        lam = sweeper.sweep(lam)
    assert sweeper.norm(lam) <= 1.01e-8 * start + 1e-9 * (1.0 + np.abs(sweeper.exact).max())


@given(groups(clearance_min=1e-3))
@settings(max_examples=60)
def test_joint_multipliers_are_the_sweeps_fixed_point(g: Group):
    sweeper = Sweeper(g)
    again = sweeper.sweep(sweeper.exact)
    assert sweeper.norm(again) <= 1e-9 * sweeper.norm(np.zeros_like(again)) + 1e-12


@given(groups(clearance_min=0.1))
@settings(max_examples=60)
def test_both_ends_of_an_edge_sweep_to_the_same_multiplier(g: Group):
    """Each agent calls the law with its own edges only, seen from its own end."""
    sweeper = Sweeper(g)
    lam = np.random.default_rng(1).normal(size=len(g.graph))
    together = sweeper.sweep(lam)
    constraint = fleet_law.total_forces(fleet_law.forces(sweeper.e, lam), *g.graph.T, g.n)
    v = g.error_rate + g.reference[:, None]
    fn = fleet_law.navigation_force(0.0, g.error, g.error_rate, C1, C2)
    for robot in range(g.n):
        mine = np.flatnonzero((g.graph == robot).any(axis=1))
        other = g.graph[mine].sum(axis=1) - robot
        e = fleet_law.edges(
            g.r[:, [robot]] - g.r[:, other],
            v[:, [robot]] - v[:, other],
            fn[:, [robot]] - fn[:, other],
            g.d[mine],
            RS,
            g.gains,
        )
        own = fleet_law.forces(e, lam[mine]).sum(axis=1, keepdims=True)
        swept = fleet_law.multipliers_sweep(e, lam[mine], own - constraint[:, other], sweeper.degrees[mine])
        assert np.allclose(swept, together[mine], rtol=1e-9, atol=1e-9)


@given(groups(clearance_min=0.1), st.permutations(range(ROBOTS_MAX)))
@settings(max_examples=60)
def test_names_of_robots_and_order_of_edges_do_not_matter(g: Group, names: list[int]):
    order = np.argsort([names[k] for k in range(g.n)])
    place = np.argsort(order)
    turned = g._replace(
        r=g.r[:, order],
        error=g.error[:, order],
        error_rate=g.error_rate[:, order],
        graph=place[g.graph][::-1, ::-1],
        d=g.d[::-1],
    )
    one, other = Sweeper(g), Sweeper(turned)
    assert np.allclose(other.exact[::-1], one.exact, rtol=1e-8, atol=1e-9)


# ---------------------------------------------------------------------- the energy (35)


def matrices(g: Group) -> tuple[Floats, Floats]:
    """A (m, 2 n) and Adot rdot (m,) of (10), (11), edge by edge and apart from `agent.control.law`.

    a = (d - r_s) D g with g = 1 / ((rho - r_s)^2 rho), so adot = (d - r_s)(w g + D gdot).
    """
    v = g.error_rate + g.reference[:, None]
    a = np.zeros((len(g.graph), 2 * g.n))
    drift = np.zeros(len(g.graph))
    for k, (i, j) in enumerate(g.graph):
        delta, w = g.r[:, i] - g.r[:, j], v[:, i] - v[:, j]
        rho = float(np.linalg.norm(delta))
        scale = 1.0 / ((rho - RS) ** 2 * rho)
        scale_rate = -scale * (delta @ w / rho) * (2.0 / (rho - RS) + 1.0 / rho)
        gradient = (g.d[k] - RS) * delta * scale
        a[k, 2 * i : 2 * i + 2], a[k, 2 * j : 2 * j + 2] = gradient, -gradient
        drift[k] = (g.d[k] - RS) * (w * scale + delta * scale_rate) @ w
    return a, drift


def energy_rate(g: Group, lam: Floats) -> tuple[float, float]:
    """dE/dt of (35) with the stiffness term under these multipliers, and the size of its terms."""
    a, drift = matrices(g)
    v = (g.error_rate + g.reference[:, None]).T.ravel()
    rate = a @ v  # (9)
    rho = np.hypot(*(g.r[:, g.graph[:, 0]] - g.r[:, g.graph[:, 1]]))
    phi, softness = (rho - g.d) / (rho - RS), g.edges().softness
    e, e_rate = g.error.T.ravel(), g.error_rate.T.ravel()
    acceleration = -C1 * e - C2 * e_rate + a.T @ lam
    terms = np.concatenate(
        [
            C1 * e * e_rate,
            e_rate * acceleration,
            rate * (a @ acceleration + drift) / softness,
            g.gains.kp * phi * rate / softness,
        ]
    )
    # In the joint law's own terms the sizes of what cancels: the demand and the constraint forces.
    size = np.abs(terms).sum() + (np.abs(rate) / softness) @ (np.abs(a) @ np.abs(a.T @ lam) + np.abs(drift))
    return float(terms.sum()), float(size)


def dissipation(g: Group) -> float:
    """-c_2 |edot|^2 - k_d sum phidot^2 / k_2, the right-hand side of (38) divided by k_2."""
    e = g.edges()
    return -C2 * float(np.sum(g.error_rate**2)) - g.gains.kd * float(np.sum(e.rate**2 / e.softness))


def joint(g: Group) -> Floats:
    return fleet_law.multipliers_joint(g.edges(), *g.graph.T, g.n)


@given(groups())
@settings(max_examples=200)
def test_energy_of_the_joint_law_falls_by_what_is_damped_38(g: Group):
    lost, size = energy_rate(g, joint(g))
    assert abs(lost - dissipation(g)) <= 1e-9 * size + 1e-12
    assert lost <= 1e-9 * size + 1e-12


def test_energy_of_the_papers_law_can_grow():
    """The gap in Theorem 1: with two edges at a robot, (33) leaves out each other's constraint forces.

    Three robots in a row, the outer ones drawn in by their navigation: at the middle one the
    force of one edge is felt by the other.
    """
    gains = law.Gains(kd=1.8, k2=5.0, kp=0.0)
    g = Group(
        r=np.array([[0.0, 0.5, 0.9], [0.0, 0.0, 0.0]]),
        error=np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]),
        error_rate=np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        graph=np.array([[0, 1], [1, 2]]),
        d=np.ones(2),
        gains=gains,
        reference=np.zeros(2),
    )
    per_edge = fleet_law.multipliers_edge(g.edges())
    grows, size = energy_rate(g, per_edge)
    assert grows > 0.1 * size
    falls, _ = energy_rate(g, joint(g))
    assert falls == pytest.approx(dissipation(g))
    assert falls < 0.0


@given(groups(robots_max=2))
@settings(max_examples=60)
def test_energy_of_the_papers_law_falls_for_one_pair_25(g: Group):
    lost, size = energy_rate(g, fleet_law.multipliers_edge(g.edges()))
    assert abs(lost - dissipation(g)) <= 1e-9 * size + 1e-12


@given(groups(clearance_min=0.1, robots_max=7))
@settings(max_examples=12)
def test_along_a_solution_energy_never_grows_and_edges_keep_their_bound(g: Group):
    """rho >= r_s + (d - r_s) / (1 + sqrt(2 E(0) / k_p)) for all time."""
    g = g._replace(gains=g.gains._replace(kp=max(g.gains.kp, 1.0)))
    n = g.n

    def at(y: Floats, t: float) -> Group:
        error, error_rate = y[: 2 * n].reshape(2, n), y[2 * n :].reshape(2, n)
        return g._replace(r=wanted + g.reference[:, None] * t + error, error=error, error_rate=error_rate)

    def rate(t: float, y: Floats) -> Floats:
        now = at(y, t)
        e = now.edges()
        lam = fleet_law.multipliers_joint(e, *g.graph.T, n)
        force = fleet_law.total_forces(fleet_law.forces(e, lam), *g.graph.T, n)
        u = fleet_law.navigation_force(0.0, now.error, now.error_rate, C1, C2) + force
        return np.concatenate([now.error_rate.ravel(), u.ravel()])

    def energy(y: Floats, t: float) -> float:
        now = at(y, t)
        return fleet_law.energy(now.edges(), now.error, now.error_rate, C1, g.gains)

    # Where the robots are wanted follows from where they are and how far off: any shape, not g.d's.
    wanted = g.r - g.error
    start = np.concatenate([g.error.ravel(), g.error_rate.ravel()])
    first = energy(start, 0.0)
    times = np.linspace(0.0, 3.0, 121)
    solution = solve_ivp(
        rate, (0.0, 3.0), start, method="DOP853", rtol=1e-8, atol=1e-10, t_eval=times, max_step=0.25
    )
    assert solution.success
    energies = np.array([energy(y, t) for t, y in zip(solution.t, solution.y.T, strict=True)])
    assert np.all(np.diff(energies) <= 1e-6 * first)
    softness = g.edges().softness
    bound = RS + (g.d - RS) / (1.0 + np.sqrt(2.0 * first * softness / g.gains.kp))
    for t, y in zip(solution.t, solution.y.T, strict=True):
        assert np.all(at(y, t).edges().distance >= bound * (1.0 - 1e-9))


# ---------------------------------------------------------------------- far from the place (N1)

ERROR = st.floats(-1e3, 1e3)
GAIN = st.floats(0.05, 20.0)
SPEED = st.floats(0.05, 20.0)


@given(ERROR, ERROR, GAIN, GAIN, SPEED)
def test_a_robot_makes_for_its_place_by_21_near_it_and_at_its_speed_limit_far_from_it(
    x: float, y: float, c1: float, c2: float, most: float
):
    """Without friction -c1 share e - c2 edot comes to rest at edot = -(c1 / c2) share e."""
    share = law.saturation(x, y, c1, c2, most)
    wanted = c1 / c2 * hypot(x, y)
    assert 0.0 < share <= 1.0
    assert share * wanted == pytest.approx(min(wanted, most), rel=1e-9)
    if wanted < most * (1.0 - 1e-9):
        assert share == 1.0


@given(ERROR, ERROR, ERROR, ERROR, GAIN, GAIN, SPEED)
def test_the_pull_to_the_place_is_continuous(
    x: float, y: float, dx: float, dy: float, c1: float, c2: float, most: float
):
    """It is c1 e cut to a circle: no two of them are further apart than what they are made of."""

    def pull(ex: float, ey: float) -> tuple[float, float]:
        share = law.saturation(ex, ey, c1, c2, most)
        return c1 * share * ex, c1 * share * ey

    one, other = pull(x, y), pull(x + 1e-3 * dx, y + 1e-3 * dy)
    apart = hypot(one[0] - other[0], one[1] - other[1])
    assert apart <= c1 * 1e-3 * hypot(dx, dy) + 1e-9 * c1 * (hypot(x, y) + 1.0)


# ---------------------------------------------------------------------- one-sided and fading constraints


@given(groups(clearance_min=1e-3), st.floats(-1e6, 1e6))
def test_a_one_sided_constraint_never_pulls(g: Group, value: float):
    e = g.edges()
    for lam in (fleet_law.repelling(np.full(len(g.d), value)), fleet_law.repelling(joint(g))):
        force = fleet_law.forces(e, lam)
        assert (force[0] * e.normal[0] + force[1] * e.normal[1] >= 0.0).all()
    assert law.repelling(value) == max(value, 0.0)


@given(groups(clearance_min=0.1), st.floats(0.01, 1.0))
def test_an_edge_of_less_weight_is_the_same_constraint_scaled(g: Group, weight: float):
    """With k2 = 0 the constraint force would not know the weight: a constraint holds or does not."""
    e = g.edges()._replace(softness=np.zeros(len(g.d)))
    faded = fleet_law.weighted(e, weight)
    full, less = (fleet_law.forces(each, fleet_law.multipliers_edge(each)) for each in (e, faded))
    assert less == pytest.approx(full, rel=1e-9, abs=1e-12)
    assert faded.normal is e.normal
    assert faded.distance is e.distance


@given(groups(clearance_min=0.1))
def test_an_edge_without_weight_has_no_force(g: Group):
    faded = fleet_law.weighted(g.edges(), 0.0)
    assert not np.any(fleet_law.forces(faded, fleet_law.multipliers_edge(faded)))


@given(groups(clearance_min=0.1))
def test_an_obstacle_is_a_constraint_of_one_body(g: Group):
    """A A^T = phi'^2 where only one end can move: the same demand, met by one robot alone."""
    e = g.edges()
    lam = fleet_law.multipliers_edge(e, 1)
    assert lam * (e.softness + e.slope**2) == pytest.approx(e.demand, rel=1e-9)


@given(groups(clearance_min=0.05), st.integers(0, 2**32 - 1))
@settings(max_examples=100)
def test_sweeps_with_one_sided_constraints_settle_as_fast(g: Group, seed: int):
    """Cutting off what is below 0 brings no two vectors further apart: the sweep stays a contraction."""
    sweeper, generator = Sweeper(g), np.random.default_rng(seed)
    one_sided = generator.random(len(g.d)) < 0.5

    def sweep(lam: Floats) -> Floats:
        swept = sweeper.sweep(lam)
        return np.where(one_sided, fleet_law.repelling(swept), swept)

    def size(lam: Floats) -> float:
        return sqrt(float(sweeper.weights @ lam**2))

    one, other = generator.normal(size=(2, len(g.d))) * 10.0
    for _ in range(20):
        before, one, other = size(one - other), sweep(one), sweep(other)
        assert size(one - other) <= sweeper.rate * before + 1e-9 * (size(one) + 1.0)


# ---------------------------------------------------------------------- one edge, and all at once

ROUNDING = 1e-12


def close(one: float, other: float, size: float) -> bool:
    return abs(one - other) <= ROUNDING * (abs(size) + abs(one)) or one == other


@given(groups(clearance_min=-RS, robots_max=6), st.floats(0.0, 0.5), st.integers(0, 2**32 - 1))
@settings(max_examples=100)
def test_an_agent_finds_for_its_edge_what_the_fleets_form_finds(g: Group, relaxation: float, seed: int):
    """The law in floats and in arrays: the same numbers but for rounding, also at and below r_s."""
    g = g._replace(gains=g.gains._replace(relaxation=relaxation))
    e, (i, j) = g.edges(), g.graph.T
    v = g.error_rate + g.reference[:, None]
    fn = fleet_law.navigation_force(0.0, g.error, g.error_rate, C1, C2)
    generator = np.random.default_rng(seed)
    before, pull = generator.normal(size=len(g.d)), generator.normal(size=(2, len(g.d)))
    swept = fleet_law.multipliers_sweep(e, before, pull, 5.0)
    kinds = {
        "edge": fleet_law.multipliers_edge(e),
        "body": fleet_law.multipliers_edge(e, 1),
        "penalty": fleet_law.multipliers_penalty(e, g.gains),
    }
    for k, (a, b) in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
        offset, velocity, navigation = (
            (float(x[0, a] - x[0, b]), float(x[1, a] - x[1, b])) for x in (g.r, v, fn)
        )
        one = law.edge(offset, velocity, navigation, float(g.d[k]), RS, g.gains)
        assert all(close(one.normal[axis], e.normal[axis, k], 1.0) for axis in (0, 1))
        # What cancels in the demand: its terms may be far larger than their sum.
        size = (abs(one.slope) + 1.0) ** 2 * (hypot(*velocity) + hypot(*navigation) + 1.0) ** 2
        for name in ("distance", "slope", "phi", "rate", "demand", "softness"):
            assert close(getattr(one, name), float(getattr(e, name)[k]), size), name
        alone = {
            "edge": law.multiplier_edge(one),
            "body": law.multiplier_edge(one, 1),
            "penalty": law.multiplier_penalty(one, g.gains),
        }
        for name, multiplier in alone.items():
            assert close(multiplier, float(kinds[name][k]), size), name
            force = law.force(one, multiplier)
            wanted = fleet_law.forces(e, kinds[name])[:, k].tolist()
            assert all(close(x, y, size * abs(one.slope)) for x, y in zip(force, wanted, strict=True)), name
        found = law.multiplier_sweep(one, float(before[k]), (float(pull[0, k]), float(pull[1, k])), 5.0)
        assert close(found, float(swept[k]), size)
        assert law.repelling(found) == pytest.approx(
            float(fleet_law.repelling(swept)[k]), rel=ROUNDING, abs=ROUNDING * size
        )
        faded = law.weighted(one, 0.3)
        assert close(faded.phi, float(fleet_law.weighted(e, 0.3).phi[k]), size)
