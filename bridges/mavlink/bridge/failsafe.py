"""Tells whether a vehicle went out of GUIDED by a failsafe of its own, rather than by its operator (PURE).

A heartbeat only says which mode it is in. ArduPilot says beside it what made it change: ``EKF failsafe``,
``Radio Failsafe``, ``GCS Failsafe``, ``Battery 1 is low ...``, ``Crash: Going to HOLD`` (Rover's
failsafe.cpp, crash_check.cpp, AP_BattMonitor.cpp). Of its fence Rover says no text, but FENCE_STATUS tells:
`BREACHED`.
"""

from __future__ import annotations

import re
from typing import Final

from handfast.agent.common.time import NS_PER_S

TOGETHER_NS: Final = 2 * NS_PER_S
"""A text and a change of mode that are no further apart are one matter, whichever comes first."""
BREACHED: Final = "fence breached"
"""What is heard of FENCE_STATUS."""
_FAILSAFE: Final = re.compile(
    r"\bfailsafe\b(?! clear)|\bBattery \d+ is (low|critical)\b|\bCrash: |\bfence breach", re.IGNORECASE
)


class OwnFailsafe:
    """What the vehicle said of a failsafe, and whether that has it.

    Attributes:
        why: the vehicle's own text, "" where no failsafe has it.
    """

    def __init__(self) -> None:
        self.why = ""
        self._text, self._said_ns, self._left_ns = "", 0, 0
        self._operator = ""

    def hear(self, now_ns: int, text: str) -> None:
        """Takes a text of the vehicle."""
        if _FAILSAFE.search(text):
            self._text, self._said_ns = text, now_ns

    def step(self, now_ns: int, operator: str) -> None:
        """Takes what keeps commands from it: another mode than GUIDED, disarmed; "" nothing."""
        if operator != self._operator:
            # From one mode into another it is its operator who brings it, whatever had it before.
            self._left_ns = 0 if self._operator or not operator else now_ns
            self._operator, self.why = operator, ""
        if self._left_ns and self._text and abs(self._said_ns - self._left_ns) <= TOGETHER_NS:
            self.why = self._text
