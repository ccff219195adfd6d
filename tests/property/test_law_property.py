"""The law over any graph and state: sweeps find the joint multipliers, and the joint law is stable."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import ceil, cos, hypot, log, sin, sqrt
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from handfast.agent.common.quantities import Vector
from handfast.agent.control import law
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis import fleet_law

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


STIFF = Group(
    r=np.array([[-0.17026135, -0.03438272], [1.55956616, 1.84928499]]),
    error=np.array([[-2.74563837, 0.15086145], [0.76637632, -1.67188433]]),
    error_rate=np.array([[-2.50363984, -3.56698828], [4.08332855, -0.99326764]]),
    graph=np.array([[1, 0]]),
    d=np.array([1.65042654]),
    gains=law.Gains(kd=0.0, k2=0.5, kp=1.0),
    reference=np.array([0.57924533, -1.313258]),
)
"""An edge without damping that starts 0.1 m above r_s: all its energy swings in phidot."""


@given(groups(clearance_min=0.1, robots_max=7))
@example(STIFF)
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
        rate, (0.0, 3.0), start, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=times, max_step=0.25
    )
    assert solution.success
    energies = np.array([energy(y, t) for t, y in zip(solution.t, solution.y.T, strict=True)])
    # With kd = 0 an edge near r_s swings at 700 1/s: at rtol = 1e-8 the integrator itself adds 2e-5 of E(0).
    assert np.all(np.diff(energies) <= 1e-7 * first)
    softness = g.edges().softness
    bound = RS + (g.d - RS) / (1.0 + np.sqrt(2.0 * first * softness / g.gains.kp))
    for t, y in zip(solution.t, solution.y.T, strict=True):
        assert np.all(at(y, t).edges().distance >= bound * (1.0 - 1e-9))


# ---------------------------------------------------------------------- far from the place (N1)

ERROR = st.floats(-1e3, 1e3)
GAIN = st.floats(0.05, 20.0)
SPEED = st.floats(0.05, 20.0)
PLACE = st.tuples(st.floats(-25.0, 25.0), st.floats(-25.0, 25.0))


def reach(place: Vector, most: float) -> float:
    """The speed that a robot may make for its place with, (N1)."""
    return max(most, hypot(*place) + law.APPROACH_SHARE * most)


@given(ERROR, ERROR, PLACE, GAIN, GAIN, SPEED)
def test_a_robot_makes_for_its_place_by_21_near_it_and_at_its_speed_limit_far_from_it(
    x: float, y: float, place: Vector, c1: float, c2: float, most: float
):
    """Without friction -c1 acting - c2 edot comes to rest at edot = -(c1 / c2) acting."""
    acting = law.acting_error((x, y), place, c1, c2, most)
    asked = place[0] - c1 / c2 * x, place[1] - c1 / c2 * y
    wanted = place[0] - c1 / c2 * acting[0], place[1] - c1 / c2 * acting[1]
    limit = reach(place, most)
    size = hypot(*asked) + hypot(*place)
    assert hypot(*wanted) == pytest.approx(min(hypot(*asked), limit), rel=1e-9, abs=1e-9 * size)
    assert asked[0] * wanted[1] - asked[1] * wanted[0] == pytest.approx(0.0, abs=1e-9 * size * size)
    if hypot(*asked) < limit * (1.0 - 1e-9):
        assert acting == (x, y)


@given(ERROR, ERROR, PLACE, GAIN, GAIN, SPEED)
def test_it_comes_nearer_to_its_place_at_a_quarter_of_its_limit_or_more(
    x: float, y: float, place: Vector, c1: float, c2: float, most: float
):
    """-e.edot >= min(c1/c2 |e|, V/4) |e| at what (N1) drives edot to: nobody is left behind."""
    acting = law.acting_error((x, y), place, c1, c2, most)
    away = hypot(x, y)
    nearer = c1 / c2 * (acting[0] * x + acting[1] * y)
    least = min(c1 / c2 * away, law.APPROACH_SHARE * most) * away
    assert nearer >= least - 1e-9 * away * (c1 / c2 * away + hypot(*place))


@given(ERROR, ERROR, ERROR, ERROR, PLACE, GAIN, GAIN, SPEED)
def test_the_pull_to_the_place_is_continuous_and_that_of_a_convex_function(
    x: float, y: float, ox: float, oy: float, place: Vector, c1: float, c2: float, most: float
):
    """It is e projected to a circle: no two of them are further apart than what they are made of, and they
    never turn against that (firmly non-expansive, so the gradient of a convex function)."""
    one = law.acting_error((x, y), place, c1, c2, most)
    other = law.acting_error((ox, oy), place, c1, c2, most)
    moved, by = (one[0] - other[0], one[1] - other[1]), (x - ox, y - oy)
    along = moved[0] * by[0] + moved[1] * by[1]
    size = hypot(x, y) + hypot(ox, oy) + c2 / c1 * hypot(*place)
    assert moved[0] ** 2 + moved[1] ** 2 <= along + 1e-9 * size * size


def potential(error: Vector, place: Vector, c1: float, c2: float, most: float) -> float:
    """U of (N1): its gradient is c1 times the error that acts; c1/2 |e|^2 near the place."""
    over = max(0.0, hypot(place[0] - c1 / c2 * error[0], place[1] - c1 / c2 * error[1]) - reach(place, most))
    return 0.5 * c1 * (error[0] ** 2 + error[1] ** 2) - 0.5 * c2 * c2 / c1 * over * over


NEAR = st.floats(-20.0, 20.0)


def round_trip(pull: Callable[[Vector], Vector], radius: float = 10.0) -> float:
    """Work that a pull does, per unit mass, on a robot that is led once round its place."""
    angles = (np.arange(4000) + 0.5) / 4000 * 2.0 * np.pi
    work = 0.0
    for angle in angles:
        fx, fy = pull((radius * cos(angle), radius * sin(angle)))
        work += (-fx * -sin(angle) - fy * cos(angle)) * radius * 2.0 * np.pi / 4000
    return float(work)


def test_nobody_gains_energy_on_a_way_round_its_place():
    """A limit that is another in each direction of e, on |e| alone, is no gradient of anything."""
    place, most = (0.6, 0.0), 1.0

    def by_direction(error: Vector) -> Vector:
        """Along -e, as fast as leaves the robot's own speed at `most`."""
        away = hypot(*error)
        along = -(place[0] * error[0] + place[1] * error[1]) / away
        fastest = sqrt(along * along + most * most - place[0] ** 2 - place[1] ** 2) - along
        share = min(1.0, C2 * fastest / (C1 * away))
        return C1 * share * error[0], C1 * share * error[1]

    def here(error: Vector) -> Vector:
        acting = law.acting_error(error, place, C1, C2, most)
        return C1 * acting[0], C1 * acting[1]

    def on_a_square(pull: Callable[[Vector], Vector]) -> float:
        corners = [(3.0, 0.0), (9.0, 0.0), (0.0, 9.0), (0.0, 3.0), (3.0, 0.0)]
        work = 0.0
        for (ax, ay), (bx, by) in pairwise(corners):
            for share in (np.arange(2000) + 0.5) / 2000:
                fx, fy = pull((ax + share * (bx - ax), ay + share * (by - ay)))
                work -= (fx * (bx - ax) + fy * (by - ay)) / 2000
        return float(work)

    assert abs(on_a_square(here)) < 1e-6
    assert abs(round_trip(here)) < 1e-6
    assert abs(on_a_square(by_direction)) > 1.0  # J/kg each time round


