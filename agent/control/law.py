"""The constraint-force law of Zou & Pagilla (2008), and the sweeps to the joint multipliers that repair it.

Pure, for one edge at a time: an agent has few edges, and floats are several times faster than small arrays.
`deploy.analysis.fleet_law` has the same law for all edges of a fleet at once. Equation numbers are the
paper's; those marked (J) are `docs/theory.md`'s.

A vector is a pair of its x and y components in W (world ENU). Forces are per unit mass (m/s^2). An edge
joins robot i and robot j and everything here is antisymmetric in them: the force on i is ``+force``, on j
``-force``.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from handfast.agent.common.quantities import DISTANCE_MIN, Vector

RELAXATION_MIN: Final = 1e-3
"""Least `Gains.relaxation`: phi has a pole at rho = r_s and changes its sign below it, so that a pair
that noise or a fault has put there would be pulled together."""


APPROACH_SHARE: Final = 0.25
"""A robot makes for its place with at least this share of its speed limit, however fast the formation is."""
FIRMEST: Final = 2.0
"""A robot that is far from its place is pulled at most so many times as firmly (measured): with more, ways
round others get longer."""


class Gains(NamedTuple):
    """k_d of (18), k_2 of (24) and the stiffness k_p of (J1); k_p = 0 is the paper's law.

    An edge whose span is s = d - r_s has k_2 + max(near, far s) / s^2 in the place of k_2 (J4).

    relaxation: where rho - r_s is less than this share of d - r_s, phi goes on along its tangent (B1).
    near, far (1/m): of the softness that follows the span.
    """

    kd: float
    k2: float
    kp: float
    relaxation: float = RELAXATION_MIN
    near: float = 0.0
    far: float = 0.0


class Edge:
    """What the law needs of one edge at one instant.

    Attributes:
        normal: n = (r_i - r_j) / rho, a vector.
        distance: rho = |r_i - r_j|, m.
        phi: constraint function (7), relaxed near r_s (B1).
        slope: phi' = d phi / d rho, so that a_ij = phi' n^T (10), 1/m.
        rate: phidot (9), 1/s.
        demand: right-hand side of (33) with k_p: -Adot rdot - A F_n - k_d phidot - k_p phi, 1/s^2.
        softness: its k_2 (J4), 1/m^2.
    """

    __slots__ = "demand", "distance", "normal", "phi", "rate", "slope", "softness"

    def __init__(
        self,
        normal: Vector,
        distance: float,
        phi: float,
        slope: float,
        rate: float,
        demand: float,
        softness: float,
    ) -> None:
        self.normal: Final = normal
        self.distance: Final = distance
        self.phi: Final = phi
        self.slope: Final = slope
        self.rate: Final = rate
        self.demand: Final = demand
        self.softness: Final = softness


def edge(
    offset: Vector,
    velocity: Vector,
    navigation: Vector,
    distance: float,
    safe_distance: float,
    gains: Gains,
) -> Edge:
    """Constraint function, its derivatives and the demand on the multiplier, eqs (7)-(11), (33).

    Args:
        offset: D = r_i - r_j, m.
        velocity: w = rdot_i - rdot_j, m/s.
        navigation: F_ni - F_nj, m/s^2.
        distance: wanted distance d, m; above `safe_distance`.
        safe_distance: r_s, m.
        gains: k_d, k_p and k_2, and the relaxation of phi.
    """
    x, y = offset
    wx, wy = velocity
    fx, fy = navigation
    # In plain comparisons: this is asked for every edge at every tick.
    rho: float = (x * x + y * y) ** 0.5  # said, for a power may be complex, and would be no number in C
    if rho < DISTANCE_MIN:
        rho = DISTANCE_MIN
    nx, ny = x / rho, y / rho
    span = distance - safe_distance
    room = rho - safe_distance
    relaxation = gains.relaxation
    nearest = (relaxation if relaxation > RELAXATION_MIN else RELAXATION_MIN) * span
    clearance = room if room > nearest else nearest
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
    near, far = gains.near, gains.far * span
    softness = gains.k2 + (near if near > far else far) / (span * span)
    return Edge((nx, ny), rho, phi, slope, rate, demand, softness)


def weighted(e: Edge, weight: float) -> Edge:
    """The constraint `weight` phi = 0 in the place of phi = 0, weight in 0..1: an edge that fades (W1).

    Everything is linear in phi, so with a constant weight all that holds of phi holds of it.
    """
    return Edge(
        e.normal,
        e.distance,
        weight * e.phi,
        weight * e.slope,
        weight * e.rate,
        weight * e.demand,
        e.softness,
    )


def multiplier_edge(e: Edge, bodies: int = 2) -> float:
    """The multiplier of an edge on its own, (33): lambda = demand / (k_2 + A A^T), A A^T = 2 phi'^2.

    bodies: how many of its ends can move; 1 at an obstacle.
    """
    return e.demand / (e.softness + bodies * e.slope * e.slope)


def multiplier_sweep(e: Edge, multiplier: float, constraint: Vector, degrees: float) -> float:
    """One damped sweep of an edge towards the joint multipliers of (J2).

    lambda <- lambda + (demand - k_2 lambda - phi' n.(F_ci - F_cj)) / (k_2 + phi'^2 (deg_i + deg_j)):
    mass-split Jacobi (Tonge et al. 2012); the degrees in the denominator make it converge on any
    graph. Each tick continues from the last one's multiplier.

    Args:
        multiplier: lambda before the sweep.
        constraint: F_ci - F_cj with those of all edges, m/s^2.
        degrees: deg_i + deg_j.
    """
    pull = e.normal[0] * constraint[0] + e.normal[1] * constraint[1]
    residual = e.demand - e.softness * multiplier - e.slope * pull
    return multiplier + residual / (e.softness + e.slope * e.slope * degrees)


def multiplier_penalty(e: Edge, gains: Gains) -> float:
    """The potential-field law that the paper argues against: the gradient of k_p phi^2 / 2, damped.

    lambda = -(k_p phi + k_d phidot), not divided by A A^T: kept as a yardstick.
    """
    return -(gains.kp * e.phi + gains.kd * e.rate)


def force(e: Edge, multiplier: float) -> Vector:
    """Constraint force of an edge on its robot i: A_i^T lambda = phi' lambda n (29), m/s^2."""
    size = e.slope * multiplier
    return e.normal[0] * size, e.normal[1] * size


