"""A fleet in virtual time: the same agents, plants and bytes as in a run, in one process, without waiting.

Nodes tick in the order of their times, as `agent.runtime.loop.loop` has them tick in real time; rules act on
processes, clocks and ticks as there. A message arrives `LATENCY_NS` after it was published, about what a
loopback link takes. The same fleet file and seed give the same bytes.

Times are true time, the operator's. A robot's clock may be wrong on purpose
(`agent.common.time.LocalTime`): its nodes get the time that it shows. Simulated rovers stand for vehicles.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from math import ceil
from typing import Final

from handfast.agent.common.time import NS_PER_MS, NS_PER_S, LocalTime
from handfast.agent.core import Agent
from handfast.agent.fleet import plants
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.geometry import resolve
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.ingress import Decode
from handfast.agent.links.ticks import Ticks, next_tick_ns
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Event, Heartbeat, Mission, Outgoing, PlantState, Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.node import TOLD_SHARE, Node, inbox_size
from handfast.agent.supervision.state_machine import State
from handfast.deploy.drive.readiness import is_ready
from handfast.deploy.faults.process_actions import Action, Process, actions
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import HEARD_NS, HEARTBEAT_PERIOD_NS, Operator, Order, refused
from handfast.deploy.simulate import guards
from handfast.plant.backend import Begin, VirtualBody
from handfast.plant.node import PlantNode


class Bodies:
    """Makes the bodies of `fleet`, and makes them again for plants that start again."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._bodies: dict[int, VirtualBody] = {}

    def make(self, robot: int, now_ns: int) -> VirtualBody:
        """The body for a new plant of a robot, at `now_ns` by the robot's clock.

        The first is where the fleet file has it. After that a simulated body stands where it was, at rest; a
        simulated vehicle is the same one, which went on by itself, with a new bridge.
        """
        before = self._bodies.get(robot)
        at = None if before is None else (before.pose.x, before.pose.y, before.pose.heading)
        make = plants.attribute(self._fleet.robot(robot).kind.virtual)
        body: VirtualBody = make(self._fleet, robot, Begin(now_ns, at, before))
        self._bodies[robot] = body
        return body

    def there(self, robot: int) -> VirtualBody:
        """The body that a robot has."""
        return self._bodies[robot]


LATENCY_NS: Final = 100_000
LEASE_SHARE: Final = 0.9
"""A process that is paused is seen to go after so much of `Fleet.lease_ms`, as measured."""
WARM_UP_PERIODS: Final = 10
"""Periods from the start to the epoch, for a fleet that is ready after half of them; more where agents first
listen for who is near."""
EPOCH_AHEAD_NS: Final = NS_PER_S // 2
"""A fleet that needs longer to be ready drives so long after that, as in a run."""
READY_TIMEOUT_NS: Final = 60 * NS_PER_S
AGAIN_NS: Final = NS_PER_S // 2
"""A node that starts again gets the orders so long after, as in a run."""
STOP_TIMEOUT_NS: Final = 3 * NS_PER_S
PROGRESS_PERIOD_NS: Final = NS_PER_S // 4
READ_ROUNDS: Final = 8
READ_MIN: Final = 3000
"""So many messages of each robot are known that have been read: those on their way, and that of the plant.
And so many at least, for whoever takes them from the `sink` a while later (`Simulation.decode`)."""

Sink = Callable[[int, str, bytes], None]
Progress = Callable[[float], bool]


Ring = deque[tuple[int, str, bytes]]
"""Messages that wait for a node: time of arrival (ns), key, payload."""


@lru_cache(maxsize=4096)  # all agents watch the same
def _matches(watched: str, token: str) -> bool:
    """Whether a token is among those that are watched."""
    wanted, parts = watched.split("/"), token.split("/")
    return len(wanted) == len(parts) and all(a in ("*", b) for a, b in zip(wanted, parts, strict=True))