def firmer(error: Vector, place: Vector, c1: float, c2: float, most: float, rate: float) -> Vector:
    """The pull of (N2), m/s^2: c1 times the error that acts, as firm as it is."""
    acting = law.acting_error(error, place, c1, c2, most)
    firm = law.firmness(error, acting, place, c1, c2, most, rate)
    return firm * c1 * acting[0], firm * c1 * acting[1]


def firm_potential(error: Vector, place: Vector, most: float, rate: float) -> float:
    """Psi(U) of (N2): Psi' is gamma."""
    u = potential(error, place, C1, C2, most)
    near = 0.5 * C1 * ((reach(place, most) + hypot(*place)) * C2 / C1) ** 2
    cap = max(1.0, min(law.FIRMEST, rate / C2))
    until = near * (2.0 * cap - 1.0)  # from there on gamma is what the loop carries
    if u <= near:
        return u
    between = min(u, until)
    return near + 0.5 * (between - near) + 0.25 * (between**2 - near**2) / near + cap * (u - between)


@given(NEAR, NEAR, st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), st.floats(0.3, 3.0), GAIN)
def test_the_firm_pull_is_the_gradient_of_a_function_of_that_potential(
    x: float, y: float, place: Vector, most: float, rate: float
):
    pull = firmer((x, y), place, C1, C2, most, rate)
    step = 1e-5
    for axis, (dx, dy) in enumerate(((step, 0.0), (0.0, step))):
        ahead, behind = (
            firm_potential((x + sign * dx, y + sign * dy), place, most, rate) for sign in (1.0, -1.0)
        )
        assert (ahead - behind) / (2.0 * step) == pytest.approx(pull[axis], rel=1e-4, abs=1e-3)


