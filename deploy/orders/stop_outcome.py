"""What became of a stop of a whole fleet: which robots have acknowledged it and brake (PURE)."""

from __future__ import annotations

from typing import Final

from agent.fleet.model import Fleet
from agent.messages import key_expressions
from agent.messages.types import Message, PlantState, Status, Stop, clipped
from agent.supervision.state_machine import State
from deploy.orders.versions import AHEAD_US_MAX

BRAKING: Final = frozenset(
    state.value for state in (State.STOPPING, State.STOPPED, State.STANDBY, State.FAULT)
)
"""States of an agent that has acknowledged a stop."""


def has_acknowledged(status: Status | None, stop: Stop) -> bool:
    """Whether an agent that says this, or nothing, has acknowledged a stop and brakes."""
    return status is not None and status.order_version >= stop.version and status.state in BRAKING


class Stopping:
    """What becomes of a stop, from the messages that come after it.

    Args:
        fleet: as it runs.
        now_ns: when it is sent (wall clock).
        reason: why, for people.

    Attributes:
        message: what to send, and to send again until `done`; it may change.
    """

    def __init__(self, fleet: Fleet, now_ns: int, reason: str) -> None:
        self._ids, self._name, self._begun_ns = fleet.ids, fleet.fleet.name, now_ns
        self.message = Stop(now_ns // 1_000, now_ns, clipped(reason))
        self._statuses: dict[int, Status] = {}
        self._agents_ns: dict[int, int] = {}
        """When each agent was heard to have stopped (wall clock, ns)."""
        self._plants_ns: dict[int, int] = {}
        """Since when each plant has been heard to brake (wall clock, ns)."""
        self._plants: set[int] = set()

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes a message that came on `key` after the stop was sent first."""
        if type(message) is Status and key == key_expressions.status(self._name, message.robot):
            self._hear_agent(now_ns, message)
        elif type(message) is PlantState and key == key_expressions.plant_state(self._name, message.robot):
            self._plants.add(message.robot)
            if message.driving:
                self._plants_ns.pop(message.robot, None)
            else:
                self._plants_ns.setdefault(message.robot, now_ns)

    def _hear_agent(self, now_ns: int, status: Status) -> None:
        robot = status.robot
        self._statuses[robot] = status
        acknowledged, most = status.order_version, self._begun_ns // 1_000 + AHEAD_US_MAX
        if self.message.version < acknowledged <= most and robot not in self._agents_ns:
            # It has had a later resume than this stop, as when this machine's clock is behind: outdo that.
            self.message = self.message._replace(version=acknowledged + 1)
        elif self._obeys(robot):
            self._agents_ns.setdefault(robot, now_ns)

    def _obeys(self, robot: int) -> bool:
        """Whether the robot's agent has acknowledged the stop and brakes."""
        return has_acknowledged(self._statuses.get(robot), self.message)

    def stands_by(self, robot: int) -> bool:
        """Whether agent and plant of a robot both brake."""
        return self._obeys(robot) and robot in self._plants_ns

    @property
    def done(self) -> bool:
        """Whether all robots brake."""
        return all(map(self.stands_by, self._ids))

    def outcome(self, robot: int) -> str:
        """What became of it for one robot, in words."""
        return f"robot {robot}: {self._agent_words(robot)}, {self._plant_words(robot)}"

    def _agent_words(self, robot: int) -> str:
        status = self._statuses.get(robot)
        if status is None:
            return "nothing heard from its agent"
        if self._obeys(robot):
            return f"{status.state} after {self._ms(self._agents_ns[robot])}"
        if robot in self._agents_ns:
            return f"{status.state}: another operator has let it drive again"
        return f"{status.state}: its agent has not taken the stop"

    def _plant_words(self, robot: int) -> str:
        if robot in self._plants_ns:
            return f"its plant brakes after {self._ms(self._plants_ns[robot])}"
        return "its plant does not brake" if robot in self._plants else "nothing heard from its plant"

    def _ms(self, time_ns: int) -> str:
        return f"{(time_ns - self._begun_ns) / 1e6:.0f} ms"
