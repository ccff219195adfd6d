"""The constraint-force law of Zou & Pagilla (2008), and the joint multipliers that repair it.

Pure, and elementwise over edges: every function takes one edge as floats or m of them as arrays of
shape (m,). An agent calls it for each of its few edges, where floats are several times faster
than small arrays; a simulation or a proof about a whole fleet calls it once with all m. Equation
numbers are the paper's; those marked (J) are `docs/theory.md`'s.

A vector is a pair of its x and y components in W (world ENU): a tuple of two floats, or an array
of shape (2, m). Forces are per unit mass (m/s^2). An edge joins robot i and robot j and everything
here is antisymmetric in them: the force on i is ``+force``, on j ``-force``.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.common.quantities import DISTANCE_MIN

Array = NDArray[np.float64]
Scalar = Any
"""A float, or an array of shape (m,)."""
Vector = Any
"""Two floats, or an array of shape (2, m): x and y."""

RELAXATION_MIN: Final = 1e-3
"""Least `Gains.relaxation`: phi has a pole at rho = r_s and changes its sign below it, so that a pair
that noise or a fault has put there would be pulled together."""


class Gains(NamedTuple):
    """k_d of (18), k_2 of (24) and the stiffness k_p of (J1); k_p = 0 is the paper's law.

    relaxation: where rho - r_s is less than this share of d - r_s, phi goes on along its tangent (B1).
    """

    kd: float
    k2: float
    kp: float
    relaxation: float = RELAXATION_MIN


class Edges(NamedTuple):
    """What the law needs of one edge or of m at one instant.

    Attributes:
        normal: n = (r_i - r_j) / rho, a vector.
        distance: rho = |r_i - r_j|, m.
        phi: constraint function (7), relaxed near r_s (B1).
        slope: phi' = d phi / d rho, so that a_ij = phi' n^T (10), 1/m.
        rate: phidot (9), 1/s.
        demand: right-hand side of (33) with k_p: -Adot rdot - A F_n - k_d phidot - k_p phi, 1/s^2.
    """

    normal: Vector
    distance: Scalar
    phi: Scalar
    slope: Scalar
    rate: Scalar
    demand: Scalar


def _at_least(value: Scalar, least: Scalar) -> Scalar:
    if type(value) is float:
        return value if value > least else least
    return np.maximum(value, least)


def _vector(x: Scalar, y: Scalar) -> Vector:
    return (x, y) if type(x) is float else np.array((x, y))


def edges(
    offset: Vector,
    velocity: Vector,
    navigation: Vector,
    distance: Scalar,
    safe_distance: float,
    gains: Gains,
) -> Edges:
    """Constraint function, its derivatives and the demand on the multiplier, eqs (7)-(11), (33).

    Args:
        offset: D = r_i - r_j, m.
        velocity: w = rdot_i - rdot_j, m/s.
        navigation: F_ni - F_nj, m/s^2.
        distance: wanted distance d, m; above `safe_distance`.
        safe_distance: r_s, m.
        gains: k_d and k_p, and the relaxation of phi.
    """
    x, y = offset
    wx, wy = velocity
    fx, fy = navigation
    rho = _at_least((x * x + y * y) ** 0.5, DISTANCE_MIN)
    nx, ny = x / rho, y / rho
    span = distance - safe_distance
    room = rho - safe_distance
    clearance = _at_least(room, _at_least(gains.relaxation, RELAXATION_MIN) * span)
    slope = span / (clearance * clearance)  # phi'
    phi = 1.0 - span / clearance + slope * (room - clearance)  # (7), nearer its tangent (B1)
    closing = nx * wx + ny * wy  # n.w
    rate = slope * closing  # (9)
    # Adot rdot = phi'' (n.w)^2 + phi' (|w|^2 - (n.w)^2) / rho, with phi'' = -2 phi' / (rho - r_s), 0 on
    # the tangent, and |w|^2 - (n.w)^2 = (n x w)^2, which does not cancel.
    across = nx * wy - ny * wx
    drift = across * across / rho - (room >= clearance) * (2.0 * closing * closing / clearance)
    push = nx * fx + ny * fy  # n.(F_ni - F_nj)
    demand = -slope * (drift + push) - gains.kd * rate - gains.kp * phi
    return Edges(_vector(nx, ny), rho, phi, slope, rate, demand)


def weighted(e: Edges, weight: Scalar) -> Edges:
    """The constraint `weight` phi = 0 in the place of phi = 0, weight in 0..1: an edge that fades (W1).

    Everything is linear in phi, so with a constant weight all that holds of phi holds of it.
    """
    return Edges(e.normal, e.distance, weight * e.phi, weight * e.slope, weight * e.rate, weight * e.demand)


def multipliers_edge(e: Edges, gains: Gains, bodies: int = 2) -> Scalar:
    """Each edge on its own, (33): lambda = demand / (k_2 + A A^T), A A^T = 2 phi'^2.

    bodies: how many of its ends can move; 1 at an obstacle.
    """
    return e.demand / (gains.k2 + bodies * e.slope * e.slope)


def multipliers_sweep(
    e: Edges, multipliers: Scalar, constraint: Vector, degrees: Scalar, gains: Gains
) -> Scalar:
    """One damped sweep towards the joint multipliers of (J2).

    lambda <- lambda + (demand - k_2 lambda - phi' n.(F_ci - F_cj)) / (k_2 + phi'^2 (deg_i + deg_j)):
    mass-split Jacobi (Tonge et al. 2012); the degrees in the denominator make it converge on any
    graph. Each tick continues from the last one's multipliers.

    Args:
        multipliers: lambda before the sweep.
        constraint: F_ci - F_cj with those multipliers, m/s^2.
        degrees: deg_i + deg_j.
    """
    pull = e.normal[0] * constraint[0] + e.normal[1] * constraint[1]
    residual = e.demand - gains.k2 * multipliers - e.slope * pull
    return multipliers + residual / (gains.k2 + e.slope * e.slope * degrees)


def multipliers_penalty(e: Edges, gains: Gains) -> Scalar:
    """The potential-field law that the paper argues against: the gradient of k_p phi^2 / 2, damped.

    lambda = -(k_p phi + k_d phidot), not divided by A A^T: kept as a yardstick.
    """
    return -(gains.kp * e.phi + gains.kd * e.rate)


def multipliers_fleet(
    coupling: str, e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int, gains: Gains
) -> Array:
    """Multipliers of all edges of a fleet, (m,), as its `control.coupling` finds them; "joint" exactly."""
    if coupling == "joint":
        return multipliers_joint(e, i, j, robots, gains)
    found = multipliers_edge(e, gains) if coupling == "edge" else multipliers_penalty(e, gains)
    return np.asarray(found, dtype=np.float64)


def forces(e: Edges, multipliers: Scalar) -> Vector:
    """Constraint force of every edge on its robot i: A_i^T lambda = phi' lambda n (29), m/s^2."""
    size = e.slope * multipliers
    return _vector(e.normal[0] * size, e.normal[1] * size)