class _Bus:
    """Who listens to which keys, and which liveliness tokens there are.

    Args:
        robots: how many there are.

    Attributes:
        robots, tokens: how many there are; the liveliness tokens that there are now.
    """

    def __init__(self, robots: int) -> None:
        self.robots: Final = robots
        self._rings: dict[str, dict[_Host, Ring]] = {}
        self._keys: dict[_Host, dict[str, Ring]] = {}
        self._heard: dict[str, tuple[Ring, ...]] = {}
        """The rings in which the messages of a key wait, as far as that has been looked up."""
        self.tokens: set[str] = set()

    def listen(self, host: _Host) -> None:
        """`host` hears from now on what its rings are for, and nothing else."""
        before = self._keys.get(host, {})
        self._keys[host] = host.rings
        for subscription in before.keys() - host.rings.keys():
            del self._rings[subscription][host]
            self._look_again(subscription)
        for subscription in host.rings.keys() - before.keys():
            self._rings.setdefault(subscription, {})[host] = host.rings[subscription]
            self._look_again(subscription)

    def forget(self, host: _Host) -> None:
        for subscription in self._keys.pop(host, {}):
            del self._rings[subscription][host]
            self._look_again(subscription)

    def _look_again(self, subscription: str) -> None:
        """Others listen to it now: whose rings its messages wait in is looked up with the next one."""
        if "*" in subscription:
            self._heard.clear()
        else:
            self._heard.pop(subscription, None)

    def put(self, arrival_ns: int, key: str, payload: bytes) -> None:
        rings = self._heard.get(key)
        if rings is None:
            rings = self._heard[key] = self._heard_by(key)
        message = (arrival_ns, key, payload)
        for ring in rings:
            ring.append(message)

    def _heard_by(self, key: str) -> tuple[Ring, ...]:
        """The rings of who listens to this key: by its name, and by that of any robot's."""
        subscriptions = dict.fromkeys((key, key_expressions.of_any_robot(key)))
        return tuple(ring for name in subscriptions for ring in self._rings.get(name, {}).values())

    def announce(self, token: str, time_ns: int, *, here: bool) -> None:
        """Shows others, at `time_ns`, that a process comes or goes."""
        if here != (token in self.tokens):
            (self.tokens.add if here else self.tokens.discard)(token)
            for host in self._keys:
                host.see(time_ns, token, here)


