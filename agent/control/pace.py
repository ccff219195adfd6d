"""How far a fleet's rate can fall, and how fast robots then drive (PURE).

Where a machine cannot keep `fleet.rate_hz`, all robots of the fleet decide more rarely, by steps: in step s
each period is 2^s times as long. Here is which of them the law, the safety filter and the timeouts carry, and
what is left of the speed (docs/theory.md, R1 and R2). `handfast check` looks closer, at the whole formation.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.safety_distances import LOWEST_SHARE, barrier_rate
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import SLOW_SHARE

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
        return f"avoidance.barrier_rate = {barrier_rate(fleet):.3g} 1/s, and {rate:g} Hz carry {most}"
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
