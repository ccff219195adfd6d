"""What happens in a fleet that drives, in sentences: orders, changes of state, robots that lag (PURE)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.console.wording import grouped, robots

SENTENCES_MAX: Final = 8
"""So many changes of one moment are shown; of more only the number."""
AGAIN_NS: Final = 30 * NS_PER_S
"""A vehicle that says one thing again and again is quoted once in a while of silence as long."""
_STANDBY: Final = State.STANDBY.value
_RELEASED: Final = State.RELEASED.value
_ACTIVE: Final = DRIVING_NAMES | {State.HOLDING.value, _RELEASED}
_IN: Final = (_STANDBY, State.FAULT.value)


ORDERED: Final = "order"
CHANGED: Final = "state"


class Happening(NamedTuple):
    """Something that happened: `ORDERED` or `CHANGED`, in words, to which robots (none: to all), and when an
    order was given (ns, wall clock), 0 for what has happened since the last look."""

    kind: str
    text: str
    robots: tuple[int, ...] = ()
    time_ns: int = 0


class News:
    """Makes sentences of the orders and states that are heard of a fleet.

    That robots become ready, start, and come to rest at the end is left out.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._duration_s = fleet.fleet.duration_s
        self._states: dict[int, str] = {}
        self._away: dict[int, str] = {}
        """Robots that do not drive although others do, and how it is said that they do again."""
        self._orders: list[tuple[str, int]] = []
        """What was ordered or is worth knowing, and when it was given, 0: now."""
        self._changes: list[tuple[int, str, str, str]] = []
        self._remarks: set[str] = set()
        self._said_ns: dict[tuple[int, str], int] = {}

    def order(self, message: Mission | Stop | Resume) -> None:
        """Takes a mission, stop or resume that is newer than those before."""
        if type(message) is Mission:
            self._duration_s = message.duration_ns / NS_PER_S
            self._orders += [(message.note, message.time_ns)] if message.note else []
        elif type(message) is Stop:
            why = f": {message.reason}" if message.reason else ""
            self._orders.append((f"every robot is told to stop{why}", message.time_ns))
        else:
            assert type(message) is Resume
            who = robots(message.robots) if message.robots else "all robots"
            self._orders.append((f"{who} may drive again", message.time_ns))

    def state(self, robot: int, state: str, reason: str) -> None:
        """Takes the state that a robot reports, and why, again and again."""
        before = self._states.get(robot, "")
        if state != before:
            self._states[robot] = state
            self._changes.append((robot, before, state, reason))

    def remark(self, robot: int, text: str) -> None:
        """Takes what is worth knowing of a robot; it is said once."""
        text = f"{robots([robot])}: {text}"
        if text not in self._remarks:
            self._remarks.add(text)
            self._orders.append((text, 0))

    def said(self, robot: int, text: str, time_ns: int) -> None:
        """Takes what a robot's vehicle said; the same again soon after is not said again."""
        before_ns = self._said_ns.get((robot, text))
        self._said_ns[robot, text] = time_ns
        if before_ns is None or time_ns - before_ns > AGAIN_NS:
            self._orders.append((f"{robots([robot])}: {text}", 0))

    def happenings(self, time_s: float | None) -> list[Happening]:
        """What happened since the last call; `time_s` is the fleet time, None before the epoch is set."""
        said = [Happening(ORDERED, text, time_ns=time_ns) for text, time_ns in self._orders]
        self._orders = []
        told = dict.fromkeys(
            (self._words(robot, before, state, reason, time_s), robot)
            for robot, before, state, reason in self._changes
        )
        self._changes = []
        changes = [
            Happening(CHANGED, f"{_are(ids)} {text}", tuple(sorted(ids)))
            for text, ids in grouped(told)
            if text
        ]
        more = len(changes) - SENTENCES_MAX
        said += changes[:SENTENCES_MAX]
        return [*said, Happening(CHANGED, f"and {more} more changes of state")] if more > 0 else said

    def sentences(self, time_s: float | None) -> list[str]:
        """The same in sentences, each with its time."""
        at = "" if time_s is None else f"{time_s:.1f} s: "
        return [at + each.text for each in self.happenings(time_s)]

    def _words(self, robot: int, before: str, state: str, reason: str, time_s: float | None) -> str:
        """The change after "robot 3 is", "" when it is not worth a line."""
        why = f": {reason}" if reason else ""
        if state == _STANDBY and before not in _ACTIVE:
            self._away.setdefault(robot, "")
            return ""
        if time_s is None or time_s < 0.0:
            if state == _RELEASED:
                self._away[robot] = "back: "
                return f"released{why}"
            return ""
        if state == State.STOPPING.value or (state == State.STOPPED.value and time_s >= self._duration_s):
            # On its way to rest, or there at the end of the drive: as it should be.
            self._away.pop(robot, None)
            return ""
        if state == State.RUNNING.value:
            back = self._away.pop(robot, None)
            return "" if back is None else f"{back}running"
        if state == State.READY.value or (state == State.WAITING.value and before not in DRIVING_NAMES):
            return ""
        self._away[robot] = "back: "
        return f"in {state}{why}" if state in _IN else f"{state}{why}"


def _are(ids: Iterable[int]) -> str:
    """'robot 3 is', 'robots 1 and 2 are'."""
    shown = sorted(ids)
    return f"{robots(shown)} {'is' if len(shown) == 1 else 'are'}"


PATIENCE_S: Final = 3.0
"""Who has not come nearer for so long lags."""
NEARER: Final = 0.9
"""Share of its distance to which a robot has to have come to be nearer."""


class Lagging:
    """Watches how far robots are from their places."""

    def __init__(self) -> None:
        self._since: dict[int, tuple[float, float]] = {}
        """Since when (s) a robot has not come nearer, and how far it was then (m)."""

    def look(self, time_s: float, distances_m: Mapping[int, float], allowed_m: float) -> list[int]:
        """Those that lag, the farthest first.

        Args:
            distances_m: of each robot that drives from its place.
            allowed_m: who is nearer than this is there.
        """
        for robot in self._since.keys() - distances_m.keys():
            del self._since[robot]
        found = []
        for robot, distance_m in distances_m.items():
            since_s, was_m = self._since.get(robot, (time_s, distance_m))
            if distance_m <= allowed_m:
                self._since.pop(robot, None)
                continue
            if distance_m < NEARER * was_m:
                since_s, was_m = time_s, distance_m
            self._since[robot] = since_s, was_m
            if time_s - since_s > PATIENCE_S:
                found.append((-round(distance_m, 2), robot))
        return [robot for _, robot in sorted(found)]
