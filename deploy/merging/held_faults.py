"""Which live fault rules held in the fleet, of those that processes of robots said to hold (PURE).

Rules of an operator go to every agent and plant. What is not recorded of most robots is left out: one
computer must not excuse, or accuse, others by rules that it made up.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Faults
from handfast.agent.messages.validation import Malformed
from handfast.agent.recorder.segments import Received

SETS_MAX: Final = 1024
"""So many sets of rules of one robot are looked at."""


class HeldFaults:
    """The sets of rules that most robots' recordings tell of.

    Args:
        fleet: its name.
        robots: whose recordings there are.
        received: what was recorded of all of them.
    """

    def __init__(self, fleet: str, robots: Iterable[int], received: Iterable[Received]) -> None:
        robots = frozenset(robots)
        self._robot_of = {
            key_expressions.faults_held(fleet, robot, role): robot
            for robot in robots
            for role in key_expressions.ROLES
        }
        holders: dict[Faults, set[int]] = {}
        counts = dict.fromkeys(robots, 0)
        for _, key, payload in received:
            robot = self._robot_of.get(key)
            if robot is None or (content := _content(payload)) is None:
                continue
            known = holders.setdefault(content, set()) if counts[robot] < SETS_MAX else holders.get(content)
            if known is not None and robot not in known:
                counts[robot] += 1
                known.add(robot)
        self._held = {content for content, known in holders.items() if 2 * len(known) > len(robots)}

    def made_up_by(self, key: str, payload: bytes) -> int | None:
        """Whose message tells of rules that most robots' recordings do not tell of; None for any other."""
        robot = self._robot_of.get(key)
        return None if robot is None or _content(payload) in self._held else robot


def _content(payload: bytes) -> Faults | None:
    """What all that hold a set say alike; None for what is no such message."""
    try:
        message = decode(payload)
    except Malformed:
        return None
    return message._replace(time_ns=0) if isinstance(message, Faults) else None
