"""Checks of the control loop: stability, stiffness of the edges, and event-triggered sending.

Stability concerns the rate, gains and limits. Edges that are too stiff against navigation may let the
formation come to rest in another shape: at rest the pull to a place balances lambda phi' of its edges, with
k2 lambda = -kp phi. phi has no unit, so the share that counts is

    S = kp / (k2 p s),    s = d - r_s,    p the pull from FOLD s away, c1 s at most (N1)

of docs/theory.md (J4), the same for a formation of any size. The thresholds of event-triggered sending must
suit noise, rate, horizon and law.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from math import hypot, inf, pi, sqrt
from typing import Final

import numpy as np

from handfast.agent.control.event_trigger import LOOKAHEAD_S
from handfast.agent.control.law import APPROACH_SHARE
from handfast.agent.control.limits import FOLD, SOFTNESS, speed_max, steps, why_not
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import SEND_BOUND_M, Robot
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.deploy.analysis.couplings import coupling_of, law_of
from handfast.deploy.analysis.fleet_law import Array
from handfast.deploy.analysis.stability import SETTLED, at_start, sampled_radius, settling_time
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.wording import robots

_ROUNDING: Final = 1e-9
SWEEP_ROBOTS_MAX: Final = 60
"""Largest fleet whose multiplier sweeps are in the sampled eigenvalues: their matrix grows with n."""


def check_saturation(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Saturation at the start."""
    coupling = coupling_of(fleet)
    if coupling is None:
        return
    start = at_start(fleet, geometry, coupling)
    limit = fleet.control.max_acceleration
    over = np.flatnonzero(start.demand > limit)
    if len(over):
        worst = int(np.argmax(start.demand))
        yield Finding(
            "info",
            "control.max_acceleration",
            f"{robots([geometry.ids[k] for k in over.tolist()])} will be clipped at {limit:.4g} m/s2 at "
            f"first: the law asks for {start.demand[worst]:.3g} m/s2 of robot {geometry.ids[worst]}, which "
            f"starts {start.error[worst]:.3g} m from its place. The guarantee of the theory holds from where "
            "it is no longer clipped; start nearer, or raise the limit if the robots can do it",
        )


def check_gains(fleet: Fleet) -> Iterator[Finding]:
    """Do coupling, gains and relaxation suit this fleet's size and distances."""
    control, coupling = fleet.control, coupling_of(fleet)
    if coupling is None:
        return
    remark = coupling.remark(len(fleet.members))
    if remark:
        yield Finding("info", coupling.place, remark)
    if control.kp == 0.0:
        yield Finding(
            "info",
            "control.kp",
            "0: nothing pulls an edge back to its distance but navigation, so close pairs creep apart "
            "(measured: 45 % of random starts not settled in 40 s even with the joint law); 1 is the "
            "measured best",
        )


