"""Whether a fleet can start or has come to rest, and what plants say of their bodies before (PURE)."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import LEVELS, Checks, Message, PlantState, Status
from handfast.agent.supervision.state_machine import State, at_rest
from handfast.deploy.console.wording import NAMES_SHOWN, grouped, robots
from handfast.plant.backend import WAITING


def is_ready(state: str) -> bool:
    """Whether a robot in this state keeps no fleet from starting: one in reserve just stays where it is."""
    return state in (State.READY.value, State.STANDBY.value)


def may_begin(status: Status | None, plant: PlantState | None, *, stands_by: bool = False) -> bool:
    """Whether a robot keeps no fleet from a new drive, where a resume goes with the mission: it is ready, or
    stands after a stop and could drive, or need not, as it `stands_by`."""
    if status is None:
        return False
    if status.state != State.STOPPED.value:
        return is_ready(status.state)
    return stands_by or (plant is not None and plant.healthy and plant.obeying)


def stands(status: Status | None, plant: PlantState | None) -> bool:
    """Whether a robot that was ordered to stop has come to rest, or its agent can do no more about it."""
    if status is None or status.state == State.STOPPED.value:
        return status is not None
    # These brake, whatever was said.
    brakes = status.state in (State.FAULT.value, State.STANDBY.value)
    return brakes and (plant is None or not plant.healthy or at_rest(plant.speed, plant.yaw_rate))


def waits(
    ids: Sequence[int],
    statuses: Mapping[int, Status],
    plants: Mapping[int, PlantState],
    begins: Callable[[Status | None, PlantState | None], bool],
) -> dict[int, str]:
    """What each robot waits for that does not begin, by `may_begin` or what else is asked of it.

    A robot whose own body keeps it from driving also keeps its neighbours from being ready: where there is
    one, those that only wait for others are left out.
    """
    own: dict[int, str] = {}
    others: dict[int, str] = {}
    for robot in ids:
        status, plant = statuses.get(robot), plants.get(robot)
        if begins(status, plant):
            continue
        if plant is None:
            own[robot] = "nothing heard from its plant"
        elif not plant.healthy or not plant.obeying:
            own[robot] = plant.note or "its body does not obey"
        else:
            others[robot] = "nothing heard" if status is None else status.reason or status.state
    return own or others


def in_words(waits: Mapping[int, str]) -> str:
    """On one line; robots that wait for the same are named together, and of many reasons the first few."""
    who = grouped((why, robot) for robot, why in waits.items())
    shown = [f"{robots(ids)}: {why}" for why, ids in who[:NAMES_SHOWN]]
    left = sum(len(ids) for _, ids in who[NAMES_SHOWN:])
    if left:
        shown.append(f"and {left} more robot{'s' * (left != 1)}")
    return "; ".join(shown)


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
