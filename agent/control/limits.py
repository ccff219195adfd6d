"""What a fleet file gives to the law and the safety filter: distances, gains, and rates (PURE). Lengths in m.

**Distances** from which on robots keep away from robots without a common edge.

**Gains.** With phi alone a formation of short edges behaves differently from one of long edges: phi has no
unit, and where forces are in balance depends on k_p / (k_2 c_1 s^2), with s = d - r_s. So k_2, where the
fleet file does not give it, goes with 1 / s^2, edge by edge. Then every length of the law goes with the
edges', and every time stays what it is (docs/theory.md, J4).

**Rates.** Where a machine cannot keep `fleet.rate_hz`, all robots of the fleet decide more rarely, by
steps: in step s each period is 2^s times as long. This module finds the steps that the law, the safety
filter and the timeouts carry, with what is left of the speed (docs/theory.md, R1 and R2). `handfast check`
looks at the whole formation.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from math import hypot, inf
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.law import Gains
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import SLOW_SHARE

_ALONE: Final = 2.5
"""d_a / r_s of a formation without an edge."""
_MOST: Final = 2.8
"""d_a / r_s at most, however long edges are. With 2, folded formations with late links do not come apart."""
ROLLS_S: Final = 1.0
"""Time that a runaway vehicle has driven on before the others see it, s."""
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
        Where none is given: half way between the safe distance and the shortest edge, but at most 2.8 safe
        distances, however long edges are; 2.5 where there is no edge; at most 0.9 of the least distance
        between the places of two members without an edge, so that it is silent when the formation stands; at
        least 1.05 safe distances.
    """
    if given is not None:
        return given
    distance = min(0.5 * (safe + min(edges.values())), _MOST * safe) if edges else _ALONE * safe
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
    """p of the safety filter, 1/s: the largest up to 3 at which robots can brake by (F4), and at
    which the filter is stable as it is sampled."""
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
    """Return the distance within which every message of another robot is used, m; `distance` is d_a.

    It is larger in fleets with a runaway vehicle (one that drives on when its computer dies), because the
    evasive manoeuvre has to begin earlier.
    """
    rolls_m = ROLLS_S * speed_max(fleet) if any(robot.kind.rolls_on_s for robot in fleet.robots) else 0.0
    return max(distance + AHEAD_M, braking_room(fleet) + rolls_m)


def clearance(given: float | None, safe: float) -> float:
    """How near a hand point may come to an obstacle, m; `given` is `avoidance.clearance_m`, `safe` r_s."""
    return 0.5 * safe if given is None else given


SOFTNESS: Final = 4.0
"""k_2 s^2 of an edge (measured): above, folded shapes come apart; the less, the sooner a formation stands."""
FOLD: Final = 1.4
"""So many spans away from its place is a robot of a folded shape: its pull there must win (measured)."""


def gains_of(fleet: Fleet) -> Gains:
    """The gains of all edges of a fleet: k_2 as given, else as it goes with their span."""
    control = fleet.control
    if control.k2 is not None:
        return Gains(control.kd, control.k2, control.kp, control.relaxation)
    # From further away than c2 V / c1 the pull grows no more (N1), so what it has to win against must not.
    far = FOLD * control.c1 / (control.c2 * speed_max(fleet)) if fleet.avoidance.enabled else 0.0
    return Gains(control.kd, 0.0, control.kp, control.relaxation, SOFTNESS, SOFTNESS * far)


def one_sided(gains: Gains) -> Gains:
    """Those of a one-sided constraint: it acts from half of an edge's span on, as soft as that edge."""
    return gains._replace(near=0.25 * gains.near, far=0.5 * gains.far)


def softness(gains: Gains, span: float) -> float:
    """k_2 of an edge (J4), 1/m^2; span: d - r_s, m."""
    return gains.k2 + max(gains.near, gains.far * span) / (span * span)


PERIOD_MAX_S: Final = 0.25
"""No step has a longer period: what is older counts as late (`UNSURE_NS`), and a stop waits no longer."""
REST_PERIOD_MAX_S: Final = 0.5
"""In a large fleet, while no mission is near."""
STEPS_MAX: Final = 8
STANDING_SHARE: Final = 0.7
"""Wrenches come at the latest after so large a share of the plant's patience while all stand."""
STANDING_PROMISE_NS: Final = NS_PER_S
"""Who stands because a machine is overloaded promises no more than to be heard within so long: what is late
there says nothing, and where it stands does not change."""
_ROUNDING: Final = 1e-9


def steps(fleet: Fleet) -> int:
    """By how many steps the rate may fall: as far as nothing speaks against each."""
    step = 0
    while step < STEPS_MAX and not why_not(fleet, step + 1):
        step += 1
    return step


def rest_period_ns(fleet: Fleet) -> int:
    """Time between two ticks of an agent of a large fleet while no mission is near, ns, a power of two of
    periods; 0 for the usual. Hundreds of processes that only wait are to leave the machine to those that
    start."""
    if not fleet.is_large:
        return 0
    period_ns = _doubled(fleet, REST_PERIOD_MAX_S)
    return period_ns if period_ns > fleet.period_ns else 0