class _Host:
    """One node with what a process gives it: an inbox, a clock, and the times of its ticks.

    Attributes:
        due_ns: true time of its next tick.
        ticked_ns: true time of its last one, below 0 before the first.
        kept: what its disk has of operators' orders.
        life: counts up when ticks that were planned do not come: it was killed or paused.
    """

    def __init__(self, node: Node, local: LocalTime, now_ns: int, bus: _Bus) -> None:
        self.rings: dict[str, Ring] = {}
        self._waiting: tuple[Ring, ...] = ()
        self._bus = bus
        self.life = 0
        self.kept: tuple[bytes, ...] = ()
        self.ticked_ns = -1
        self.up = self.paused = False
        self._wrong = local
        self.start(node, now_ns)

    def start(self, node: Node, now_ns: int) -> None:
        """A new process: it knows what is on its disk, and not even how long its clock has drifted."""
        self.node = node
        node.recall(self._wrong.local_ns(now_ns), self.kept)
        self.up = True
        self._listen()
        self._changes = deque((now_ns, key, True) for key in sorted(self._bus.tokens) if self._watches(key))
        self._bus.announce(node.alive_keys[0], now_ns + LATENCY_NS, here=True)
        self._local = self._wrong
        self._ticks = Ticks(node, self._local.local_ns(now_ns) - 1)
        self._plan(now_ns)

    def kill(self, now_ns: int) -> None:
        self.up = self.paused = False
        self.life += 1
        self._bus.forget(self)
        self.rings, self._waiting = {}, ()
        self._bus.announce(self.node.alive_keys[0], now_ns + LATENCY_NS, here=False)

    def pause(self) -> None:
        self.paused = True
        self.life += 1

    def lapse(self, life: int, now_ns: int) -> None:
        """Ends the liveliness lease of a paused process: if it is paused still (`life`), others see it go."""
        if self.paused and self.life == life:
            self._bus.announce(self.node.alive_keys[0], now_ns, here=False)

    def resume(self, now_ns: int) -> None:
        """Lets a paused process go on: at once if it has slept through a tick."""
        self.paused = False
        self._bus.announce(self.node.alive_keys[0], now_ns + LATENCY_NS, here=True)
        self._plan(now_ns)

    def _listen(self) -> None:
        """Listens to what the node wants to hear."""
        self._heard = self.node.subscriptions
        robots, rings = self._bus.robots, self.rings
        self.rings = {
            key: deque(maxlen=inbox_size(key, robots)) if (ring := rings.get(key)) is None else ring
            for key in self._heard
        }
        self._waiting = tuple(self.rings.values())
        self._bus.listen(self)

    def see(self, time_ns: int, key: str, here: bool) -> None:
        """Notes that a liveliness token comes or goes at `time_ns`."""
        if self.up and self._watches(key):
            self._changes.append((time_ns, key, here))

    def _watches(self, token: str) -> bool:
        watched = self.node.watched  # of most nothing until they know who is near, or no token of others
        return bool(watched) and (token in watched or any(_matches(each, token) for each in watched))

    def tick(self, true_ns: int) -> list[Outgoing]:
        """One round of `agent.runtime.loop.loop`."""
        node, ticks = self.node, self._ticks
        self.ticked_ns = true_ns
        now_ns, missed, late_ns = ticks.take(self._local.local_ns(true_ns))
        if late_ns * TOLD_SHARE > node.period_ns:
            node.late(now_ns, late_ns)
        while self._changes and self._changes[0][0] <= true_ns:
            node.present(*self._changes.popleft()[1:])
        receive = node.receive
        for ring in self._waiting:
            while ring and ring[0][0] <= true_ns:
                _, key, payload = ring.popleft()
                receive(now_ns, key, payload)
        outgoing = node.tick(now_ns)
        if node.subscriptions is not self._heard:
            self._listen()
        if node.lasting is not self.kept:
            self.kept = node.lasting
            node.kept(self.kept, "")
        if missed:
            node.timed(0, missed)
        if self._local.epoch_ns is None and ticks.epoch_ns is not None:
            self._local = self._local._replace(epoch_ns=ticks.epoch_ns)
        ticks.plan(now_ns)
        self._plan(true_ns)
        return outgoing

    def _plan(self, now_ns: int) -> None:
        self.due_ns = max(now_ns, self._local.true_ns(self._ticks.due_ns))


def _warm_up_periods(fleet: Fleet, ahead_ns: int) -> int:
    """Periods from the start to the earliest epoch, which the clock that is furthest ahead shows first."""
    if not fleet.avoidance.enabled or len(fleet.ids) == 1:
        return WARM_UP_PERIODS
    return max(WARM_UP_PERIODS, fleet.listening_rounds + 1 + ceil(ahead_ns / fleet.period_ns))


