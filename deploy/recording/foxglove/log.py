"""What Foxglove's Log panel shows: what happens in a fleet, as it comes (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from math import dist
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import EVERY_AUTHOR, Event, Faults, Mission, Resume, Status, Stop, clipped
from handfast.deploy.console.wording import robots
from handfast.deploy.recording.foxglove.diagnostics import ERROR, WARN, in_short, level_of
from handfast.deploy.recording.foxglove.json_text import STAMP, dumps

_INFO, _WARNING, _ERROR = 2, 3, 4
_LEVELS: Final = {WARN: _WARNING, ERROR: _ERROR}
_WORDS: Final = {"kill": "killed", "start": "started", "stop": "paused", "continue": "continued"}
_LINE: Final = '{"timestamp":' + STAMP + ',"level":%d,"message":%s,"name":%s,"file":"","line":0}'
_APART: Final = 1.05
"""Two robots that were too close are apart again at this multiple of the safe distance: at it, noise would
part them again and again."""


class Log:
    """Makes lines of what is heard, each order, fault and violation once.

    Attributes:
        lines: their contents, with `STAMP` for the time, until somebody takes them away.
    """

    def __init__(self, safe_m: float) -> None:
        self._safe_m = safe_m
        self.lines: list[str] = []
        self._order = -1
        self._faults: dict[str, int] = {}
        self._close: dict[tuple[int, int], float] = {}

    def status(self, status: Status) -> None:
        """A robot has come to another state."""
        level = _LEVELS.get(level_of(status.state), _INFO)
        self._add(level, f"robot {status.robot}", in_short(status))

    def silent(self, robot: int) -> None:
        """A robot's agent is not heard any more."""
        self._add(_WARNING, f"robot {robot}", "not heard")

    def heard(self, robot: int) -> None:
        """It is heard again."""
        self._add(_INFO, f"robot {robot}", "heard again")

    def mission(self, mission: Mission) -> None:
        """Takes a mission that is newer than those before."""
        text = mission.note or f"a drive of {mission.duration_ns / NS_PER_S:g} s"
        self._add(_INFO, "operator", f"mission: {text}")

    def order(self, order: Stop | Resume) -> None:
        """Takes a stop or a resume, again and again."""
        if order.version <= self._order:
            return
        self._order = order.version
        if type(order) is Stop:
            self._add(_WARNING, "operator", "stop" + (f": {order.reason}" if order.reason else ""))
        elif type(order) is Resume:
            who = robots(order.robots) if order.robots else "all robots"
            self._add(_INFO, "operator", f"resume: {who}")

    def faults(self, faults: Faults) -> None:
        """Takes an author's live fault rules, again and again."""
        known = self._faults.get(faults.author)
        if not faults.rules if known is None else faults.version <= known:
            return
        self._faults[faults.author] = faults.version
        if faults.rules:
            rules = clipped(" ".join(faults.rules.split()))
            self._add(_WARNING, "faults", f"live faults of {faults.author}: {rules}")
        else:
            whose = "all live faults" if faults.author == EVERY_AUTHOR else f"live faults of {faults.author}"
            self._add(_INFO, "faults", f"{whose} are cleared")

    def event(self, event: Event) -> None:
        """Takes what was done to a process on purpose."""
        text = f"{event.role} of robot {event.robot} {_WORDS[event.what]}"
        self._add(_WARNING, "faults", f"{text} ({event.rule})" if event.rule else text)

    def distances(self, close: Mapping[tuple[int, int], float], hands: Mapping[int, Vector]) -> None:
        """Takes the pairs that are closer than the safe distance now."""
        for pair, distance in close.items():
            if pair not in self._close:
                apart = f"{robots(pair)} are {distance:.3f} m apart"
                self._add(_ERROR, "safety", f"{apart}, less than the safe distance of {self._safe_m:.3f} m")
            self._close[pair] = min(distance, self._close.get(pair, distance))
        for pair in [pair for pair in self._close if pair not in close]:
            here, there = (hands.get(robot) for robot in pair)
            if here is None or there is None:  # its body has been carried off
                del self._close[pair]
            elif dist(here, there) > _APART * self._safe_m:
                least_m = self._close.pop(pair)
                self._add(_INFO, "safety", f"{robots(pair)} are apart again; they were {least_m:.3f} m apart")

    def _add(self, level: int, name: str, message: str) -> None:
        self.lines.append(_LINE % (level, dumps(message), dumps(name)))
