"""What is promised of two robots that do not hear each other, from bounds on links, clocks and brakes (PURE).

Equations (S1), (S2), (S6) of docs/theory.md, for one fleet. Whoever judges a run can ask it: with what the
links did, how near may a pair have come that was out of touch, and by when does a silent robot stand.
"""

from __future__ import annotations

from math import inf
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.constraint_assembly import STOP_S
from handfast.agent.control.limits import barrier_rate, speed_max
from handfast.agent.control.peers.beliefs import STANDS_S, said_doubt, stands_after
from handfast.agent.control.peers.lateness import LATE_MAX_NS, UNSURE_NS
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import SEND_BOUND_M
from handfast.plant.unicycle import BRAKE_DECELERATION_MAX, BRAKE_TIME_S

UNSURE_S: Final = UNSURE_NS / NS_PER_S


class Links(NamedTuple):
    """Bounds on the links of a fleet while they are not silent, and on its clocks and brakes.

    Attributes:
        delay_s: oldest that a message is when it comes, s.
        gap_s: longest time between two of them, s.
        clock_s: by how much two clocks differ beyond what is corrected, s.
        deceleration: least with which a robot brakes that holds, m/s^2.
    """

    delay_s: float = 0.0
    gap_s: float = 0.0
    clock_s: float = 0.0
    deceleration: float = BRAKE_DECELERATION_MAX


class Promise(NamedTuple):
    """What holds of robots that do not hear each other.

    Attributes:
        stands_s: a robot that nobody hears stands so long after its last message, unless it may go on with
            others: T_s (S1).
        kept_m: the least distance of two robots, (S6).
        unmet: the conditions of the proofs that this fleet does not meet, one sentence each: with any of them
            nothing is promised.
    """

    stands_s: float
    kept_m: float
    unmet: tuple[str, ...]


def promised(fleet: Fleet, links: Links, *, off_m: float = 0.0, lanes_m: float = 0.0) -> Promise:
    """What is promised of a fleet.

    Args:
        off_m: e, by how much robots are off the ways that the others look for them on.
        lanes_m: q, how far the lanes of one robot are apart as two know them.
    """
    safe, control = fleet.formation.safe_distance_m, fleet.control
    most, rate = speed_max(fleet), barrier_rate(fleet)
    period_s = 1.0 / fleet.fleet.rate_hz
    beacon_s = fleet.beacon_rounds * period_s
    allowed_s = links.delay_s + links.gap_s
    rest_s = (fleet.beacon_rounds_max - fleet.beacon_rounds) * period_s
    late_max_s = LATE_MAX_NS / NS_PER_S + 2.0 * rest_s
    promised_s = (fleet.hands_within_ns - fleet.period_ns) / NS_PER_S
    forgiven_s = min(max(0.0, allowed_s + rest_s + promised_s - UNSURE_S), late_max_s)
    bound_m = SEND_BOUND_M if control.send == "event" else 0.0
    braking_s = BRAKE_TIME_S + most / links.deceleration if links.deceleration > 0.0 else inf
    unmet = []
    if not fleet.avoidance.enabled:
        unmet.append("avoidance.enabled = false: nothing keeps robots apart that share no edge")
    if most * rate > control.max_acceleration * (1.0 + 1e-9):
        unmet.append(
            f"avoidance.barrier_rate = {rate:g} 1/s times {most:g} m/s is more than "
            f"control.max_acceleration = {control.max_acceleration:g} m/s2: robots cannot brake so hard"
        )
    if rate * STOP_S > 1.0:
        unmet.append(f"avoidance.barrier_rate = {rate:g} 1/s: at most {1.0 / STOP_S:g} 1/s")
    left_s = STANDS_S + forgiven_s + control.prediction_horizon_s
    if 2.0 * (beacon_s + links.delay_s) > left_s:
        unmet.append(
            f"beacons every {beacon_s:g} s that are {links.delay_s:g} s late: what robots relay of a silent "
            f"one comes later than {left_s:g} s after it was given up"
        )
    if beacon_s + links.delay_s + braking_s > STANDS_S:
        unmet.append(
            f"a robot at {most:g} m/s needs {braking_s:.2f} s to brake: with beacons every {beacon_s:g} s "
            f"that are {links.delay_s:g} s late it does not stand {STANDS_S:g} s after it gives up the last"
        )
    moved = off_m + bound_m + most * links.clock_s - said_doubt(forgiven_s + UNSURE_S)
    sampled = rate * most * period_s * period_s
    kept = safe + fleet.avoidance.margin_m - max(0.0, moved, lanes_m) - sampled
    return Promise(stands_after(control.prediction_horizon_s, forgiven_s), kept, tuple(unmet))
