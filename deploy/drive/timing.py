"""How long an operator waits for a fleet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from handfast.agent.common.time import NS_PER_S

OWN_AHEAD_NS: Final = NS_PER_S // 4
OWN_AHEAD_PER_PROCESS_NS: Final = NS_PER_S // 250
"""Of processes on the machine of who drives them: each of them has to run once until the mission begins."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of a drive, s or ns as their names say.

    Attributes:
        epoch_ahead_ns: the mission is out this long before the epoch: every agent has it by then.
        stopped_ahead_ns: likewise for a fleet that stands after a stop: the resume comes when all have
            acknowledged the mission.
        ready_s, ready_per_process_s: how long a fleet may take to be ready.
        vehicles_ready_s: so long for vehicles: one that was just switched on takes 40 s, and its operator has
            to arm it.
        waits_period_s: how often it is said what is waited for.
        hand_over_ns: so long after the epoch all must have acknowledged the mission, if they are to be left
            alone.
        stop_again_s: a status comes five times a second: who has not acknowledged a stop by then may not have
            heard it.
        stop_s: how long robots may take to stand; `interrupt_stop_s` after Ctrl-C, where their processes end
            with this one.
        vehicles_stop_s: a rover takes seconds to rest: its bridge stays for that, also after Ctrl-C; a second
            Ctrl-C ends it.
    """

    epoch_ahead_ns: int = NS_PER_S // 2
    stopped_ahead_ns: int = 2 * NS_PER_S
    ready_s: float = 10.0
    ready_per_process_s: float = 0.5
    vehicles_ready_s: float = 120.0
    waits_period_s: float = 5.0
    hand_over_ns: int = 2 * NS_PER_S
    stop_again_s: float = 0.25
    stop_s: float = 2.0
    interrupt_stop_s: float = 0.3
    vehicles_stop_s: float = 4.0

    @classmethod
    def of_own_machine(cls, processes: int, listening_ns: int) -> Timing:
        """For so many processes on the machine of who drives them: no network is between them.

        Args:
            listening_ns: so long after its first tick a robot may begin to drive; it is ready before that.
        """
        return cls(epoch_ahead_ns=max(listening_ns, OWN_AHEAD_NS + processes * OWN_AHEAD_PER_PROCESS_NS))

    def ready_timeout_s(self, processes: int, *, has_vehicles: bool) -> float:
        """After so long a fleet that is not ready will not be."""
        least_s = self.vehicles_ready_s if has_vehicles else 0.0
        return max(self.ready_s + self.ready_per_process_s * processes, least_s)

    def standstill_timeout_s(self, *, has_vehicles: bool, is_hurried: bool) -> float:
        """After so long a robot that was not heard to stop will not be."""
        if has_vehicles:
            return self.vehicles_stop_s
        return self.interrupt_stop_s if is_hurried else self.stop_s
