"""Whether a new drive may begin in a fleet that was up before, and how long an operator waits for it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import digest
from handfast.agent.messages.types import Stop
from handfast.deploy.orders.operator import Known, Operator, is_since

OVER: Final = "the run is over"
"""Reason of the stop at the regular end of a drive."""
GOES_DOWN: Final = "the fleet goes down"
"""Reason of the stop before a fleet leaves its hosts."""
CAME_UP: Final = "the fleet came up"
"""Reason of the stop with which a fleet begins on its hosts: whatever was ordered before is over."""
_OF_COURSE: Final = frozenset((OVER, GOES_DOWN, CAME_UP))
BROKEN_OFF: Final = "the drive broke off"
"""Likewise at the end of one that an error of this program or its machine has ended."""


def clock(time_ns: int, now_ns: int) -> str:
    """Local time of day, with the date where that is not today's."""
    then, now = time.localtime(time_ns / NS_PER_S), time.localtime(now_ns / NS_PER_S)
    today = (then.tm_year, then.tm_yday) == (now.tm_year, now.tm_yday)
    return time.strftime("%H:%M:%S" if today else "%Y-%m-%d %H:%M:%S", then)


def why(stop: Stop) -> str:
    """The reason of a stop as it follows the sentence about it, "" without any."""
    return f": {printable(stop.reason)}" if stop.reason else ""


def is_lifted(stop: Stop) -> bool:
    """Whether the next drive lifts a stop of itself. Any other was ordered for a reason, and holds until
    somebody resumes the fleet."""
    return stop.reason in _OF_COURSE


def under_way(known: Known, now_ns: int) -> str:
    """Which mission is not over yet, in words, "" without any."""
    mission = known.mission
    if mission is None or now_ns >= mission.epoch_ns + mission.duration_ns:
        return ""
    end_ns = mission.epoch_ns + mission.duration_ns
    what = f" ({printable(mission.note)})" if mission.note else ""
    return (
        f"a mission that was given at {clock(mission.time_ns, now_ns)}{what} and ends at "
        f"{clock(end_ns, now_ns)}"
    )


def older_mission(known: Known, now_ns: int) -> str:
    """What is to be said of a mission that is not over, though somebody has stopped the fleet since it was
    given; "" where there is none."""
    mission, stop = known.mission, known.stop
    what = under_way(known, now_ns)
    if not what or mission is None or stop is None or stop.time_ns <= mission.time_ns:
        return ""
    stands = "a resume lets the robots go on with it" if known.stop_in_force else "the robots go on with it"
    return f"older than the stop of {clock(stop.time_ns, now_ns)}{why(stop)}: {what}; {stands}"


def somebodys(reason: str) -> str:
    """The reason that somebody gives for a stop, told apart from those that programs give."""
    return f"{reason}, somebody says" if reason in _OF_COURSE else reason


def refusal(known: Operator, now_ns: int, *, resume: bool, given_ns: int) -> str:
    """Why no drive may begin now, in one sentence; "" when it may.

    Args:
        known: what was ordered until now, by anybody.
        now_ns: wall clock.
        resume: whether any stop may be lifted.
        given_ns: when the drive was given: no stop since is lifted, but the regular end of another drive.
    """
    name = known.fleet.fleet.name
    if trouble := known.clock_trouble(now_ns):
        return trouble
    if known.foreign is not None:
        return (
            f"the robots of {name} read another fleet file: its digest is {known.foreign.digest[:16]}, this "
            f"one's is {digest(known.fleet)}; give the file that they read, or bring them up with this one"
        )
    stop = known.stop_in_force
    if stop is None and (what := under_way(known, now_ns)):
        return f"{name} is driving already: {what}; wait until then, or say `handfast stop` first"
    if stop is not None and stop.reason != OVER and is_since(stop, given_ns, now_ns):
        return (
            f"the robots of {name} were told to stop at {clock(stop.time_ns, now_ns)}{why(stop)}, after this "
            "drive was given; drive again if they may"
        )
    if stop is not None and not is_lifted(stop) and not resume:
        return (
            f"the robots of {name} were told to stop at {clock(stop.time_ns, now_ns)}{why(stop)}; drive with "
            "--resume if they may drive again"
        )
    return ""


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