@given(groups(clearance_min=0.1), st.floats(0.2, 3.0), st.floats(0.1, 6.0))
def test_the_energy_falls_at_least_as_fast_where_the_pull_is_firm(g: Group, most: float, rate: float):
    """(J3) with Psi(U) of (N2) in the place of c1/2 |e|^2: damping is firm by as much."""
    place = float(g.reference[0]), float(g.reference[1])
    errors = g.error.T.tolist()
    acting = np.array([law.acting_error((x, y), place, C1, C2, most) for x, y in errors]).T
    firm = np.array(
        [
            law.firmness((x, y), (ax, ay), place, C1, C2, most, rate)
            for (x, y), (ax, ay) in zip(errors, acting.T.tolist(), strict=True)
        ]
    )
    i, j = g.graph.T
    v = g.error_rate + g.reference[:, None]
    fn = fleet_law.navigation_force(0.0, acting, g.error_rate, firm * C1, firm * C2)
    e = fleet_law.edges(g.r[:, i] - g.r[:, j], v[:, i] - v[:, j], fn[:, i] - fn[:, j], g.d, RS, g.gains)
    lam = fleet_law.multipliers_joint(e, i, j, g.n)
    edot2 = fn + fleet_law.total_forces(fleet_law.forces(e, lam), i, j, g.n)
    k2, kd, kp = e.softness, g.gains.kd, g.gains.kp
    lost = float(np.sum(firm * C1 * acting * g.error_rate) + np.sum(g.error_rate * edot2))
    lost += float(np.sum((e.rate * (-kd * e.rate - kp * e.phi - k2 * lam) + kp * e.phi * e.rate) / k2))
    size = float(np.abs(firm * C1 * acting * g.error_rate).sum() + np.abs(g.error_rate * edot2).sum())
    size += float(np.sum(np.abs(e.rate) * (kd * np.abs(e.rate) + kp * np.abs(e.phi) + k2 * np.abs(lam)) / k2))
    expected = dissipation(g) - C2 * float(np.sum((firm - 1.0) * g.error_rate**2))
    assert abs(lost - expected) <= 1e-9 * size + 1e-12


@given(groups(clearance_min=0.1), st.floats(0.2, 3.0))
def test_the_energy_falls_far_from_the_places_too(g: Group, most: float):
    """(J3) with U of (N1) in the place of c1/2 |e|^2."""
    place = float(g.reference[0]), float(g.reference[1])
    acting = np.array([law.acting_error((x, y), place, C1, C2, most) for x, y in g.error.T.tolist()]).T
    i, j = g.graph.T
    v = g.error_rate + g.reference[:, None]
    fn = fleet_law.navigation_force(0.0, acting, g.error_rate, C1, C2)
    e = fleet_law.edges(g.r[:, i] - g.r[:, j], v[:, i] - v[:, j], fn[:, i] - fn[:, j], g.d, RS, g.gains)
    lam = fleet_law.multipliers_joint(e, i, j, g.n)
    edot2 = fn + fleet_law.total_forces(fleet_law.forces(e, lam), i, j, g.n)
    k2, kd, kp = e.softness, g.gains.kd, g.gains.kp
    lost = float(np.sum(C1 * acting * g.error_rate) + np.sum(g.error_rate * edot2))
    lost += float(np.sum((e.rate * (-kd * e.rate - kp * e.phi - k2 * lam) + kp * e.phi * e.rate) / k2))
    size = float(np.abs(C1 * acting * g.error_rate).sum() + np.abs(g.error_rate * edot2).sum())
    size += float(np.sum(np.abs(e.rate) * (kd * np.abs(e.rate) + kp * np.abs(e.phi) + k2 * np.abs(lam)) / k2))
    assert abs(lost - dissipation(g)) <= 1e-9 * size + 1e-12


# ---------------------------------------------------------------------- one-sided and fading constraints


@given(groups(clearance_min=0.1), st.floats(0.01, 1.0))
def test_an_edge_of_less_weight_is_the_same_constraint_scaled(g: Group, weight: float):
    """With k2 = 0 the constraint force would not know the weight: a constraint holds or does not."""
    e = g.edges()._replace(softness=np.zeros(len(g.d)))
    faded = fleet_law.weighted(e, weight)
    full, less = (fleet_law.forces(each, fleet_law.multipliers_edge(each)) for each in (e, faded))
    assert less == pytest.approx(full, rel=1e-9, abs=1e-12)
    assert faded.normal is e.normal
    assert faded.distance is e.distance


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


# ---------------------------------------------------------------------- distances that change (M2)

RATES = st.floats(-1.0, 1.0)


@given(st.floats(0.3, 2.0), st.floats(0.3, 2.0), RATES, RATES)
def test_what_a_wanted_distance_that_changes_leaves_out_is_proportional_to_phi(
    rho: float, d: float, closing: float, change: float
):
    """phi'(n.w - d') = phidot + d' phi / (rho - r_s): exact where phi = 0, whatever d does."""
    gains = law.Gains(kd=1.8, k2=5.0, kp=1.0)

    def phi(t: float) -> float:
        e = law.edge((rho + closing * t, 0.0), (0.0, 0.0), (0.0, 0.0), d + change * t, RS, gains)
        return e.phi

    used = law.edge((rho, 0.0), (closing - change, 0.0), (0.0, 0.0), d, RS, gains)
    step = 1e-6
    true = (phi(step) - phi(-step)) / (2.0 * step)
    left_out = change * used.phi / (rho - RS)
    assert used.rate - true == pytest.approx(left_out, abs=1e-5 * (1.0 + abs(used.slope)))
    there = law.edge((d, 0.0), (closing - change, 0.0), (0.0, 0.0), d, RS, gains)
    assert there.phi == pytest.approx(0.0, abs=1e-12)
    if closing == change:  # in the blend's own motion
        assert there.rate == there.demand == pytest.approx(0.0, abs=1e-9)
