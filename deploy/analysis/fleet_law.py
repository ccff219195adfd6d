"""The law of `agent.control.law` for a whole fleet at once: its oracle, and what analyses ask of it.

Pure (numpy only): every function takes all m edges, as arrays of shape (m,); a vector is an array (2, m) of
x and y components in W (world ENU). Within rounding, the same numbers come out as from the agents' law edge
by edge. What needs every edge of the fleet, as the exact joint multipliers do, is here alone: no agent could
call it. Forces are per unit mass (m/s^2); the force on i is ``+force``, on j ``-force``. Equation numbers are
the paper's; those marked (J) are `docs/theory.md`'s.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.quantities import DISTANCE_MIN
from handfast.agent.control.law import RELAXATION_MIN, Gains

Array = NDArray[np.float64]
Scalar = float | Array
"""One number for all edges, or one for each."""


class Edges(NamedTuple):
    """What the law needs of m edges at one instant; attributes as those of `agent.control.law.Edge`."""

    normal: Array
    distance: Array
    phi: Array
    slope: Array
    rate: Array
    demand: Array
    softness: Array


def edges(
    offset: Array,
    velocity: Array,
    navigation: Array,
    distance: Scalar,
    safe_distance: float,
    gains: Gains,
) -> Edges:
    """Constraint functions, their derivatives and the demands; arguments as of `agent.control.law.edge`."""
    x, y = offset
    wx, wy = velocity
    fx, fy = navigation
    rho = np.maximum((x * x + y * y) ** 0.5, DISTANCE_MIN)
    nx, ny = x / rho, y / rho
    span = distance - safe_distance
    room = rho - safe_distance
    clearance = np.maximum(room, max(gains.relaxation, RELAXATION_MIN) * span)
    slope = span / (clearance * clearance)
    phi = 1.0 - span / clearance + slope * (room - clearance)
    closing = nx * wx + ny * wy
    rate = slope * closing
    across = nx * wy - ny * wx
    drift = across * across / rho - (room >= clearance) * (2.0 * closing * closing / clearance)
    push = nx * fx + ny * fy
    demand = -slope * (drift + push) - gains.kd * rate - gains.kp * phi
    softness = np.broadcast_to(gains.k2 + np.maximum(gains.near, gains.far * span) / span**2, rho.shape)
    return Edges(np.array((nx, ny)), rho, phi, slope, rate, demand, softness)


def weighted(e: Edges, weight: Scalar) -> Edges:
    """The constraints `weight` phi = 0 in the place of phi = 0, weight in 0..1 (W1)."""
    return Edges(
        e.normal,
        e.distance,
        weight * e.phi,
        weight * e.slope,
        weight * e.rate,
        weight * e.demand,
        e.softness,
    )


def multipliers_edge(e: Edges, bodies: int = 2) -> Array:
    """Each edge on its own, (33): lambda = demand / (k_2 + A A^T), A A^T = 2 phi'^2.

    bodies: how many of its ends can move; 1 at an obstacle.
    """
    found: Array = e.demand / (e.softness + bodies * e.slope * e.slope)
    return found


def multipliers_sweep(e: Edges, multipliers: Array, constraint: Array, degrees: Scalar) -> Array:
    """One damped sweep of all edges towards the joint multipliers of (J2).

    Args:
        multipliers: lambda before the sweep, (m,).
        constraint: F_ci - F_cj with those multipliers, (2, m), m/s^2.
        degrees: deg_i + deg_j.
    """
    pull = e.normal[0] * constraint[0] + e.normal[1] * constraint[1]
    residual = e.demand - e.softness * multipliers - e.slope * pull
    found: Array = multipliers + residual / (e.softness + e.slope * e.slope * degrees)
    return found


def multipliers_penalty(e: Edges, gains: Gains) -> Array:
    """The potential-field law: lambda = -(k_p phi + k_d phidot)."""
    return -(gains.kp * e.phi + gains.kd * e.rate)


def multipliers_joint(e: Edges, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
    """All multipliers at once, (J2): (K_2 + A A^T) lambda = demand, solved exactly. Shape (m,).

    What the sweeps converge to.
    """
    jacobian = np.zeros((len(e.phi), 2 * robots))
    rows = np.arange(len(e.phi))
    for axis in (0, 1):
        jacobian[rows, 2 * i + axis] = e.slope * e.normal[axis]
        jacobian[rows, 2 * j + axis] = -e.slope * e.normal[axis]
    matrix = jacobian @ jacobian.T
    matrix[rows, rows] += e.softness
    result: Array = np.asarray(np.linalg.solve(matrix, e.demand), dtype=np.float64)
    return result


def forces(e: Edges, multipliers: Array) -> Array:
    """Constraint force of every edge on its robot i: A_i^T lambda = phi' lambda n (29), (2, m), m/s^2."""
    size = e.slope * multipliers
    return e.normal * size


def total_forces(force: Array, i: NDArray[np.intp], j: NDArray[np.intp], robots: int) -> Array:
    """F_c of every robot, (32): the sum over its edges, (2, robots), from `forces` (2, m)."""
    total: Array = np.empty((2, robots))
    for axis in (0, 1):
        total[axis] = np.bincount(i, force[axis], robots) - np.bincount(j, force[axis], robots)
    return total


def repelling(multipliers: Array) -> Array:
    """Multipliers of one-sided constraints: they push apart (lambda > 0 where rho < d), never pull (U1)."""
    return np.maximum(multipliers, 0.0)


def navigation_force(acceleration: Any, error: Any, error_rate: Any, c1: Any, c2: Any) -> Any:
    """F_n = rddot_d - c_1 e - c_2 edot, (21), m/s^2; any shapes that broadcast."""
    return acceleration - c1 * error - c2 * error_rate


def energy(e: Edges, error: Array, error_rate: Array, c1: float, gains: Gains) -> float:
    """Lyapunov function (J3) for all robots and edges of a fleet: (35) with stiffness, divided by k_2.

    E = c_1/2 |e|^2 + 1/2 |edot|^2 + sum over edges of (phidot^2 + k_p phi^2)/(2 k_2).

    Args:
        error: e = r - r_d of every robot, (2, n), m; error_rate: its derivative, (2, n), m/s.
    """
    navigation = c1 * float(np.sum(error * error)) + float(np.sum(error_rate * error_rate))
    return 0.5 * (navigation + float(np.sum((e.rate * e.rate + gains.kp * e.phi * e.phi) / e.softness)))
