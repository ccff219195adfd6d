"""A fleet that was up before: what it has been ordered until now, and whether a new drive may begin."""

from __future__ import annotations

import time
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
