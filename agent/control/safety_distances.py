"""From which distances on robots keep away from what they share no edge with (PURE). Lengths in m."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from math import hypot, inf
from typing import Final

from handfast.agent.fleet.model import Fleet

_ALONE: Final = 2.5
"""d_a / r_s of a formation without an edge."""
_SHARE: Final = 0.9
"""Largest share of what the formation puts between two robots: the rest is for errors of control."""
_LEAST: Final = 1.05
"""Least d_a / r_s: phi' = 1/(d_a - r_s) must stay finite."""
SPEED_SHARE: Final = 0.5
"""Of the speed limit, by which one period may change a velocity at most."""
TURN_MAX: Final = 0.12
"""rad: further than this a body must not turn within a period."""
TURN_SHARE: Final = 0.5
"""So much of a turn may be taken away within a period."""
AHEAD_M: Final = 0.9
"""From so much further on than d_a robots are listened to closely, m."""
_RATE: Final = 3.0
"""1/s: at 50 Hz the sampled filter is far from its limits (docs/theory.md)."""
LOWEST_SHARE: Final = 0.3
"""p by the lowest rate to which an overloaded fleet falls, at most."""
RATE_SHARE: Final = 0.25
"""p by the rate of the loop, at most: the sampled filter, and (F9) at 2 p, then are far from their limits."""


def avoidance_distance(
    given: float | None,
    safe: float,
    edges: Mapping[tuple[int, int], float],
    offsets: Mapping[int, tuple[float, float]],
) -> float:
    """d_a: robots without an edge push each other apart when they are nearer than this.

    Args:
        given: `avoidance.distance_m`, taken as it is.
        safe: r_s, `formation.safe_distance_m`.
        edges: wanted distance of each edge, by the ids at its ends, in either order.
        offsets: place of each member by its id.

    Returns:
        Where none is given: half way between the safe distance and the shortest edge, 2.5 safe distances
        when there is no edge; at most 0.9 of the least distance between the places of two members without an
        edge, so that it is silent when the formation stands; at least 1.05 safe distances.
    """
    if given is not None:
        return given
    distance = 0.5 * (safe + min(edges.values())) if edges else _ALONE * safe
    least = least_apart(edges, offsets, (distance / _SHARE) * (1.0 + 1e-9))  # more would change nothing
    return max(min(distance, _SHARE * least), _LEAST * safe)


def least_apart(
    edges: Mapping[tuple[int, int], float], offsets: Mapping[int, tuple[float, float]], within: float = inf
) -> float:
    """Least distance between the places of two members without an edge; inf when none are nearer than
    `within`."""
    least = within
    # From left to right, so that of many robots only those are compared that could be nearer.
    in_order = sorted((x, y, robot) for robot, (x, y) in offsets.items())
    for k, (xi, yi, i) in enumerate(in_order, 1):
        for xj, yj, j in islice(in_order, k, None):
            if xj - xi >= least:
                break
            if abs(yi - yj) < least and (i, j) not in edges and (j, i) not in edges:
                least = min(least, hypot(xi - xj, yi - yj))
    return least if least < within else inf


def speed_max(fleet: Fleet) -> float:
    """V_max, m/s: `control.max_speed_mps`, but no more than robots of this acceleration can steer at.

    From V_max they brake at the rate a / V_max, and turn into another way no sooner. Where that is below
    c1 / c2, the rate at which the law comes to a place, they drive past their places, further each time.
    """
    control = fleet.control
    if not fleet.avoidance.enabled:
        return control.max_speed_mps
    return min(control.max_speed_mps, control.max_acceleration * control.c2 / control.c1)


def barrier_rate(fleet: Fleet) -> float:
    """p of the safety filter, 1/s: as given, or the largest up to 3 at which robots can brake by (F4), and at
    which the filter is stable as it is sampled."""
    given = fleet.avoidance.barrier_rate
    if given is not None:
        return given
    return min(_sampled_rate(fleet), fleet.control.max_acceleration / speed_max(fleet))


def speeding_rate(fleet: Fleet) -> float:
    """How fast robots may come to their speed limit, (F6), and come to the speed at which they make for a
    place that is far, (N2), 1/s: what the loop carries, whether they can brake at that rate or not."""
    return max(barrier_rate(fleet), _sampled_rate(fleet))


def _sampled_rate(fleet: Fleet) -> float:
    """The largest rate up to 3, 1/s, at which the filter is stable as it is sampled."""
    rate = min(_RATE, RATE_SHARE * fleet.fleet.rate_hz)
    lowest = fleet.control.rate_min_hz
    return rate if lowest is None else min(rate, LOWEST_SHARE * lowest)


def acceleration_max(fleet: Fleet) -> float:
    """The largest |u|, m/s^2: as given; with the safety filter no more than changes the speed, within a
    period, by half of its limit, for (F6) looks along the motion alone."""
    control = fleet.control
    if not fleet.avoidance.enabled:
        return control.max_acceleration
    return min(control.max_acceleration, SPEED_SHARE * speed_max(fleet) * fleet.fleet.rate_hz)


def braking_room(fleet: Fleet) -> float:
    """Distance at which two robots must have heard of each other, m: what lets both come at full speed.

    There h of the safety filter is 2 V_max / p, and (F1) admits any speed that is allowed.
    """
    keep = fleet.formation.safe_distance_m + fleet.avoidance.margin_m
    return keep + 2.0 * speed_max(fleet) / barrier_rate(fleet)


def sensing_distance(fleet: Fleet, distance: float) -> float:
    """From where on a robot is listened to closely, m; `distance` is d_a."""
    return max(distance + AHEAD_M, braking_room(fleet))


def clearance(given: float | None, safe: float) -> float:
    """How near a hand point may come to an obstacle, m; `given` is `avoidance.clearance_m`, `safe` r_s."""
    return 0.5 * safe if given is None else given
