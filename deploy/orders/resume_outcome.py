"""What became of a resume, for robots that were stopped or whose operators took them over (PURE)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message, PlantState, Resume, Status
from handfast.agent.supervision.orders import AWAITED
from handfast.agent.supervision.situation import NOT_SAID
from handfast.agent.supervision.state_machine import DRIVING_NAMES, MISSION_OVER, State
from handfast.deploy.console.wording import grouped, robots

_OVER: Final = (State.STOPPED.value, MISSION_OVER)


class Resuming:
    """What becomes of a resume, from the messages that come after it.

    Args:
        fleet: as it runs.
        message: the resume.
        before: what each agent said last before it.

    Attributes:
        robots: those that it is for.
        others: robots that it is not for, and that will go on all the same: they have waited for a word since
            they started, and that others drive is one.
    """

    def __init__(self, fleet: Fleet, message: Resume, before: Mapping[int, Status] | None = None) -> None:
        self._fleet = fleet
        self.message: Final = message
        self.robots: Final[Sequence[int]] = message.robots or fleet.ids
        waited = [robot for robot, status in sorted((before or {}).items()) if status.reason == NOT_SAID]
        self.others: Final[Sequence[int]] = [robot for robot in waited if robot not in self.robots]
        self._statuses: dict[int, Status] = {}
        self._plants: dict[int, PlantState] = {}

    def feed(self, key: str, message: Message) -> None:
        """Takes a message that came on `key` after the resume was sent."""
        name = self._fleet.fleet.name
        if type(message) is Status and key == key_expressions.status(name, message.robot):
            self._statuses[message.robot] = message
        elif type(message) is PlantState and key == key_expressions.plant_state(name, message.robot):
            self._plants[message.robot] = message

    def runs(self, robot: int) -> bool:
        """Whether the robot has acknowledged the resume and drives by the law, and its body obeys.

        One without a place in the formation stays where it is, so does one whose mission is over, and one
        that has nothing to drive is ready.
        """
        status, plant = self._statuses.get(robot), self._plants.get(robot)
        if status is None or plant is None or status.order_version < self.message.version:
            return False
        if status.state == State.STANDBY.value or (status.state, status.reason) == _OVER:
            return True
        if not plant.healthy or not plant.obeying:
            return False
        return status.state == State.READY.value or (status.state in DRIVING_NAMES and plant.driving)

    @property
    def done(self) -> bool:
        """Whether all of `robots` run."""
        return all(map(self.runs, self.robots))

    @property
    def outcomes(self) -> list[str]:
        """What became of it, in words: of how many it did what was meant, and what is with the others."""
        well = Counter(self._outcome(robot) for robot in self.robots if self.runs(robot))
        lacking = [(self._outcome(robot), robot) for robot in self.robots if not self.runs(robot)]
        states = ", ".join(f"{count} {state}" for state, count in well.most_common())
        return [
            f"{well.total()} of {len(self.robots)} resumed" + (f" ({states})" if states else ""),
            *(f"{robots(ids)}: {text}" for text, ids in grouped(lacking)),
        ]

    def outcome(self, robot: int) -> str:
        """What became of it for one robot, in words."""
        return f"robot {robot}: {self._outcome(robot)}"

    def _outcome(self, robot: int) -> str:
        status, plant = self._statuses.get(robot), self._plants.get(robot)
        if status is None or plant is None:
            silent = "its agent" if status is None else "its plant"
            return f"nothing heard from {silent}"
        if self.runs(robot):
            over = f": {MISSION_OVER}" if status.state == State.STOPPED.value else ""
            return f"{status.state}{over}"
        if plant.healthy and not plant.obeying:
            note = plant.note or "its body does not obey"
            if note.endswith(AWAITED):
                why = "it has had a later resume: is this machine's clock behind that of another operator?"
            else:
                why = "its operator must give it back first"
            return f"still released: {note}: {why}"
        why = status.reason if plant.healthy else plant.note or status.reason
        if status.state in DRIVING_NAMES and not plant.driving:
            why = "its plant brakes"
        text = status.state + (f": {why}" if why else "")
        if status.order_version < self.message.version:
            return f"{text}; it has not acknowledged the resume"
        return f"{text}; ordered after this resume" if self._stopped_later(status) else text

    def _stopped_later(self, status: Status) -> bool:
        at_end = status.state in (State.STOPPING.value, State.STOPPED.value)
        return at_end and status.order_version > self.message.version
