"""A plant on the bus, without clock, socket or thread of its own: the watchdog between agent and body.

Pure. The plant obeys a fresh wrench and brakes in any other case.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

from agent import keys
from agent.clock import NS_PER_S
from agent.fleet import Fleet
from agent.hand import Pose
from agent.messages import Malformed, PlantState, Wrench, decode, encode
from agent.neighbours import FUTURE_NS_MAX
from agent.node import Outgoing
from plant.backend import Command, PlantBackend, Reading

REST_SPEED: Final = 0.02
REST_YAW_RATE: Final = 0.05


class PlantNode:
    """Hosts `backend` as the plant of robot `robot`; a `agent.node.Node`."""

    def __init__(self, fleet: Fleet, robot: int, backend: PlantBackend) -> None:
        name = fleet.fleet.name
        self.robot: Final = robot
        self.period_ns: Final = fleet.period_ns
        self.phase_ns: Final = 0
        self._backend = backend
        self._timeout_ns = round(fleet.control.wrench_timeout_s * NS_PER_S)
        self._key_state = keys.plant_state(name, robot)
        self._key_truth = keys.plant_truth(name, robot)
        self._key_wrench = keys.wrench(name, robot)
        self.alive_key: Final = keys.alive(name, robot, "plant")
        self.subscriptions: Final = (self._key_wrench,)
        self.publications: Final = (self._key_state, self._key_truth)
        self.rejected: Counter[str] = Counter()
        self.overruns = 0
        self._wrench: Wrench | None = None
        self._leaving = False
        self._at_rest = True
        self._sequence = 0
        self._condition = ("braking", "no wrench yet")

    @property
    def condition(self) -> tuple[str, str]:
        return self._condition

    @property
    def done(self) -> bool:
        return self._leaving and self._at_rest

    def leave(self) -> None:
        """The process is about to end: brakes, whatever the agent says."""
        self._leaving = True

    def timed(self, duration_ns: int, missed: int) -> None:
        self.overruns += missed

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes a wrench; anything else, and one that is older than the last, is counted and ignored."""
        try:
            message = decode(payload)
        except Malformed as error:
            self.rejected[error.reason] += 1
            return
        if type(message) is not Wrench or key != self._key_wrench or message.robot != self.robot:
            self.rejected["wrong_key"] += 1
        elif message.time_ns > now_ns + FUTURE_NS_MAX:
            self.rejected["future"] += 1
        elif self._wrench is not None and message.time_ns <= self._wrench.time_ns:
            self.rejected["out_of_order"] += 1
        else:
            self._wrench = message

    def _command(self, now_ns: int) -> Command | None:
        wrench = self._wrench
        if self._leaving:
            self._condition = "braking", "the plant was told to end"
        elif wrench is None:
            self._condition = "braking", "no wrench yet"
        elif now_ns - wrench.time_ns > self._timeout_ns:
            self._condition = "braking", f"no fresh wrench for {(now_ns - wrench.time_ns) / NS_PER_S:.2f} s"
        elif wrench.brake:
            self._condition = "braking", "its agent brakes"
        else:
            self._condition = "driving", ""
            return Command(wrench.force, wrench.torque)
        return None

    def tick(self, now_ns: int) -> list[Outgoing]:
        command = self._command(now_ns)
        reading = self._backend.step(now_ns, command)
        pose = reading.truth or reading.pose
        self._at_rest = abs(pose.speed) < REST_SPEED and abs(pose.yaw_rate) < REST_YAW_RATE
        out = [(self._key_state, encode(self._state(reading, reading.pose, command)))]
        if reading.truth is not None:
            out.append((self._key_truth, encode(self._state(reading, reading.truth, command))))
        self._sequence += 1
        return out

    def _state(self, reading: Reading, pose: Pose, command: Command | None) -> PlantState:
        return PlantState(
            self.robot,
            self._sequence,
            reading.time_ns,
            *pose,
            reading.force,
            reading.torque,
            command is not None,
            reading.healthy,
            reading.note,
        )
