"""What plants say of their bodies before a drive, gathered and judged (PURE).

A bridge to a vehicle says `agent.messages.types.Checks` again and again. A blocking line of which it found
"waiting..." may still become good by itself; any other that stays is a reason not to drive.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import LEVELS, Checks, Message
from handfast.deploy.console.wording import grouped, robots
from handfast.plant.backend import WAITING

SETTLE_NS: Final = 5 * NS_PER_S
"""A blocking line that stays for so long, while nothing of that vehicle waits any more, is meant: a vehicle's
own checks follow its estimate by some seconds."""
OK, WARNING, BLOCKING = LEVELS


class Line(NamedTuple):
    """One line: what was looked at, its level, what was found, what to do about it ("" for nothing)."""

    name: str
    level: str
    found: str
    advice: str

    @property
    def waits(self) -> bool:
        """Whether it is blocking for now, and may get better by itself."""
        return self.level == BLOCKING and self.found.startswith(WAITING)

    def __str__(self) -> str:
        advice = f" ({self.advice})" if self.advice else ""
        return f"{self.name}: {self.found}{advice}"


def sentences(said: Iterable[tuple[Line, int]]) -> list[str]:
    """Lines in words, with the robots of which they are said; what many have in common is said once.

    Args:
        said: pairs of a line and a robot.
    """
    return [f"{robots(ids)}: {text}" for text, ids in grouped((str(line), robot) for line, robot in said)]


class VehicleChecks:
    """The newest checks of those robots of `fleet` that are vehicles, `robots`.

    Times are those of reception (ns, wall clock).
    """

    def __init__(self, fleet: Fleet) -> None:
        self.robots: Final = tuple(robot.id for robot in fleet.robots if robot.kind.vehicle)
        self._name = fleet.fleet.name
        self._newest: dict[int, Checks] = {}
        self._since_ns: dict[tuple[int, str], int] = {}
        """Since when each line of a robot has been blocking, and nothing of that robot waited."""

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes a message that came on `key`; what is no vehicle's checks, or old, is ignored."""
        if type(message) is not Checks or message.robot not in self.robots:
            return
        robot = message.robot
        before = self._newest.get(robot)
        if key != key_expressions.checks(self._name, robot) or (before and message.time_ns < before.time_ns):
            return
        self._newest[robot] = message
        waits = any(line.waits for line in self.lines(robot))
        blocking = [(robot, line.name) for line in self.lines(robot) if line.level == BLOCKING and not waits]
        for place in [place for place in self._since_ns if place[0] == robot and place not in blocking]:
            del self._since_ns[place]
        for place in blocking:
            self._since_ns.setdefault(place, now_ns)

    def lines(self, robot: int) -> tuple[Line, ...]:
        """What a robot said last, () before it has said anything."""
        newest = self._newest.get(robot)
        return () if newest is None else tuple(Line._make(line) for line in newest.lines)

    def complete(self, now_ns: int, without: Container[int] = ()) -> bool:
        """Whether all but those of `without` have said what they have to say: nothing waits, and what blocks
        has stayed."""
        return all(
            robot in self._newest and not any(line.waits for line in self.lines(robot))
            for robot in self.robots
            if robot not in without
        ) and all(
            now_ns - since_ns >= SETTLE_NS
            for (robot, _), since_ns in self._since_ns.items()
            if robot not in without
        )

    def booting(self, without: Container[int] = ()) -> bool:
        """Whether a vehicle is there, but waits for something of its own."""
        return any(
            len(self.lines(robot)) > 1 and any(line.waits for line in self.lines(robot))
            for robot in self.robots
            if robot not in without
        )

    def refusals(self, now_ns: int) -> list[str]:
        """Sentences for the lines over which no drive begins."""
        return sentences(
            (line, robot)
            for robot in self.robots
            for line in self.lines(robot)
            if now_ns - self._since_ns.get((robot, line.name), now_ns) >= SETTLE_NS
        )

    def waits(self) -> dict[int, str]:
        """What is still to come, of each robot."""
        out = {}
        for robot in self.robots:
            found = [line.found for line in self.lines(robot) if line.level == BLOCKING]
            if robot not in self._newest:
                out[robot] = "its bridge has said nothing yet"
            elif found:
                out[robot] = ", ".join(found)
        return out

    def warnings(self) -> list[str]:
        """Sentences for what is worth knowing; one that several robots share is said once."""
        return sentences(
            (line, robot) for robot in self.robots for line in self.lines(robot) if line.level == WARNING
        )