def total_forces(force: Array, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
    """F_c of every robot, (32): the sum over its edges, (2, robots), from `forces` (2, m)."""
    total: Array = np.empty((2, robots))
    for axis in (0, 1):
        total[axis] = np.bincount(i, force[axis], robots) - np.bincount(j, force[axis], robots)
    return total


def multipliers_joint(e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int, gains: Gains) -> Array:
    """All multipliers at once, (J2): (k_2 I + A A^T) lambda = demand, solved exactly. Shape (m,).

    What the sweeps converge to. It needs every edge of the fleet, so no agent can call it: it is
    the reference for tests and theory.
    """
    jacobian = np.zeros((len(e.phi), 2 * robots))
    rows = np.arange(len(e.phi))
    for axis in (0, 1):
        jacobian[rows, 2 * i + axis] = e.slope * e.normal[axis]
        jacobian[rows, 2 * j + axis] = -e.slope * e.normal[axis]
    matrix = jacobian @ jacobian.T
    matrix[rows, rows] += gains.k2
    result: Array = np.asarray(np.linalg.solve(matrix, e.demand), dtype=np.float64)
    return result


def energy(e: Edges, error: Array, error_rate: Array, c1: float, gains: Gains) -> float:
    """Lyapunov function (35) with the stiffness term of (J3), for all robots and edges of a fleet.

    E = k_2 c_1/2 |e|^2 + k_2/2 |edot|^2 + 1/2 |phidot|^2 + k_p/2 |phi|^2.

    Args:
        error: e = r - r_d of every robot, (2, n), m; error_rate: its derivative, (2, n), m/s.
    """
    navigation = 0.5 * gains.k2 * (c1 * float(np.sum(error * error)) + float(np.sum(error_rate * error_rate)))
    return navigation + 0.5 * float(e.rate @ e.rate) + 0.5 * gains.kp * float(e.phi @ e.phi)


def repelling(multipliers: Scalar) -> Scalar:
    """Multipliers of one-sided constraints: they push apart (lambda > 0 where rho < d), never pull (U1)."""
    return _at_least(multipliers, 0.0)


def navigation_force(acceleration: Any, error: Any, error_rate: Any, c1: float, c2: float) -> Any:
    """F_n = rddot_d - c_1 e - c_2 edot, (21), m/s^2; any shapes that broadcast."""
    return acceleration - c1 * error - c2 * error_rate


def saturation(error_x: float, error_y: float, c1: float, c2: float, most: float) -> float:
    """Share of c_1 e that acts, so that a robot makes for its place at no more than `most` m/s (N1).

    -c_1 e - c_2 edot drives edot to -(c_1/c_2) e: that is what is limited. 1 near the place, where (21)
    holds.
    """
    wanted = c1 * (error_x * error_x + error_y * error_y) ** 0.5
    limit = c2 * most
    return 1.0 if wanted <= limit else limit / wanted
