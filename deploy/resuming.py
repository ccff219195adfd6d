"""Leave to drive again, for robots whose operators took them away and gave them back: is it done (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from agent import keys
from agent.fleet import Fleet
from agent.leave import AWAITED
from agent.messages import Message, PlantState, Resume, Status
from agent.supervision import State


class Resuming:
    """What became of leave to drive again.

    Args:
        fleet: as it runs.
        robots: who gets it; none named: all.
        now_ns: when it is sent (wall clock).
    """

    def __init__(self, fleet: Fleet, robots: Sequence[int], now_ns: int) -> None:
        self._fleet = fleet
        self.robots: Final = tuple(robots or fleet.ids)
        # Plants obey only a greater number than before, whoever sent that.
        self.message: Final = Resume(now_ns // 1_000_000, now_ns, tuple(robots))
        self._statuses: dict[int, Status] = {}
        self._plants: dict[int, PlantState] = {}

    def feed(self, key: str, message: Message) -> None:
        """Takes a message that came on `key` after the leave was sent."""
        name = self._fleet.fleet.name
        if type(message) is Status and key == keys.status(name, message.robot):
            self._statuses[message.robot] = message
        elif type(message) is PlantState and key == keys.plant_state(name, message.robot):
            self._plants[message.robot] = message

    def runs(self, robot: int) -> bool:
        """Whether the robot drives by the law, and its body does as it is told."""
        status, plant = self._statuses.get(robot), self._plants.get(robot)
        return (
            status is not None
            and status.state == State.RUNNING.value
            and plant is not None
            and plant.healthy
            and plant.obeying
        )

    @property
    def done(self) -> bool:
        """Whether all of `robots` run."""
        return all(map(self.runs, self.robots))

    def outcome(self, robot: int) -> str:
        """What became of it for one robot, in words."""
        status, plant = self._statuses.get(robot), self._plants.get(robot)
        if self.runs(robot):
            return f"robot {robot}: running"
        if status is None or plant is None:
            silent = "its agent" if status is None else "its plant"
            return f"robot {robot}: nothing heard from {silent}"
        if plant.healthy and not plant.obeying:
            note = plant.note or "its body does not obey"
            if note.endswith(AWAITED):
                why = "it has had a later leave: is this machine's clock behind that of another operator?"
            else:
                why = "its operator must give it back first"
            return f"robot {robot}: still released: {note}: {why}"
        why = status.reason if plant.healthy else plant.note or status.reason
        return f"robot {robot}: {status.state}" + (f": {why}" if why else "")