class Simulation:
    """Every agent and plant of `fleet` in virtual time.

    Args:
        fleet: resolved (`agent.formation.geometry.resolved`). Every body is simulated, whatever its
        connection. sink: called with every message, (time of arrival ns, key, payload).
        begin_ns: true time at which it begins, at the earliest.

    Attributes:
        now_ns: true time.
        epoch_ns: the mission's epoch; before the mission is sent, the earliest that it can have.
        reasons: what went wrong in the operator's eyes, as sentences for the verdict.
        attended: whether the operator is there: its heartbeats come, where the fleet needs them.
        decode: as `agent.messages.codec.decode`, but each message is read once for all that ask for it.

    Raises:
        handfast.agent.fleet.model.FleetError: the formation cannot be resolved.
    """

    def __init__(self, fleet: Fleet, sink: Sink | None = None, begin_ns: int = 0) -> None:
        self.fleet = fleet
        self.reasons: list[str] = []
        self.attended = True
        self._sink = sink
        plan = FaultPlan(fleet)
        self._rules = plan.file_rules()
        clocks = self._clocks = {robot: LocalTime(*plan.clock(robot)) for robot in fleet.ids}
        # No clock may show a time before 0.
        behind_ns = max(0, *(-clock.skew_ns for clock in clocks.values()))
        self.now_ns = next_tick_ns(max(begin_ns, behind_ns) - 1, fleet.period_ns, 0)
        ahead_ns = max(0, *(clock.skew_ns for clock in clocks.values()))
        self.epoch_ns = self.now_ns + _warm_up_periods(fleet, ahead_ns) * fleet.period_ns
        self._operator = Operator(fleet, resolve(fleet))
        self._order_keys = {
            self._operator.keys[kind] for kind in (Mission, Stop, Resume)
        } | self._operator.relay_keys
        self._bodies = Bodies(fleet)
        # Messages do not change, and all that hear one are here: the first reads it for the others.
        self.decode: Final[Decode] = lru_cache(maxsize=max(READ_ROUNDS * len(fleet.ids), READ_MIN))(decode)
        self.agents = [Agent(fleet, robot, self.decode) for robot in fleet.ids]
        self.plants = [self._plant(robot) for robot in fleet.ids]
        nodes: list[tuple[str, int, Node]] = [("plant", node.robot, node) for node in self.plants]
        nodes += [("agent", node.robot, node) for node in self.agents]
        self._bus = _Bus(len(fleet.ids))
        self._lease_ms = fleet.lease_ms
        self._hosts = [_Host(node, clocks[robot], self.now_ns, self._bus) for _, robot, node in nodes]
        self._order: dict[Process, int] = {(r, role): order for order, (role, r, _) in enumerate(nodes)}
        self._due = [(host.due_ns, order, host.life) for order, host in enumerate(self._hosts)]
        heapq.heapify(self._due)
        self._todo: list[tuple[int, int, Callable[[], None]]] = []
        self._planned = self._events = 0

    def _plant(self, robot: int) -> PlantNode:
        body = self._bodies.make(robot, self._clocks[robot].local_ns(self.now_ns))
        return PlantNode(self.fleet, robot, body)

    # ------------------------------------------------------------------ the bus and the ticks

    def publish(self, key: str, payload: bytes) -> None:
        """Puts a message on the bus now, as an operator or a node does."""
        if key in self._order_keys:
            with suppress(Malformed):
                self._operator.hear(key, decode(payload))
        arrival_ns = self.now_ns + LATENCY_NS
        self._bus.put(arrival_ns, key, payload)
        if self._sink is not None:
            self._sink(arrival_ns, key, payload)

    def run_until(self, time_ns: int) -> None:
        """Does every tick that is due up to `time_ns`, in the order of their times, and what rules order.

        What is ordered for the time of a tick comes before it.
        """
        while self._todo and self._todo[0][0] <= time_ns:
            at_ns, _, do = heapq.heappop(self._todo)
            self._tick_until(at_ns - 1)
            self.now_ns = at_ns
            do()
        self._tick_until(time_ns)
        self.now_ns = time_ns

    def _tick_until(self, time_ns: int) -> None:
        due, hosts = self._due, self._hosts
        while due and due[0][0] <= time_ns:
            now_ns, order, life = due[0]
            host = hosts[order]
            if life != host.life:
                heapq.heappop(due)
                continue
            self.now_ns = now_ns
            for key, payload in host.tick(now_ns):
                self.publish(key, payload)
            heapq.heapreplace(due, (host.due_ns, order, life))

    def _runs(self, robot: int, role: str) -> bool:
        """Whether a process (`role` "agent" or "plant") is there, and goes on."""
        host = self._host(robot, role)
        return host.up and not host.paused

    def _host(self, robot: int, role: str) -> _Host:
        return self._hosts[self._order[robot, role]]

    # ------------------------------------------------------------------ what rules do to processes

    def _tell_truth(self, robot: int, life: int) -> None:
        """Records where a vehicle is of which no bridge tells, for the verdict, until one does. Nobody in the
        fleet hears it."""
        host, node = self._host(robot, "plant"), self.plants[self.fleet.ids.index(robot)]
        if self._sink is None or life != host.life or (self._runs(robot, "plant") and node.healthy):
            return
        local_ns = self._clocks[robot].local_ns(self.now_ns)
        body = self._bodies.there(robot)
        if self._runs(robot, "plant") or body.alone(local_ns):
            state = PlantState(robot, 0, local_ns, *body.pose, 0.0, 0.0, False, True, False, "")
            self._sink(self.now_ns, key_expressions.plant_truth(self.fleet.fleet.name, robot), encode(state))
            self._at(self.now_ns + self.fleet.period_ns, partial(self._tell_truth, robot, life))

    def _at(self, time_ns: int, do: Callable[[], None]) -> None:
        """Does `do` at a time; of one time, what was asked for first comes first."""
        heapq.heappush(self._todo, (time_ns, self._planned, do))
        self._planned += 1

    def _carry_out(self, action: Action) -> None:
        order, host = self._order[action.robot, action.role], self._host(action.robot, action.role)
        if action.what == "kill":
            host.kill(self.now_ns)
            if action.wipe:
                host.kept = ()
        elif action.what == "stop":
            host.pause()
            gone_ns = self.now_ns + round(LEASE_SHARE * self._lease_ms * NS_PER_MS)
            self._at(gone_ns, partial(host.lapse, host.life, gone_ns))
        else:
            if action.what == "start":
                host.start(self._again(action.robot, action.role), self.now_ns)
                self._at(self.now_ns + AGAIN_NS, self._say_again)
            else:
                host.resume(self.now_ns)
            heapq.heappush(self._due, (host.due_ns, order, host.life))
        if action.role == "plant" and action.what in ("kill", "stop"):
            self._tell_truth(action.robot, host.life)
        event = Event(action.robot, self._events, self.now_ns, action.role, action.what, action.rule)
        self._events += 1
        if self._sink is not None:
            self._sink(self.now_ns, key_expressions.events(self.fleet.fleet.name), encode(event))

    def _again(self, robot: int, role: str) -> Node:
        """A new node in the place of one that is gone."""
        index = self.fleet.ids.index(robot)
        if role == "agent":
            self.agents[index] = Agent(self.fleet, robot, self.decode)
            return self.agents[index]
        self.plants[index] = self._plant(robot)
        return self.plants[index]

    # ------------------------------------------------------------------ the mission

    def start(self, duration_ns: int, progress: Progress | None = None) -> bool:
        """Waits until every agent is ready, then sends the mission: the fleet drives from `epoch_ns` on.

        Args:
            duration_ns: how long it drives.
            progress: see `run`.

        Returns False when the fleet does not become ready, which `reasons` tells, or `progress` says no.
        """
        period_ns = self.fleet.period_ns
        begun_ns, epoch_ns = self.now_ns, self.epoch_ns
        while not all(is_ready(agent.state.value) for agent in self.agents):
            if self.now_ns >= begun_ns + READY_TIMEOUT_NS:
                waiting = [
                    f"robot {agent.robot} ({agent.reason or 'nothing heard'})"
                    for agent in self.agents
                    if not is_ready(agent.state.value)
                ]
                self.reasons.append(
                    f"Not ready within {READY_TIMEOUT_NS // NS_PER_S} s: {', '.join(waiting)}."
                )
                return False
            self.run_until(self.now_ns + period_ns)
            if 2 * (self.now_ns - begun_ns) > epoch_ns - begun_ns:
                self.epoch_ns = max(epoch_ns, next_tick_ns(self.now_ns + EPOCH_AHEAD_NS - 1, period_ns, 0))
            quarter_over = self.now_ns % PROGRESS_PERIOD_NS < period_ns
            if quarter_over and progress is not None and not progress(self._fleet_time_s):
                return False
        for action in actions(self._rules, self.fleet.ids, duration_ns / NS_PER_S):
            at_ns = self.epoch_ns + round(action.time_s * NS_PER_S)
            self._at(at_ns, partial(self._carry_out, action))
        for order in self.fleet.orders:
            self._at(self.epoch_ns + round(order.at * NS_PER_S), partial(self._carry_order_out, order))
        if self.fleet.supervision.deadman_s is not None:
            self._beat()
        self._say(self._operator.begin(self.now_ns, self.epoch_ns, duration_ns))
        return True

    # ------------------------------------------------------------------ orders

    def give(self, order: OrderSection) -> None:
        """Gives an order now, whatever its time.

        Raises:
            handfast.deploy.orders.mission_editing.OrderError: it cannot be carried out.
        """
        self._say(self._operator.give(order, self.now_ns, self._heard))

    @property
    def _heard(self) -> set[int]:
        """The robots whose agents have said something lately: each does in every tick."""
        ticked = {robot: self._host(robot, "agent").ticked_ns for robot in self.fleet.ids}
        return {robot for robot, at_ns in ticked.items() if at_ns >= 0 and self.now_ns - at_ns < HEARD_NS}

    def _carry_order_out(self, order: OrderSection) -> None:
        try:
            self.give(order)
        except OrderError as error:
            self.reasons.append(refused(order, error))

    def _say_again(self) -> None:
        for message in self._operator.again():
            self._say(message)

    def _beat(self) -> None:
        if self.attended:
            self._say(Heartbeat(self.now_ns, "simulate"))
        self._at(self.now_ns + HEARTBEAT_PERIOD_NS, self._beat)

    def _say(self, message: Order | Heartbeat) -> None:
        self.publish(*self._operator.outgoing(message))

    # ------------------------------------------------------------------ the drive

    def run(self, progress: Progress | None = None) -> None:
        """The whole mission: warm-up, drive, stop.

        `progress` is called with the fleet time (s, below 0 before the epoch) four times a second; when it
        returns False the run ends there.
        """
        with guards.seldom_looked_for(), guards.ended(self.fleet) as came_on:
            self._run(progress, came_on)

    def _run(self, progress: Progress | None, came_on: Callable[[], None]) -> None:
        duration_ns = round(self.fleet.fleet.duration_s * NS_PER_S)
        if not self.start(duration_ns, progress):
            return
        end_ns = self.epoch_ns + duration_ns
        while self.now_ns < end_ns:
            self.run_until(min(end_ns, (self.now_ns // PROGRESS_PERIOD_NS + 1) * PROGRESS_PERIOD_NS))
            came_on()
            if progress is not None and not progress(self._fleet_time_s):
                return
        for order, host in enumerate(self._hosts):
            if host.paused:
                host.resume(self.now_ns)
                heapq.heappush(self._due, (host.due_ns, order, host.life))
        while self.now_ns < end_ns + STOP_TIMEOUT_NS and not self.stopped:
            self.run_until(self.now_ns + self.fleet.period_ns)

    @property
    def _fleet_time_s(self) -> float:
        return (self.now_ns - self.epoch_ns) / NS_PER_S

    @property
    def stopped(self) -> bool:
        """True when every robot stands, or can do no more."""
        return all(
            agent.state in (State.STOPPED, State.STANDBY, State.FAULT)
            for agent in self.agents
            if self._host(agent.robot, "agent").up
        )