def check_loop(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Is the law stable at the formation: as it is, sampled, and with its delay not predicted."""
    law, rate = law_of(fleet), fleet.fleet.rate_hz
    linear = law.modes(geometry) if law is not None else ()
    if law is None or not linear:
        return
    softest = min(linear, key=lambda mode: min(mode.k1, mode.k2))
    if min(softest.k1, softest.k2) <= 0.0:
        yield Finding(
            "error",
            law.place,
            "the law is unstable at the formation itself: in one of its modes it pulls with "
            f"{softest.k1:.3g} 1/s2 and damps with {softest.k2:.3g} 1/s, where both must be above 0"
            f"{law.unstable}",
        )
        return
    extreme = (*linear, *law.stiffest)

    def radius(at: float, predicted: bool) -> float:
        return max(sampled_radius(mode, at, predicted=predicted) for mode in set(extreme))

    sweeps = len(geometry.edges) > 0 and len(geometry.ids) <= SWEEP_ROBOTS_MAX

    def whole(at: float) -> float:
        result = radius(at, True)
        return max(result, law.sweep_radius(geometry, at)) if sweeps else result

    @cache
    def is_stable(at: float) -> bool:  # `whole` is below 1, which is found sooner than what it is
        return radius(at, True) < 1.0 and (not sweeps or law.sweeps_stably(geometry, at))

    stiffest = max(extreme, key=lambda mode: max(mode.k2, sqrt(mode.k1)))
    gains = f"its stiffest mode has {stiffest.k1:.3g} 1/s2 and {stiffest.k2:.3g} 1/s"
    if not is_stable(rate):
        needed = _rate_for(whole, rate)
        yield Finding(
            "error",
            "fleet.rate_hz",
            f"{rate:.4g} Hz is too slow for these gains: the sampled loop is unstable (largest eigenvalue "
            f"{whole(rate):.4g}; {gains}); take at least {needed:.3g} Hz, or {law.softer}",
        )
    elif radius(rate, False) >= 1.0 or not is_stable(0.5 * rate):
        needed = _rate_for(lambda at: max(whole(0.5 * at), radius(at, False)), rate)
        yield Finding(
            "warning",
            "fleet.rate_hz",
            f"{rate:.4g} Hz leaves little margin: the loop is stable only while a delay of one period is "
            f"predicted and no two periods in a row are missed ({gains}); take at least {needed:.3g} Hz, or "
            f"{law.softer}",
        )
    lowest = rate / (1 << steps(fleet))
    if is_stable(rate) and not is_stable(lowest):
        halves = 1
        while is_stable(rate / (2 * halves)):
            halves *= 2
        yield Finding(
            "warning",
            "control.rate_min_hz",
            f"an overloaded fleet falls to {lowest:.4g} Hz, at which the sampled loop is unstable (largest "
            f"eigenvalue {whole(lowest):.4g}; {gains}); take {rate / halves:.4g} Hz",
        )
    # s^2 (lag s + 1) + K2 s + K1 is stable while K2 > lag K1 (Routh).
    row, robot = max(enumerate(fleet.robots, 1), key=lambda item: item[1].actuator_lag_s)
    slow = max(linear, key=lambda mode: mode.k1 / mode.k2)
    share = robot.actuator_lag_s * slow.k1 / slow.k2
    if share > 0.5:
        yield Finding(
            "error" if share >= 1.0 else "warning",
            f"robot[{row}].actuator_lag_s",
            f"{robot.actuator_lag_s:.4g} s is {'too ' if share >= 1.0 else ''}long for these gains: a mode "
            f"with {slow.k1:.3g} 1/s2 and {slow.k2:.3g} 1/s is unstable from {slow.k2 / slow.k1:.3g} s on; "
            f"{law.damped}",
        )
    settling = settling_time(fleet, geometry, law)
    if settling is not None and settling > fleet.fleet.duration_s:
        yield Finding(
            "info",
            "fleet.duration_s",
            f"{fleet.fleet.duration_s:.4g} s may end before the formation stands: with these gains and "
            f"starts edges need about {settling:.3g} s to come within {SETTLED:.0%}",
        )


def check_lowest_rate(fleet: Fleet) -> Iterator[Finding]:
    """Is the lowest rate that the file gives one to which an overloaded fleet can fall."""
    rate, given, most = fleet.fleet.rate_hz, fleet.control.rate_min_hz, steps(fleet)
    if given is not None and rate / (2 << most) >= given * (1.0 - _ROUNDING):
        yield Finding(
            "warning",
            "control.rate_min_hz",
            f"an overloaded fleet does not fall to {given:.4g} Hz, but to {rate / (1 << most):.4g} Hz at the "
            f"lowest: against {rate / (2 << most):.4g} Hz speaks that {why_not(fleet, most + 1)}",
        )


def _rate_for(radius: Callable[[float], float], rate: float) -> float:
    """A rate (Hz) near the lowest, at or above `rate`, at which `radius` is below 1; inf if none up
    to 1 MHz."""
    while radius(rate) >= 1.0:
        rate *= 1.2
        if rate > 1e6:
            return inf
    return rate


_SHARES: Final = (0.5, 0.63, 0.82, 1.37, 2.05, 4.1, 8.2)
_FOLDED: Final = (0.0, 0.001, 0.011, 0.10, 0.17, 0.49, 0.74)
_FOLDED_ASSIGNED: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.002, 0.008)
"""Of random starts, by S: how many of the delta came to rest in another shape, with places as they come, and
assigned (600 to 2000 each)."""
_FOLDED_MAX: Final = 0.05
_FOLDED_ASSIGNED_MAX: Final = 0.002
_GOOD: Final = 0.63
"""S of kp = 1 and a k2 that is left out."""


def stiffness(fleet: Fleet, geometry: Geometry) -> Array:
    """S of each edge, (m,); without edges or for a law of others none."""
    control, coupling = fleet.control, coupling_of(fleet)
    if coupling is None or not coupling.shares_navigation:
        return np.zeros(0)
    span = geometry.distances - fleet.formation.safe_distance_m
    pull = control.c1 * span
    if fleet.avoidance.enabled:
        most = speed_max(fleet)
        left = max(APPROACH_SHARE * most, most - trajectory.maximum_speed(fleet.trajectory))
        pull = np.minimum(pull, control.c2 * left / FOLD)
    share: Array = control.kp / (coupling.softness(geometry) * pull * span)
    return share


def check_stiffness(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Folded shapes; every distance is above the safe one."""
    try:
        shares = stiffness(fleet, geometry)
    except ValueError:
        return  # a trajectory that cannot be made: `deploy.check.shape` says so
    if not len(shares):
        return
    control, worst = fleet.control, int(np.argmax(shares))
    share, assigned = float(shares[worst]), fleet.formation.assign
    folded = float(np.interp(share, _SHARES, _FOLDED_ASSIGNED if assigned else _FOLDED))
    if folded < (_FOLDED_ASSIGNED_MAX if assigned else _FOLDED_MAX):
        return
    i, j = (geometry.ids[end] for end in geometry.edges[worst].tolist())
    less = control.kp * _GOOD / share
    others = ""
    if control.k2 is not None:
        others = f", or leave control.k2 = {control.k2:.4g} out (it then follows the distances)"
        less_alone = control.kp * _GOOD / _without(fleet, geometry)
        if less_alone < control.kp:
            others += f" with kp = {less_alone:.2g}"
    yield Finding(
        "warning",
        "control.kp",
        f"{control.kp:.4g} is stiff for edge [{i}, {j}] of {geometry.distances[worst]:.4g} m: it is "
        f"{share / _GOOD:.2g} times as stiff against navigation as was measured to be good, and the "
        f"formation may come to rest folded, in another shape (measured: about {folded:.1%} of random starts"
        f"{' with assigned places' if assigned else ''}); take {less:.2g} or less{others}",
    )


def _without(fleet: Fleet, geometry: Geometry) -> float:
    """Largest S with a k2 that is left out."""
    span = geometry.distances - fleet.formation.safe_distance_m
    shares = stiffness(fleet, geometry) * (fleet.control.k2 or 0.0)
    far = FOLD * fleet.control.c1 / (fleet.control.c2 * speed_max(fleet))
    softness = SOFTNESS * np.maximum(1.0, far * span if fleet.avoidance.enabled else 0.0) / span**2
    return float((shares / softness).max())


QUIET: Final = 2.5
"""A bound so many times as large as what noise makes of predictions on average is seldom exceeded by it."""


def check_sending(fleet: Fleet) -> Iterator[Finding]:
    """What makes event-sent hand states pointless, or dangerous."""
    control = fleet.control
    if control.send == "periodic":
        return
    if not control.prediction:
        yield Finding(
            "warning",
            "control.prediction",
            "false: neighbours expect a robot to stay where its last hand state left it, so it sends one in "
            "every period in which it moves",
        )
    if control.law is not None:
        yield Finding(
            "info",
            "control.law",
            "what a law of others will ask for nobody can predict: a robot sends a hand state in every "
            "period in which the law asks for more than navigation does, or changes its numbers; and all "
            "keep further from a robot, the longer it is silent",
        )
    yield from _check_noise(fleet)


def _check_noise(fleet: Fleet) -> Iterator[Finding]:
    off = {robot.id: _off(fleet, robot) for robot in fleet.robots}
    noisy = [robot for robot, by in off.items() if QUIET * by > SEND_BOUND_M]
    if not noisy:
        return
    worst = max(noisy, key=lambda robot: off[robot])
    yield Finding(
        "warning",
        "control.send",
        f"measurement noise alone puts predictions of {robots(noisy)} off by {off[worst]:.2g} m on average: "
        'they send hand states in nearly every period, as with "periodic"',
    )


def _off(fleet: Fleet, robot: Robot) -> float:
    """How far noise puts a prediction off on average by the measure of (E1), m."""
    control, reach = fleet.control, robot.hand_offset_m
    place = hypot(robot.position_noise_m, reach * robot.heading_noise_rad)
    force = max(control.c1, control.kp) * place
    # Of the difference of two draws, each of two axes: the mean of a Rayleigh distribution.
    mean = sqrt(2.0) * sqrt(0.5 * pi)
    return mean * (place + 0.5 * LOOKAHEAD_S * LOOKAHEAD_S * force)
