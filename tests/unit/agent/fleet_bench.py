"""Several agents with simulated bodies on a bus in virtual time, on which messages may be cut off."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Message, Mission
from handfast.agent.node import Node
from handfast.agent.supervision.state_machine import State
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import Unicycle, from_fleet

THREE = """
robot = [
  { id = 1, x_m = 0, y_m = 0 },
  { id = 2, x_m = 1.0, y_m = 0.1 },
  { id = 3, x_m = 0.1, y_m = 1.1 },
  { id = 4, x_m = -1.0, y_m = -2.0, reserve = true },
]
fleet = { name = "few", rate_hz = 50 }
formation = { edges = [[1, 2], [2, 3], [1, 3]], offsets = [[0, 0], [1, 0], [0, 1]], safe_distance_m = 0.2 }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }
"""
PERIOD = 20_000_000
START = 1000 * NS_PER_S
STOP, RESUME, MISSION, HEARTBEAT, ASK = (
    f"few/{name}" for name in ("stop", "resume", "mission", "heartbeat", "ask")
)

Cut = Callable[[str, Node], bool]
"""(key, node) -> whether the message on its way to the node is lost."""


def three(*overrides: str) -> Fleet:
    return parse_fleet(THREE, source="here", overrides=overrides)


class FleetBench:
    """All agents and plants of a fleet: a step is a tick of every plant, then of every agent.

    A message is there at the next tick of whoever hears it. `cut` says which are lost, `said` what every
    agent and operator has published, with the time.
    """

    def __init__(self, made: Fleet) -> None:
        self.fleet = made
        self.now = START
        self.bodies = {robot: from_fleet(made, robot) for robot in made.ids}
        self.plants = {robot: PlantNode(made, robot, self.bodies[robot]) for robot in made.ids}
        self.agents = {robot: Agent(made, robot) for robot in made.ids}
        self.cut: Cut = lambda _key, _node: False
        self.said: list[tuple[int, str, Message]] = []
        self._waiting: dict[Node, list[tuple[str, bytes]]] = {}

    def state(self, robot: int) -> State:
        return self.agents[robot].state

    @property
    def nodes(self) -> list[Node]:
        return [*self.plants.values(), *self.agents.values()]

    def say(self, key: str, message: Message, to: Iterable[Node] | None = None) -> None:
        """Somebody publishes; `to`: who hears it, all by default."""
        self.said.append((self.now, key, message))
        self._put([(key, encode(message))], to)

    def mission(self, version: int = 1, **fields: object) -> Mission:
        """A mission for this fleet whose epoch is a few ticks ahead, with other fields as given."""
        made = Mission(version, self.now, self.now + 5 * PERIOD, 600 * NS_PER_S, digest(self.fleet))
        return made._replace(**fields)

    def _put(self, out: Iterable[tuple[str, bytes]], to: Iterable[Node] | None = None) -> None:
        for key, payload in out:
            for node in self.nodes if to is None else to:
                if _listens(node, key) and not self.cut(key, node):
                    self._waiting.setdefault(node, []).append((key, payload))

    def restart(self, robot: int) -> None:
        """The agent of a robot starts again and knows nothing."""
        self.agents[robot] = Agent(self.fleet, robot)

    def step(self) -> None:
        for nodes in (self.plants.values(), self.agents.values()):
            for node in nodes:
                for key, payload in self._waiting.pop(node, ()):
                    node.receive(self.now, key, payload)
            out = [(key, payload) for node in nodes for key, payload in node.tick(self.now)]
            self.said += [(self.now, key, decode(payload)) for key, payload in out]
            self._put(out)
            self.now += PERIOD // 2

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * NS_PER_S / PERIOD)):
            self.step()

    def drive(self) -> None:
        """Ready, then a mission, then so long that all trust each other."""
        self.run(0.5)
        self.say(MISSION, self.mission())
        self.run(2.0)

    def position(self, robot: int) -> tuple[float, float]:
        """Where its hand is, m, W."""
        body: Unicycle = self.bodies[robot]
        point = hand.hand(body.pose, self.fleet.robot(robot).hand_offset_m)
        return point.x, point.y

    def sayings(self, key: str) -> list[Message]:
        return [message for _, said_on, message in self.said if said_on == key]

    def told(self, kind: type[Message]) -> list[tuple[int, Message]]:
        """Operators' messages of one class that robots have said again, each with who did."""
        name, told = self.fleet.fleet.name, []
        for robot in self.fleet.ids:
            told += [
                (robot, each)
                for each in self.sayings(key_expressions.relayed(name, robot))
                if type(each) is kind
            ]
        return told

    def wrenches(self, robot: int) -> list[Message]:
        return self.sayings(key_expressions.wrench(self.fleet.fleet.name, robot))


def _listens(node: Node, key: str) -> bool:
    return any(
        key == each or ("*" in each and _matches(each.split("/"), key.split("/")))
        for each in node.subscriptions
    )


def _matches(wanted: list[str], parts: list[str]) -> bool:
    return len(wanted) == len(parts) and all(a in ("*", b) for a, b in zip(wanted, parts, strict=True))