def standing_period_ns(fleet: Fleet) -> int:
    """Time between two ticks of an agent while all stand because a machine is overloaded, ns, a power of two
    of periods. Who stands needs no law, but its plant and its neighbours need to know that it is there; and
    who has too much to do must have less of it then, or it never ends."""
    patience_s = min(fleet.control.plant_timeout_s, fleet.control.wrench_timeout_s)
    return _doubled(fleet, min(PERIOD_MAX_S, STANDING_SHARE * patience_s))


def _doubled(fleet: Fleet, most_s: float) -> int:
    """The full rate's period, ns, doubled as often as it stays at most `most_s`."""
    period_ns = fleet.period_ns
    while 2 * period_ns <= most_s * NS_PER_S * (1.0 + _ROUNDING):
        period_ns *= 2
    return period_ns


def gap_ns(fleet: Fleet) -> int:
    """The longest time between two decisions by which a robot can be said to be controlled: no longer than
    the longest period, and until its body brakes by itself."""
    return round(min(PERIOD_MAX_S, fleet.control.wrench_timeout_s) * NS_PER_S)


def why_not(fleet: Fleet, step: int) -> str:
    """What speaks against a step in a fleet, naming the field to change; "" when nothing does."""
    control, period_s = fleet.control, (1 << step) / fleet.fleet.rate_hz
    rate, given = 1.0 / period_s, control.rate_min_hz
    if given is not None and rate < given * (1.0 - _ROUNDING):
        return f"control.rate_min_hz = {given:g} Hz"
    if period_s > PERIOD_MAX_S * (1.0 + _ROUNDING):
        return f"no period is longer than {PERIOD_MAX_S:g} s"
    waits = {
        "control.plant_timeout_s": control.plant_timeout_s,
        "control.wrench_timeout_s": control.wrench_timeout_s,
        f"{SLOW_SHARE:g} control.prediction_horizon_s": SLOW_SHARE * control.prediction_horizon_s,
    }
    field = min(waits, key=lambda each: waits[each])
    if waits[field] < 2.0 * period_s * (1.0 - _ROUNDING):
        return f"{field} = {waits[field]:g} s is less than two periods of {period_s:g} s"
    if fleet.avoidance.enabled and barrier_rate(fleet) > LOWEST_SHARE * rate * (1.0 + _ROUNDING):
        most = f"at most {LOWEST_SHARE * rate:.3g} 1/s"
        return f"the safety filter's rate is {barrier_rate(fleet):.3g} 1/s, and {rate:g} Hz carry {most}"
    if control.law is not None or control.coupling == "penalty":  # how stiff it is, is not known here
        field = "control.law" if control.law is not None else "control.coupling"
        return "" if given is not None else f"of this {field} only control.rate_min_hz says what it carries"
    if not all(is_stable(k1, k2, period_s) for k1, k2 in _stiffest(fleet)):
        return f"the gains of the law are too high for {rate:g} Hz"
    return ""


def speed_share(fleet: Fleet, level: int) -> float:
    """How much of its speed limit a robot has left, where a period is 2^level times as long (R2).

    It hears of what another does two periods later at most, and brakes at the rate p: so the way until it
    stands stays what it is at the full rate.
    """
    p, period_s = barrier_rate(fleet), fleet.period_ns / NS_PER_S
    return (1.0 + 2.0 * p * period_s) / (1.0 + 2.0 * p * (1 << level) * period_s)


def is_stable(k1: float, k2: float, period_s: float) -> bool:
    """Whether a mode with the gains k1 (1/s^2) and k2 (1/s), held for a period, is stable: carried forward
    to the middle of the period in which it acts (P2), and also where it is not."""
    h = period_s
    seen = 0.5 * h * k1 + k2
    ahead = 0.125 * h * h * k1 + 0.5 * h * k2
    way = 0.5 * h * h * k1
    predicted = (way + h * seen + ahead - 2.0, 1.0 + way - h * seen - 2.0 * ahead, ahead)
    late = (-2.0, 1.0 + h * k2 + way, way - h * k2)
    return _within_circle(*predicted) and _within_circle(*late)


def _within_circle(a2: float, a1: float, a0: float) -> bool:
    """Whether all roots of z^3 + a2 z^2 + a1 z + a0 are within the unit circle (Jury 1964)."""
    return (
        1.0 + a2 + a1 + a0 > 0.0
        and 1.0 - a2 + a1 - a0 > 0.0
        and abs(a0) < 1.0
        and abs(a0 * a0 - 1.0) > abs(a0 * a2 - a1)
    )


def _stiffest(fleet: Fleet) -> list[tuple[float, float]]:
    """Gains between which those of all modes at the formation lie: navigation's, and the edges' share mu.

    mu is below 1 of joint multipliers, and at most the largest degree of edges that are each on their own.
    """
    control = fleet.control
    modes = [(control.c1, control.c2)]
    if fleet.formation.edges:
        mu = 1.0 if control.coupling == "joint" else float(max(map(fleet.degree, fleet.ids)))
        modes.append(
            (
                max(control.c1, control.c1 + mu * (control.kp - control.c1)),
                max(control.c2, control.c2 + mu * (control.kd - control.c2)),
            )
        )
    return modes
