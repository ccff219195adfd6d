"""What the law does to a fleet by linear algebra, before anybody drives: its modes' decay, its start.

Pure (numpy only). A mode (`deploy.analysis.couplings`) is a double integrator under a zero-order hold: its
sampled eigenvalues are computed, not estimated, with the transport delay of one period predicted away (as the
agents do) and not.
"""

from __future__ import annotations

from math import inf, isfinite, log, sqrt
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.common.quantities import Vector
from handfast.agent.control.law import acting_error, firmness
from handfast.agent.control.limits import speed_max, speeding_rate
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, start_hands
from handfast.agent.formation.points import Floats, edge_lengths
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.analysis import fleet_law
from handfast.deploy.analysis.couplings import FleetCoupling, FleetLaw, Mode, coupling_of

TINY_M: Final = 1e-9
SETTLED: Final = 0.05
"""Share of its distance within which an edge counts as settled."""


def sampled_radius(mode: Mode, rate_hz: float, *, predicted: bool = True) -> float:
    """Largest |eigenvalue| of one mode under a zero-order hold; below 1 it is stable.

    Args:
        rate_hz: of the control loop.
        predicted: the state is carried forward to the middle of the period in which the force acts (P2), by
            the force before it, which is all that is known then; else the force that acts is the one
            computed a period earlier.
    """
    h, k1, k2 = 1.0 / rate_hz, mode.k1, mode.k2
    if predicted:
        seen = np.array([k1, 0.5 * h * k1 + k2, 0.125 * h * h * k1 + 0.5 * h * k2])
        hold = np.array([[1.0, h, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
        matrix = hold - np.outer([0.5 * h * h, h, 1.0], seen)
    else:
        matrix = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [-k1, -k2, 0.0]])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def settling_time(fleet: Fleet, geometry: Geometry, law: FleetLaw) -> float | None:
    """Estimate (s) of when every edge is within `SETTLED` of its distance; None when it never is.

    From the slowest mode that changes edges, as if all of the largest relative error at the start were
    in it, after the way that a robot drives at its limit of speed (N1): right within a factor of two for
    assigned slots; a formation that must unfold takes longer.
    """
    lengths = edge_lengths(start_hands(fleet), geometry.edges)
    error = np.abs(lengths / geometry.distances - 1.0).max(initial=0.0)
    rates = [_decay(mode) for mode in law.modes(geometry) if mode.shape]
    if not rates or error <= SETTLED:
        return 0.0
    if min(rates) <= 0.0:
        return None
    far = _far(fleet, geometry)
    return far + log(max(1.0, float(error) / SETTLED)) / min(rates)


def _far(fleet: Fleet, geometry: Geometry) -> float:
    """How long (s) the robot that starts furthest out makes for its place at its limit of speed (N1)."""
    if not fleet.avoidance.enabled:
        return 0.0
    control = fleet.control
    x, y, vx, vy, _, _ = make_trajectory(fleet.trajectory).at(0.0)
    error = (start_hands(fleet) - geometry.offsets - (x, y)).T
    acting = np.hypot(*_acting(fleet, error, (vx, vy)))
    away = np.hypot(*error)
    # Far out edot = -(c1/c2) `acting`; the last c2/c1 seconds of that are those of the modes.
    longest = float(np.max(away / np.maximum(acting, TINY_M), initial=0.0, where=away > TINY_M))
    return max(0.0, (longest - 1.0) * control.c2 / control.c1)


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


def at_start(fleet: Fleet, geometry: Geometry, coupling: FleetCoupling) -> Start:
    """The law where the fleet file has the robots stand, before anything is clipped."""
    control, gains = fleet.control, coupling.gains
    x, y, vx, vy, ax, ay = make_trajectory(fleet.trajectory).at(0.0)
    error = (start_hands(fleet) - geometry.offsets - (x, y)).T
    rate = np.broadcast_to(np.array([[-vx], [-vy]]), error.shape)  # the robots start at rest
    acting = _acting(fleet, error, (vx, vy))
    firm = _firmness(fleet, error, acting, (vx, vy))
    navigation = fleet_law.navigation_force(
        np.array([[ax], [ay]]), acting, rate, firm * control.c1, firm * control.c2
    )
    i, j = geometry.edges[:, 0], geometry.edges[:, 1]
    n = len(geometry.ids)
    if not len(i):
        energy = 0.5 * float(control.c1 * np.sum(error**2) + np.sum(rate**2))
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
    multipliers = coupling.multipliers(edges, i, j, n)
    total = navigation + fleet_law.total_forces(fleet_law.forces(edges, multipliers), i, j, n)
    return Start(np.hypot(*total), np.hypot(*error), fleet_law.energy(edges, error, rate, control.c1, gains))


def _acting(fleet: Fleet, error: Floats, velocity: Vector) -> Floats:
    """The errors that act (N1), (2, n), m, of robots whose places move with `velocity` (m/s)."""
    control = fleet.control
    if not fleet.avoidance.enabled:
        return error
    c1, c2, most = control.c1, control.c2, speed_max(fleet)
    return np.array([acting_error((x, y), velocity, c1, c2, most) for x, y in error.T.tolist()]).T


def _firmness(fleet: Fleet, error: Floats, acting: Floats, velocity: Vector) -> Floats:
    """gamma of (N2), (n,), of the same robots."""
    control = fleet.control
    if not fleet.avoidance.enabled:
        return np.ones(error.shape[1])
    limits = control.c1, control.c2, speed_max(fleet), speeding_rate(fleet)
    both = zip(error.T.tolist(), acting.T.tolist(), strict=True)
    return np.array([firmness((x, y), (ax, ay), velocity, *limits) for (x, y), (ax, ay) in both])


def guaranteed_distance(fleet: Fleet, geometry: Geometry) -> float | None:
    """Least distance (m) that any edge will ever have, by the energy at the start (docs/theory.md).

    |phi| <= sqrt(2 E(0) k2 / kp) of each edge for all time, and phi = (rho - d) / (rho - r_s) or its tangent
    (B1). It holds for a bounded coupling with k_p > 0 while nothing is clipped; None where it says nothing.
    """
    control, safe = fleet.control, fleet.formation.safe_distance_m
    lengths = edge_lengths(start_hands(fleet), geometry.edges)
    coupling = coupling_of(fleet)
    if coupling is None or not coupling.bounded or control.kp <= 0.0:
        return None
    if float(lengths.min(initial=inf)) <= safe:
        return None
    span = geometry.distances - safe
    softness = coupling.softness(geometry)
    phi = np.sqrt(2.0 * at_start(fleet, geometry, coupling).energy * softness / control.kp)
    beyond = phi - (1.0 / control.relaxation - 1.0)  # of what phi is where its tangent begins
    tangent = control.relaxation - control.relaxation**2 * beyond
    least = safe + float((span * np.where(beyond <= 0.0, 1.0 / (1.0 + phi), tangent)).min(initial=inf))
    return least if isfinite(least) and least > safe else None
