"""A fleet in virtual time: the same agents and plants, the same bytes, one process, no waiting.

What `agent.process.loop` does in real time happens here in the order of the ticks' deadlines. A
message is there `LATENCY_NS` after it was published, about what a loopback link takes; the same
fleet file and seed give the same bytes.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from typing import Final

from agent import keys
from agent.clock import NS_PER_S
from agent.core import Agent
from agent.fleet import Fleet, digest
from agent.messages import Mission, encode
from agent.node import INBOX_SIZE, Node, Outgoing, next_tick_ns
from agent.supervision import State
from plant.node import PlantNode
from plant.unicycle import from_fleet

LATENCY_NS: Final = 100_000
WARM_UP_PERIODS: Final = 10
"""Periods from the start to the epoch: every robot has heard its plant and its neighbours by then."""
STOP_TIMEOUT_NS: Final = 3 * NS_PER_S

Sink = Callable[[int, str, bytes], None]


class _Host:
    """One node and its inbox, as a process has them."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.inbox: deque[tuple[int, str, bytes]] = deque()
        self.capacity = INBOX_SIZE * max(1, len(node.subscriptions))

    def deliver(self, time_ns: int, key: str, payload: bytes) -> None:
        if len(self.inbox) == self.capacity:
            self.inbox.popleft()
        self.inbox.append((time_ns, key, payload))

    def tick(self, now_ns: int) -> list[Outgoing]:
        while self.inbox and self.inbox[0][0] <= now_ns:
            _, key, payload = self.inbox.popleft()
            self.node.receive(now_ns, key, payload)
        return self.node.tick(now_ns)


class Simulation:
    """Every agent and plant of `fleet` in virtual time.

    Args:
        fleet: resolved (`agent.formation.resolved`); every plant simulated.
        sink: told of every message, (time of arrival ns, key, payload).

    Raises:
        agent.fleet.FleetError: the formation cannot be resolved.
    """

    def __init__(self, fleet: Fleet, sink: Sink | None = None) -> None:
        self.fleet = fleet
        self.agents = [Agent(fleet, robot) for robot in fleet.ids]
        self.plants = [PlantNode(fleet, robot, from_fleet(fleet, robot)) for robot in fleet.ids]
        self._sink = sink
        nodes: list[Node] = [*self.plants, *self.agents]
        self._hosts = [_Host(node) for node in nodes]
        self._subscribers: dict[str, list[_Host]] = {}
        for host in self._hosts:
            for key in host.node.subscriptions:
                self._subscribers.setdefault(key, []).append(host)
        self.now_ns = 0
        self._due = [
            (next_tick_ns(-1, host.node.period_ns, host.node.phase_ns), order)
            for order, host in enumerate(self._hosts)
        ]
        heapq.heapify(self._due)
        self.epoch_ns = WARM_UP_PERIODS * fleet.period_ns

    def publish(self, key: str, payload: bytes) -> None:
        """Puts a message on the bus now, as an operator or a node does."""
        arrival_ns = self.now_ns + LATENCY_NS
        for host in self._subscribers.get(key, ()):
            host.deliver(arrival_ns, key, payload)
        if self._sink is not None:
            self._sink(arrival_ns, key, payload)

    def run_until(self, time_ns: int) -> None:
        """Does every tick that is due up to `time_ns`, in the order of their deadlines."""
        due, hosts = self._due, self._hosts
        while due[0][0] <= time_ns:
            self.now_ns, order = due[0]
            host = hosts[order]
            for key, payload in host.tick(self.now_ns):
                self.publish(key, payload)
            heapq.heapreplace(due, (self.now_ns + host.node.period_ns, order))
        self.now_ns = time_ns

    def start(self, duration_ns: int) -> None:
        """Sends the mission: the fleet drives from `epoch_ns` on, for `duration_ns`."""
        mission = Mission(1, self.now_ns, self.epoch_ns, duration_ns, digest(self.fleet))
        self.publish(keys.mission(self.fleet.fleet.name), encode(mission))

    def run(self, progress: Callable[[float], bool] | None = None) -> None:
        """The whole mission: warm-up, drive, stop.

        `progress` is told the fleet time (s) four times a second of it; when it returns False the
        run ends there.
        """
        duration_ns = round(self.fleet.fleet.duration_s * NS_PER_S)
        self.start(duration_ns)
        end_ns = self.epoch_ns + duration_ns
        while self.now_ns < end_ns:
            self.run_until(min(end_ns, self.now_ns + NS_PER_S // 4))
            if progress is not None and not progress((self.now_ns - self.epoch_ns) / NS_PER_S):
                return
        while self.now_ns < end_ns + STOP_TIMEOUT_NS and not self.stopped:
            self.run_until(self.now_ns + self.fleet.period_ns)

    @property
    def stopped(self) -> bool:
        """True when every robot stands, or can do no more."""
        return all(agent.state in (State.STOPPED, State.FAULT) for agent in self.agents)
