"""Is the control loop stable at this rate, with these gains and limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from math import inf, sqrt
from typing import Final

import numpy as np

from handfast.agent.control.limits import steps, why_not
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry
from handfast.deploy.analysis.couplings import coupling_of, law_of
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
