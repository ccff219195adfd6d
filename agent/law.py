"""The constraint-force law of Zou & Pagilla (2008), and the joint multipliers that repair it.

Pure, and vectorised over edges: an agent calls it with its own k edges, a simulation of a whole
fleet with all m. Equation numbers are the paper's; those marked (J) are `docs/theory.md`'s.

Vectors are arrays of shape (2, m), x and y first, in W (world ENU), one column an edge;
scalars of an edge have shape (m,). Forces are per unit mass (m/s^2). An edge joins robot i and
robot j and everything here is antisymmetric in them: the force on i is ``+force``, on j ``-force``.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLEARANCE_MIN: Final = 1e-3
"""Least rho - r_s that the law computes with, as a share of d - r_s.

phi has a pole at rho = r_s and changes its sign below it: a pair that noise or a fault has put at
or under the safe distance would be pulled together. Held at this clearance it is pushed apart.
"""
DISTANCE_MIN: Final = 1e-9
"""Least rho (m): two coincident hand points have no direction between them, and then no force."""


class Gains(NamedTuple):
    """k_d of (18), k_2 of (24) and the stiffness k_p of (J1); k_p = 0 is the paper's law."""

    kd: float
    k2: float
    kp: float


class Edges(NamedTuple):
    """What the law needs of m edges at one instant, each of shape (m,) unless said.

    Attributes:
        normal: n = (r_i - r_j) / rho, shape (2, m).
        distance: rho = |r_i - r_j|, m.
        phi: constraint function (7).
        slope: phi' = d phi / d rho, so that a_ij = phi' n^T (10), 1/m.
        rate: phidot (9), 1/s.
        demand: right-hand side of (33) with k_p: -Adot rdot - A F_n - k_d phidot - k_p phi, 1/s^2.
    """

    normal: Array
    distance: Array
    phi: Array
    slope: Array
    rate: Array
    demand: Array


def edges(
    offset: Array, velocity: Array, navigation: Array, distance: Any, safe_distance: float, gains: Gains
) -> Edges:
    """Constraint function, its derivatives and the demand on the multiplier, eqs (7)-(11), (33).

    Args:
        offset: D = r_i - r_j, (2, m), m.
        velocity: w = rdot_i - rdot_j, (2, m), m/s.
        navigation: F_ni - F_nj, (2, m), m/s^2.
        distance: wanted distances d, (m,) or one number, m; each above `safe_distance`.
        safe_distance: r_s, m.
        gains: k_d, k_2, k_p.
    """
    rho = np.hypot(offset[0], offset[1])
    np.maximum(rho, DISTANCE_MIN, out=rho)
    normal = offset / rho
    span = distance - safe_distance
    clearance = np.maximum(rho - safe_distance, CLEARANCE_MIN * span)
    phi = (rho - distance) / clearance  # (7)
    slope = span / (clearance * clearance)  # phi'
    nx, ny = normal
    wx, wy = velocity
    closing = nx * wx + ny * wy  # n.w
    rate = slope * closing  # (9)
    # Adot rdot = phi'' (n.w)^2 + phi' (|w|^2 - (n.w)^2) / rho, with phi'' = -2 phi' / (rho - r_s)
    # and |w|^2 - (n.w)^2 = (n x w)^2, which does not cancel.
    across = nx * wy - ny * wx
    drift = across * across / rho - 2.0 * closing * closing / clearance
    push = nx * navigation[0] + ny * navigation[1]  # n.(F_ni - F_nj)
    demand = -slope * (drift + push) - gains.kd * rate - gains.kp * phi
    return Edges(normal, rho, phi, slope, rate, demand)


def multipliers_edge(e: Edges, gains: Gains) -> Array:
    """Each edge on its own, (33): lambda = demand / (k_2 + A A^T), A A^T = 2 phi'^2. Shape (m,)."""
    result: Array = e.demand / (gains.k2 + 2.0 * e.slope * e.slope)
    return result


def multipliers_sweep(e: Edges, multipliers: Array, constraint: Array, degrees: Any, gains: Gains) -> Array:
    """One damped sweep towards the joint multipliers of (J2), shape (m,).

    lambda <- lambda + (demand - k_2 lambda - phi' n.(F_ci - F_cj)) / (k_2 + phi'^2 (deg_i + deg_j)):
    mass-split Jacobi (Tonge et al. 2012); the degrees in the denominator make it converge on any
    graph. Each tick continues from the last one's multipliers.

    Args:
        multipliers: lambda before the sweep, (m,).
        constraint: F_ci - F_cj with those multipliers, (2, m), m/s^2.
        degrees: deg_i + deg_j, (m,) or one number.
    """
    pull = e.normal[0] * constraint[0] + e.normal[1] * constraint[1]
    residual = e.demand - gains.k2 * multipliers - e.slope * pull
    result: Array = multipliers + residual / (gains.k2 + e.slope * e.slope * degrees)
    return result


def multipliers_penalty(e: Edges, gains: Gains) -> Array:
    """The potential-field law that the paper argues against: the gradient of k_p phi^2 / 2, damped.

    lambda = -(k_p phi + k_d phidot), not divided by A A^T: kept as a yardstick. Shape (m,).
    """
    result: Array = -(gains.kp * e.phi + gains.kd * e.rate)
    return result


def forces(e: Edges, multipliers: Array) -> Array:
    """Constraint force of every edge on its robot i: A_i^T lambda = phi' lambda n (29), (2, m), m/s^2."""
    result: Array = e.normal * (e.slope * multipliers)
    return result


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


def navigation_force(acceleration: Any, error: Any, error_rate: Any, c1: float, c2: float) -> Any:
    """F_n = rddot_d - c_1 e - c_2 edot, (21), m/s^2; any shapes that broadcast."""
    return acceleration - c1 * error - c2 * error_rate
