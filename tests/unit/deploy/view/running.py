"""A running fleet that a test makes: a bus that holds what is put on it, and a clock that is set by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, cast

from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import HandState, Message, Mission, NeighbourStatus, PlantState, Status
from handfast.agent.transport.bus import Bus
from handfast.deploy.view.live_fleet import LiveFleet
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square

FLEET = resolved(square("fleet.duration_s=60"))
"""Robots 1 to 4 have a place, 7 and 8 do not."""
NAME = FLEET.fleet.name
START = EPOCH + 100 * S
"""What the clock shows at first, ns."""
FRAME = S // 20


class HeldBus:
    """A bus that gives what a test puts on it, and keeps what is said, an `Bus`."""

    def __init__(self) -> None:
        self.said: list[tuple[str, Message]] = []
        self.declared: set[str] = set()
        self.subscribed: list[str] = []
        self._inbox: list[tuple[str, bytes]] = []
        self._changes: list[tuple[str, bool]] = []
        self.alive: set[str] = set()

    def __enter__(self) -> HeldBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None: ...

    def subscribe(self, key: str, size: int | None = None) -> None:
        self.subscribed.append(key)

    def declare(self, key: str) -> None:
        self.declared.add(key)

    def watch(self, key: str) -> HeldBus:
        return self

    def update(self) -> list[tuple[str, bool]]:
        changes, self._changes = self._changes, []
        return changes

    def publish(self, key: str, payload: bytes) -> None:
        assert key in self.declared
        self.said.append((key, decode(payload)))

    def drain(self) -> Sequence[tuple[str, bytes]]:
        inbox, self._inbox = self._inbox, []
        return inbox

    def put(self, key: str, message: Message | bytes) -> None:
        self._inbox.append((key, message if isinstance(message, bytes) else encode(message)))

    def connect(self, robot: int, role: str, *, here: bool = True) -> None:
        """A process comes, or goes."""
        key = key_expressions.alive(NAME, robot, role)
        (self.alive.add if here else self.alive.discard)(key)
        self._changes.append((key, here))


class Clock:
    """What time it is, as the test says."""

    ns = START

    def now_ns(self) -> int:
        return self.ns


class Running:
    """`FLEET` as it runs, and a `LiveFleet` that sees it, made by `make`. A context manager."""

    def __init__(self, fleet: Fleet = FLEET, make: Callable[[Fleet, Bus], LiveFleet] = LiveFleet) -> None:
        self.fleet, self.bus, self.clock = fleet, HeldBus(), Clock()
        self.live = make(fleet, self.bus)
        cast(Any, self.live.fleet_state).clock = self.clock
        self.state = self.live.fleet_state
        self._sequence = 0

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        """It holds nothing."""

    def step(self, after_ns: int = FRAME) -> None:
        """The next frame."""
        self.clock.ns += after_ns
        self.live.step()

    def of(self, kind: type[Any]) -> list[Any]:
        """What was said of that kind."""
        return [message for _, message in self.bus.said if type(message) is kind]

    def come(self, *robots: int) -> None:
        """Agents and plants of these robots, all unless named, come up."""
        for robot in robots or self.fleet.ids:
            for role in key_expressions.ROLES:
                self.bus.connect(robot, role)

    def number(self) -> int:
        self._sequence += 1
        return self._sequence

    def begin(self, version: int = 1, since_s: float = 10.0) -> Mission:
        """A mission comes that began `since_s` ago."""
        epoch_ns = self.clock.ns - round(since_s * S)
        mission = Mission(version, epoch_ns - S, epoch_ns, 60 * S, digest(self.fleet))
        self.bus.put(key_expressions.mission(NAME), mission)
        return mission

    def status(self, robot: int, state: str = "running", reason: str = "", **fields: Any) -> None:
        """An agent says its status; `fields` of `Status`."""
        made = Status(
            *(robot, self.number(), self.clock.ns, state, "", reason),
            *(fields.pop("mission_version", 1), fields.pop("order_version", 0)),
            *(fields.pop("neighbours", ()), (), (), ()),
        )
        self.bus.put(key_expressions.status(NAME, robot), made._replace(**fields))

    def body(
        self, robot: int, x: float = 0.0, y: float = 0.0, heading: float = 0.0, **fields: Any
    ) -> PlantState:
        """A plant says where its body is; `fields` of `PlantState`."""
        made = PlantState(
            *(robot, FIRST_ROUND + self.number(), self.clock.ns, x, y, heading, 0.25, 0.0, 0.0, 0.0),
            *(True, True, True, ""),
        )._replace(**fields)
        self.bus.put(key_expressions.plant_state(NAME, robot), made)
        return made

    def hand(self, robot: int, forces: tuple[float, float, float, float]) -> None:
        """An agent says its forces: navigation and constraint, x and y of each."""
        made = HandState.placed(robot, FIRST_ROUND + self.number(), self.clock.ns, True, 0, (0.0,) * 4)
        navigation_x, navigation_y, constraint_x, constraint_y = forces
        self.bus.put(
            key_expressions.hand(NAME, robot),
            made._replace(
                navigation_x=navigation_x,
                navigation_y=navigation_y,
                constraint_x=constraint_x,
                constraint_y=constraint_y,
            ),
        )


def heard_of(robot: int, age_us: int = 20_000, received: int = 9, lost: int = 1) -> NeighbourStatus:
    """What an agent says of a neighbour."""
    return NeighbourStatus(robot, age_us, received, lost, 3_000, 100)
