"""What the law does to a fleet by linear algebra, before anybody drives: its modes, their decay, its start.

Pure (numpy only).

The sampled loop
    Near the formation the law is linear in e = r - r_d, and for every coupling its gains act mode by
    mode. With A the constraint matrix of all edges at the formation, phi ~ A e, and u = -K1 e - K2 edot
    in each mode of these symmetric matrices (mu their eigenvalue):

        joint    A^T (k2 + A A^T)^-1 A            K = (1 - mu) (c1, c2) + mu (kp, kd),  0 <= mu < 1
        edge     A^T (k2 + diag(A A^T))^-1 A      the same, but mu can pass 1: the gap in Theorem 1
        penalty  A^T A                            K = (c1, c2) + mu (kp, kd)

    A mode is a double integrator under a zero-order hold: its sampled eigenvalues are computed, not
    estimated, with the transport delay of one period predicted away (as the agents do) and not. The joint
    law's multipliers move by one sweep a tick; `sweep_radius` has these dynamics in the eigenvalues too.
"""

from __future__ import annotations

from math import inf, isfinite, log, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.control import law
from agent.fleet.model import Fleet
from agent.fleet.sections import ControlSection
from agent.formation.geometry import Geometry, start_hands
from agent.formation.points import edge_lengths
from agent.formation.trajectory import make_trajectory
from deploy.analysis import fleet_law
from deploy.analysis.rigidity import rigidity_matrix

Floats = NDArray[np.float64]

SETTLED: Final = 0.05
"""Share of its distance within which an edge counts as settled."""


class Mode(NamedTuple):
    """One mode of the linearised formation: u = -k1 e - k2 edot; `shape`: it changes edges' lengths."""

    k1: float
    k2: float
    shape: bool


def modes(geometry: Geometry, control: ControlSection, safe_distance: float) -> tuple[Mode, ...]:
    """Modes of the law linearised at the formation, 2n of them; see the module's head.

    Raises nothing, but asks for every distance to be above `safe_distance` (m).
    """
    n = len(geometry.ids)
    jacobian = _jacobian(geometry, safe_distance)
    if control.coupling == "edge":
        weight = control.k2 + np.sum(jacobian**2, axis=1)
        values = np.linalg.svd(jacobian / np.sqrt(weight)[:, None], compute_uv=False) ** 2
    else:
        values = np.linalg.svd(jacobian, compute_uv=False) ** 2
    if control.coupling == "joint":
        values = values / (control.k2 + values)
    found = []
    for value in [*values.tolist(), *[0.0] * (2 * n - len(values))][: 2 * n]:
        rest = 1.0 if control.coupling == "penalty" else 1.0 - value
        found.append(
            Mode(rest * control.c1 + value * control.kp, rest * control.c2 + value * control.kd, value > 1e-9)
        )
    return tuple(found)


def _jacobian(geometry: Geometry, safe_distance: float) -> Floats:
    """A of all edges at the formation, (m, 2n): phi' = 1 / (d - r_s) where rho = d (10)."""
    slope = 1.0 / (geometry.distances - safe_distance)
    jacobian: Floats = rigidity_matrix(geometry.offsets, geometry.edges) * slope[:, None]
    return jacobian