def repelling(multiplier: float) -> float:
    """Multiplier of a one-sided constraint: it pushes apart (lambda > 0 where rho < d), never pulls (U1)."""
    return multiplier if multiplier > 0.0 else 0.0


def navigation_force(acceleration: float, error: float, error_rate: float, c1: float, c2: float) -> float:
    """F_n = rddot_d - c_1 e - c_2 edot, (21), m/s^2, along one axis."""
    return acceleration - c1 * error - c2 * error_rate


def acting_error(error: Vector, place_velocity: Vector, c1: float, c2: float, most: float) -> Vector:
    """The error that acts in (21), so that a robot makes for its place at no more than `most` m/s (N1).

    -c_1 e - c_2 edot drives the robot's velocity to v_d - (c_1/c_2) e: that is cut to the circle of `most`,
    or of what reaches a place that drives as fast itself. So c_1 times what acts is the gradient of a convex
    function of e, whatever the place's velocity v_d. Equal to `error` near the place, where (21) holds.
    """
    x, y = error
    vx, vy = place_velocity
    pull = c1 / c2
    wx, wy = vx - pull * x, vy - pull * y
    wanted: float = (wx * wx + wy * wy) ** 0.5
    if wanted <= most:
        return error
    most = fastest(place_velocity, most)
    if wanted <= most:
        return error
    share = most / wanted
    return (vx - share * wx) / pull, (vy - share * wy) / pull


def fastest(place_velocity: Vector, most: float) -> float:
    """V of (N1), m/s: the speed at which a robot makes for its place, `most` for one that is slower."""
    x, y = place_velocity
    speed: float = (x * x + y * y) ** 0.5
    return max(most, speed + APPROACH_SHARE * most)


def firmness(
    error: Vector, acting: Vector, place_velocity: Vector, c1: float, c2: float, most: float, rate: float
) -> float:
    """gamma of (N2): so many times (21) pulls and damps a robot that is far from its place; 1 near it.

    It makes for its place at the same speed, but comes to that sooner, and is not held back by what pulls at
    it meanwhile. It goes with U of (N1), so the pull is the gradient of a convex function still, and
    is never more than that of (21) alone.

    Args:
        acting: of that error.
        rate: how fast it comes to its speed at most, 1/s; up to c2 all is as (N1) has it.
    """
    if rate <= c2 or acting == error:
        return 1.0
    x, y = error
    over_x, over_y = x - acting[0], y - acting[1]
    vx, vy = place_velocity
    # 2 U / c1, and the square of how far from its place (21) may hold at all.
    energy = x * x + y * y - over_x * over_x - over_y * over_y
    speed: float = (vx * vx + vy * vy) ** 0.5
    zone = (fastest(place_velocity, most) + speed) * c2 / c1
    return min(FIRMEST, rate / c2, max(1.0, 0.5 + 0.5 * energy / (zone * zone)))
