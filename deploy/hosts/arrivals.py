"""Who of a fleet is on the bus, since when, and in what state, as `handfast up` hears it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Message, Resume, Status, Stop
from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.drive.preconditions import CAME_UP, is_lifted
from handfast.deploy.drive.readiness import is_ready
from handfast.deploy.faults.live import Receiver
from handfast.deploy.session.operator_session import OperatorSession

_SETTLED: Final = DRIVING_NAMES | {State.STOPPED.value, State.RELEASED.value, State.HOLDING.value}


class Arrivals(OperatorSession):
    """A session that hears which agents and plants are there, since when, and their states.

    One thread collects; others may look.
    """

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._came: dict[Receiver, float] = {}
        self._said: dict[int, float] = {}
        self._meant: Stop | None = None
        self._given: Stop | None = None

    def feed(self, key: str, message: Message) -> None:
        super().feed(key, message)
        if type(message) is Status:
            self._said[message.robot] = time.monotonic()

    def said_since(self, robot: int, since: float) -> bool:
        """Whether a status of a robot came after `since`, monotonic time (s)."""
        return self._said.get(robot, since) > since

    def look(self) -> None:
        """Takes what came."""
        self.collect()
        now = time.monotonic()
        for receiver in self.alive:
            self._came.setdefault(receiver, now)

    def gone(self, receiver: Receiver) -> None:
        self._came.pop(receiver, None)
        self.statuses.pop(receiver[0], None)

    def is_here(self, robot: int, since: Mapping[str, float]) -> bool:
        """Whether a robot's agent and plant are there, and a status of the agent came.

        since: monotonic time (s) by role; such a process counts only if it came later.
        """
        came = {role: self._came.get((robot, role)) for role in ROLES}
        return robot in self.statuses and all(
            moment is not None and moment >= since.get(role, moment) for role, moment in came.items()
        )

    @property
    def complete(self) -> bool:
        """Whether a status of every robot was heard, and all orders that they have acknowledged."""
        return all(robot in self.statuses for robot in self.fleet.ids) and not self.operator.behind

    def drives(self, robot: int) -> bool:
        status = self.statuses.get(robot)
        return status is not None and status.state in DRIVING_NAMES

    @property
    def driving(self) -> bool:
        """Whether any robot drives."""
        return any(map(self.drives, self.fleet.ids))

    def learn(self, order: Stop | Resume) -> None:
        """Takes what robots have kept of somebody's order, though they are not heard."""
        self.feed(self.operator.keys[type(order)], order)
        newest = -1 if self._meant is None else self._meant.version
        if isinstance(order, Stop) and not is_lifted(order) and order.version > newest:
            self._meant = order

    def came_up(self) -> Stop:
        """The stop with which the fleet begins: it ends whatever was ordered before. One that somebody gave
        for a reason holds on, for that reason; given once more where a later one has become known."""
        self._meant = self.meant
        reason = CAME_UP if self._meant is None else self._meant.reason
        self._given = self.operator.order_stop(self.now_ns(), reason)
        return self._given

    @property
    def meant(self) -> Stop | None:
        """The last stop that somebody else gave for a reason and nobody has lifted, None without any."""
        found, resume = self.operator.stop_in_force, self.operator.resume
        standing = []
        if found is not None and found is not self._given and not is_lifted(found):
            standing.append(found)
        lifted = -1 if resume is None or resume.robots else resume.version
        if self._meant is not None and self._meant.version >= lifted:
            standing.append(self._meant)
        return max(standing, key=lambda stop: stop.version, default=None)

    def settled(self, robot: int) -> bool:
        """Whether a robot is ready to drive, drives, or has driven."""
        status = self.statuses.get(robot)
        return status is not None and (is_ready(status.state) or status.state in _SETTLED)

    @property
    def drives_by_another_file(self) -> bool:
        """Whether robots drive a mission for another fleet file than this one."""
        return self.driving and self.operator.mission is None and self.operator.foreign is not None

    def says(self, robot: int) -> str:
        """State of a robot's agent, and why."""
        status = self.statuses.get(robot)
        if status is None:
            return "silent"
        return f"{status.state}: {status.reason}" if status.reason else status.state