def sampled_radius(mode: Mode, rate_hz: float, *, predicted: bool = True) -> float:
    """Largest |eigenvalue| of one mode under a zero-order hold; below 1 it is stable.

    Args:
        rate_hz: of the control loop.
        predicted: the transport delay of one period is predicted away; else the force that acts is
            the one computed a period earlier.
    """
    h = 1.0 / rate_hz
    if predicted:
        matrix = np.array(
            [[1.0 - 0.5 * h * h * mode.k1, h - 0.5 * h * h * mode.k2], [-h * mode.k1, 1.0 - h * mode.k2]]
        )
    else:
        matrix = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [-mode.k1, -mode.k2, 0.0]])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def sweep_radius(geometry: Geometry, control: ControlSection, safe_distance: float, rate_hz: float) -> float:
    """Largest |eigenvalue| of the sampled joint law with its multipliers moved by one sweep a tick.

    State: e, edot of every robot and the multiplier of every edge, with neighbours predicted exactly.
    lambda' = lambda + W^-1 (A (c1 e + c2 edot) - kd A edot - kp A e - (k2 + A A^T) lambda), the
    sweep of `agent.control.law`, and u = -c1 e - c2 edot + A^T lambda'.
    """
    jacobian = _jacobian(geometry, safe_distance)
    m, n2 = jacobian.shape
    h = 1.0 / rate_hz
    degree = np.bincount(geometry.edges.ravel(), minlength=n2 // 2)
    slope2 = 1.0 / (geometry.distances - safe_distance) ** 2
    gain = 1.0 / (control.k2 + slope2 * degree[geometry.edges].sum(axis=1))
    sweep = np.hstack(
        [
            (control.c1 - control.kp) * gain[:, None] * jacobian,
            (control.c2 - control.kd) * gain[:, None] * jacobian,
            np.eye(m) - gain[:, None] * (control.k2 * np.eye(m) + jacobian @ jacobian.T),
        ]
    )
    force = (
        np.hstack([-control.c1 * np.eye(n2), -control.c2 * np.eye(n2), np.zeros((n2, m))])
        + jacobian.T @ sweep
    )
    hold = np.hstack([np.eye(n2), h * np.eye(n2), np.zeros((n2, m))])
    velocity = np.hstack([np.zeros((n2, n2)), np.eye(n2), np.zeros((n2, m))])
    matrix = np.vstack([hold + 0.5 * h * h * force, velocity + h * force, sweep])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def settling_time(fleet: Fleet, geometry: Geometry) -> float | None:
    """Estimate (s) of when every edge is within `SETTLED` of its distance; None when it never is.

    From the slowest mode that changes edges, as if all of the largest relative error at the start were
    in it: right within a factor of two for assigned slots; a formation that must unfold takes longer.
    """
    safe = fleet.formation.safe_distance_m
    lengths = edge_lengths(start_hands(fleet), geometry.edges)
    error = np.abs(lengths / geometry.distances - 1.0).max(initial=0.0)
    rates = [_decay(mode) for mode in modes(geometry, fleet.control, safe) if mode.shape]
    if not rates or error <= SETTLED:
        return 0.0
    return log(float(error) / SETTLED) / min(rates) if min(rates) > 0.0 else None


def _decay(mode: Mode) -> float:
    """-Re of the slower root of s^2 + k2 s + k1, 1/s."""
    root = mode.k2 * mode.k2 - 4.0 * mode.k1
    if root <= 0.0:
        return 0.5 * mode.k2
    return 2.0 * mode.k1 / (mode.k2 + sqrt(root))


class Start(NamedTuple):
    """The law at t = 0: |u| (n,), m/s^2, and |e| (n,), m, of every robot; energy E(0) of the fleet, (J3)."""

    demand: Floats
    error: Floats
    energy: float


def at_start(fleet: Fleet, geometry: Geometry) -> Start:
    """The law where the fleet file has the robots stand, before anything is clipped."""
    control = fleet.control
    gains = law.Gains(control.kd, control.k2, control.kp, control.relaxation)
    x, y, vx, vy, ax, ay = make_trajectory(fleet.trajectory).at(0.0)
    error = (start_hands(fleet) - geometry.offsets - (x, y)).T
    rate = np.broadcast_to(np.array([[-vx], [-vy]]), error.shape)  # the robots start at rest
    navigation = fleet_law.navigation_force(np.array([[ax], [ay]]), error, rate, control.c1, control.c2)
    i, j = geometry.edges[:, 0], geometry.edges[:, 1]
    n = len(geometry.ids)
    if not len(i):
        energy = 0.5 * control.k2 * float(control.c1 * np.sum(error**2) + np.sum(rate**2))
        return Start(np.hypot(*navigation), np.hypot(*error), energy)
    position = error + geometry.offsets.T
    edges = fleet_law.edges(
        position[:, i] - position[:, j],
        np.zeros((2, len(i))),
        navigation[:, i] - navigation[:, j],
        geometry.distances,
        fleet.formation.safe_distance_m,
        gains,
    )
    multipliers = fleet_law.multipliers_fleet(control.coupling, edges, i, j, n, gains)
    total = navigation + fleet_law.total_forces(fleet_law.forces(edges, multipliers), i, j, n)
    return Start(np.hypot(*total), np.hypot(*error), fleet_law.energy(edges, error, rate, control.c1, gains))


def guaranteed_distance(fleet: Fleet, geometry: Geometry) -> float | None:
    """Least distance (m) that any edge will ever have, by the energy at the start (docs/theory.md).

    |phi| <= sqrt(2 E(0) / kp) for all time, and phi = (rho - d) / (rho - r_s) or its tangent (B1). It
    holds for the joint law with k_p > 0 while nothing is clipped; None where it says nothing.
    """
    control, safe = fleet.control, fleet.formation.safe_distance_m
    lengths = edge_lengths(start_hands(fleet), geometry.edges)
    if control.coupling != "joint" or control.kp <= 0.0 or float(lengths.min(initial=inf)) <= safe:
        return None
    span = float(geometry.distances.min()) - safe
    phi = sqrt(2.0 * at_start(fleet, geometry).energy / control.kp)
    beyond = phi - (1.0 / control.relaxation - 1.0)  # of what phi is where its tangent begins
    if beyond <= 0.0:
        least = safe + span / (1.0 + phi)
    else:
        least = safe + span * (control.relaxation - control.relaxation**2 * beyond)
    return least if isfinite(least) and least > safe else None
