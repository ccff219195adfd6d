"""The agent, driven by hand: one robot, one neighbour, every message made by the test."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import (
    Beacon,
    HandState,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.supervision.state_machine import State

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0.2 }]
fleet = { name = "two", rate_hz = 50 }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
control = { plant_timeout_s = 0.1, prediction_horizon_s = 0.5 }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }
"""
PERIOD = 20_000_000
START = 1000 * NS_PER_S
HAND, WRENCH, STATUS, BEACON, TOLD = (
    f"two/robot/1/{name}" for name in ("hand", "plant/wrench", "status", "beacon", "told")
)
PLANT, OTHER, MISSION, STOP = "two/robot/1/plant/state", "two/robot/2/hand", "two/mission", "two/stop"
RESUME, HEARTBEAT, ASK = "two/resume", "two/heartbeat", "two/ask"
OTHERS_BEACON, OTHERS_TOLD = "two/robot/2/beacon", "two/robot/2/told"
ALIVE = "two/alive/robot/2/agent"
TIMEOUT_TICKS = 5  # control.plant_timeout_s
LISTEN_TICKS = 2 * 10 + 1  # two beacons of everybody
BRAKE = (0.0, 0.0, True)


def fleet(*overrides: str) -> Fleet:
    return parse_fleet(FLEET, source="here", overrides=overrides)


class Out(NamedTuple):
    """What one tick put on the bus."""

    wrench: Wrench
    hand: HandState | None
    status: Status | None
    beacon: Beacon | None
    raw: list[tuple[str, bytes]]

    @property
    def told(self) -> list[Message]:
        """What it passes on of operators' orders."""
        return [decode(payload) for key, payload in self.raw if key == TOLD]


def check_finite(message: Message) -> None:
    def numbers(value: Any) -> Iterable[float]:
        if isinstance(value, tuple):
            for part in value:
                yield from numbers(part)
        elif isinstance(value, float):
            yield value

    assert all(map(isfinite, numbers(message))), message


class Bench:
    """An agent with its plant and its neighbour, as they appear on the bus.

    A tick of the bench is a tick of the agent, half a period after the plant's. `pose` and `other`
    are what plant and neighbour say of themselves, None for silence.
    """

    def __init__(self, *overrides: str, robot: int = 1, made: Fleet | None = None) -> None:
        self.fleet = made or fleet(*overrides)
        self.agent = Agent(self.fleet, robot)
        self.now = START + PERIOD // 2
        self.pose: Pose | None = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
        self.plant: Mapping[str, Any] = {}  # fields of the plant's state that are not the usual
        self.other: tuple[float, float, float, float] | None = (1.5, 0.2, 0.0, 0.0)
        self.other_follows = True
        self.ticks = 0
        self.last: Status | None = None
        self._numbers = SequenceNumbers(PERIOD)

    @property
    def state(self) -> State:
        return self.agent.state

    def give(self, key: str, payload: bytes | Message) -> None:
        self.agent.receive(self.now, key, payload if isinstance(payload, bytes) else encode(payload))

    def mission(self, version: int = 1, epoch_ns: int | None = None, duration_s: float = 60.0) -> None:
        epoch_ns = self.now + 2 * PERIOD if epoch_ns is None else epoch_ns
        duration_ns = round(duration_s * NS_PER_S)
        self._numbers.begin(epoch_ns)  # as of a plant that hears it too
        self.give(MISSION, Mission(version, self.now, epoch_ns, duration_ns, digest(self.fleet)))

    def stop(self, version: int, reason: str = "") -> None:
        self.give(STOP, Stop(version, self.now, reason))

    def resume(self, version: int, *robots: int) -> None:
        self.give(RESUME, Resume(version, self.now, robots))

    def tick(self, *extra: tuple[str, bytes]) -> Out:
        """Plant and neighbour speak, then `extra` comes, then the agent ticks."""
        if self.pose is not None:
            state = PlantState(
                *(1, self._numbers.next(self.now - PERIOD // 2), self.now - PERIOD // 2),
                *(*self.pose, 0.0, 0.0, True, True, True, ""),
            )._replace(**self.plant)
            self.give(PLANT, state)
        if self.other is not None:
            stamp = self.now - PERIOD
            copies = ((1, 0.0),)
            self.give(
                OTHER,
                HandState(2, self.ticks, stamp, self.other_follows, 1, *self.other, *[0.0] * 7, copies, ()),
            )
        for key, payload in extra:
            self.give(key, payload)
        raw = self.agent.tick(self.now)
        self.now += PERIOD
        self.ticks += 1
        found: dict[str, Message] = {}
        for key, payload in raw:
            assert key not in found or key == TOLD
            found[key] = decode(payload)  # nothing that a receiver would refuse
            check_finite(found[key])
        self.last = found.get(STATUS, self.last)
        return Out(found[WRENCH], found.get(HAND), found.get(STATUS), found.get(BEACON), raw)

    def run(self, ticks: int) -> list[Out]:
        return [self.tick() for _ in range(ticks)]

    def listen(self) -> list[Out]:
        """So long that the robot knows who is near: who comes into a drive waits for that."""
        return self.run(LISTEN_TICKS)

    def drive(self) -> Out:
        """To the state RUNNING."""
        self.listen()
        self.mission()
        for _ in range(5):
            out = self.tick()
            if self.state is State.RUNNING:
                return out
        raise AssertionError(f"{self.agent.condition}")

    def counters(self) -> dict[str, int]:
        """Of a status that is sent now."""
        for _ in range(12):
            self.tick()
        assert self.last is not None
        return dict(self.last.counters)


def brakes(out: Out) -> bool:
    return out.wrench[3:6] == BRAKE
