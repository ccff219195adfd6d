"""What became of a new mission or of a resume, robot by robot (PURE)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import Message, Mission, PlantState, Resume, Status
from handfast.agent.supervision.orders import AWAITED
from handfast.agent.supervision.situation import NOT_SAID
from handfast.agent.supervision.state_machine import DRIVING_NAMES, MISSION_OVER, State
from handfast.deploy.console.wording import grouped, robots


def words(mission: Mission) -> str:
    """What a mission changes, and when, in fleet time."""
    at_s = ((mission.from_ns or mission.epoch_ns) - mission.epoch_ns) / NS_PER_S
    over = f", over {mission.blend_ns / NS_PER_S:.1f} s" if mission.blend_ns else ""
    return f"{mission.note}: at {at_s:.1f} s{over}"


class Ordering:
    """What becomes of a new mission, from the statuses that come after it.

    Args:
        mission: as it is sent.
        ids: all robots of the fleet.
    """

    def __init__(self, mission: Mission, ids: Sequence[int]) -> None:
        self._mission, self._ids = mission, ids
        self._removed = {robot for robot, _ in mission.removed}
        self._agents: Sequence[int] = ()
        self._statuses: Mapping[int, Status] = {}
        self._newest: Mission | None = None

    def look(self, agents: Sequence[int], statuses: Mapping[int, Status], newest: Mission | None) -> bool:
        """Takes what was heard until now: the robots whose agents are there, their last statuses, and the
        newest mission. True when nothing is left to wait for."""
        self._agents, self._statuses, self._newest = agents, statuses, newest
        return self.overruled or (bool(agents) and all(map(self.has_acknowledged, agents)))

    def has_acknowledged(self, robot: int) -> bool:
        """Whether a robot's agent has acknowledged the mission."""
        status = self._statuses.get(robot)
        return status is not None and status.mission_version == self._mission.version

    @property
    def overruled(self) -> bool:
        """Whether a newer mission of another operator holds instead."""
        later = any(status.mission_version > self._mission.version for status in self._statuses.values())
        return later or (self._newest is not None and newer(self._newest, self._mission))

    @property
    def done(self) -> bool:
        """Whether every robot of the fleet has acknowledged it, but for those that have been removed."""
        return not self.overruled and all(
            self.has_acknowledged(robot) if robot in self._agents else robot in self._removed
            for robot in self._ids
        )

    def outcomes(self) -> list[str]:
        """What became of it, in words: how many have acknowledged it, and what is with the others."""
        if self.overruled:
            other = self._newest
            known = other is not None and newer(other, self._mission)
            what = f" ({other.note})" if other is not None and known and other.note else ""
            if known and other is not None and other.version == self._mission.version:
                return [f"not done: another operator's order was quicker{what}; look, and order again"]
            # That may have been made of this one: who orders again would have it twice.
            text = f"overtaken by another operator's order{what}, maybe on top of it"
            return [f"{text}; look before ordering again"]
        have = sum(map(self.has_acknowledged, self._ids))
        due = sum(robot in self._agents or robot not in self._removed for robot in self._ids)
        lacking = [(self._outcome(robot), robot) for robot in self._ids if not self.has_acknowledged(robot)]
        return [
            f"{have} of {due} acknowledged",
            *(f"{robots(ids)}: {text}" for text, ids in grouped(lacking)),
        ]

    def _outcome(self, robot: int) -> str:
        if robot not in self._agents and robot in self._removed:
            return "has been removed"
        if robot not in self._agents:
            return "its agent is not there; the others will relay it"
        status = self._statuses.get(robot)
        if status is None:
            return "nothing heard from its agent"
        return f"has not taken it: {status.reason or status.state}"


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
