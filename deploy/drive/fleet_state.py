"""A fleet as who drives it follows it: what was ordered, what its robots say, which processes are there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
    Ask,
    Beacon,
    HandState,
    Heartbeat,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.runtime.loop import RealClock
from handfast.agent.transport.bus import Bus
from handfast.deploy.console.wording import robots, some
from handfast.deploy.drive.readiness import VehicleChecks, in_words, is_ready, may_begin, waits
from handfast.deploy.drive.watch import Watch, fleet_time_s
from handfast.deploy.faults.process_actions import Process
from handfast.deploy.inventory.own_orders import OwnOrders
from handfast.deploy.orders.operator import HEARD_NS, Operator, Order
from handfast.deploy.processes.child import FleetProcesses
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.session.faults import author
from handfast.deploy.session.session import valid

AGAIN_PERIOD_NS: Final = NS_PER_S // 2
"""How often an order is sent again that a process has not acknowledged."""
RECORDER_INBOX: Final = 65_536
COLLECT_S: Final = 0.2
"""So long at a time what came is taken: where there is more than the processor has time for, as beside robots
in real time that take all of it, a drive must end and a Ctrl-C be heard all the same."""
_ONLY_RECORDED: Final = (Wrench, LinkTrace)

Record = Callable[[int, str, bytes], Message | None]
"""Takes what came: time of reception (ns), key, payload; gives the message, None when it is none."""


class FleetState:
    """`fleet` (resolved, as its robots read it) on a bus that is connected to all its processes.

    Args:
        record: keeps what comes.
        listens: keys to listen to; all there are unless given.

    Attributes:
        author: who gives orders here.
        epoch_ns: of this drive's mission, None before it is given.
        present: the processes that are there.
        states: the latest state of each plant that is up.
        is_behind: whether not all that came has been taken.
    """

    def __init__(
        self,
        fleet: Fleet,
        bus: Bus,
        processes: FleetProcesses,
        record: Record,
        listens: Sequence[str] = (),
    ) -> None:
        self.fleet: Final = fleet
        self.processes: Final = processes
        self._bus, self._record = bus, record
        self.clock: Final = RealClock()
        geometry = resolve(fleet)
        self.watch: Final = Watch(fleet, geometry)
        self.operator: Final = Operator(fleet, geometry)
        self._own = OwnOrders(fleet)
        for order in self._own.orders:
            self.operator.hear(self.operator.keys[type(order)], order)
        self.checks: Final = VehicleChecks(fleet)
        self.author: Final = author()
        self.epoch_ns: int | None = None
        self.is_behind = False
        self._waiting: Iterator[tuple[str, bytes]] = iter(())
        self._came_ns = 0
        """What came, and when."""
        self.present: set[Process] = set()
        self.states: dict[int, PlantState] = {}
        self._truths: dict[int, PlantState] = {}
        """Where each simulated body really was last, for those that measure with noise."""
        self._heard_ns: dict[int, int] = {}
        """When each agent was heard last."""
        self._again_due_ns = self._ask_due_ns = 0
        name = fleet.fleet.name
        for key in self.operator.keys.values():
            bus.declare(key)
        for key in listens or (key_expressions.everything(name),):
            bus.subscribe(key, RECORDER_INBOX)
        self._presence = bus.watch(key_expressions.alive(name, "*", "*"))

    # ------------------------------------------------------------------ what comes

    def collect(self, most_s: float = COLLECT_S) -> None:
        """Takes what came, for `most_s` seconds at most; what is left then is taken next time, before what is
        new, with the time (wall clock, ns) at which it was taken from the bus.

        Raises:
            RecordingError: it cannot be recorded; what comes from now on is taken all the same.
        """
        until_s, is_fresh = time.monotonic() + most_s, not self.is_behind
        while True:
            if is_fresh:
                self._came_ns, self._waiting = self.clock.now_ns(), iter(self._bus.drain())
                self.is_behind = True
            for key, payload in self._waiting:
                self._take(self._came_ns, key, payload)
                if time.monotonic() >= until_s:
                    return
            self.is_behind = False
            if is_fresh:
                return
            is_fresh = True

    def _take(self, now_ns: int, key: str, payload: bytes) -> None:
        message = self.record(now_ns, key, payload)
        kind = type(message)
        if message is None or kind in _ONLY_RECORDED:
            return
        self.watch.feed(key, message)
        if kind is PlantState:
            self._locate(key, message)
        elif kind is not HandState:
            if (order := self.operator.hear_at(now_ns, key, message)) is not None:
                self._own.keep(order)
            self.checks.feed(now_ns, key, message)
            self._note(now_ns, key, message)

    def _note(self, now_ns: int, key: str, message: Message) -> None:
        name = self.fleet.fleet.name
        if (type(message) is Status and key == key_expressions.status(name, message.robot)) or (
            type(message) is Beacon and key == key_expressions.beacon(name, message.robot)
        ):
            self._heard_ns[message.robot] = now_ns

    @property
    def heard(self) -> set[int]:
        """The robots whose agents have said something lately."""
        now_ns = self.clock.now_ns()
        return {robot for robot, at_ns in self._heard_ns.items() if now_ns - at_ns < HEARD_NS}

    def record(self, now_ns: int, key: str, payload: bytes) -> Message | None:
        """Keeps one message; raises as `collect`."""
        try:
            return self._record(now_ns, key, payload)
        except RecordingError:
            self._record = _unrecorded
            raise

    def _locate(self, key: str, message: Message) -> None:
        if type(message) is PlantState:
            name, robot = self.fleet.fleet.name, message.robot
            if key == key_expressions.plant_state(name, robot):
                self.states[robot] = message
            elif key == key_expressions.plant_truth(name, robot):
                self._truths[robot] = message

    def look(self) -> list[str]:
        """What is to be said of processes that came or went."""
        for key, here in self._presence.update():
            process = key_expressions.robot_of_alive(key)
            if process is not None:
                (self.present.add if here else self.present.discard)(process)
                if not here and not self.processes.ours:
                    self._forget(*process)
        return self.processes.look(self.present, self.time_s)

    def _forget(self, robot: int, role: str) -> None:
        """What a process said last does not hold any more: there is no connection to it."""
        if role == "agent":
            self.watch.forget(robot)
        else:
            self.states.pop(robot, None)
            self._truths.pop(robot, None)

    @property
    def time_s(self) -> float | None:
        """Fleet time, None before the epoch is set."""
        return fleet_time_s(self.clock.now_ns(), self.epoch_ns)

    def pose(self, robot: int) -> Pose | None:
        """Where a robot's body was seen last."""
        seen = self._truths.get(robot) or self.states.get(robot)
        return None if seen is None else Pose(seen.x, seen.y, seen.heading, seen.speed, seen.yaw_rate)

    # ------------------------------------------------------------------ what is said

    def say(self, message: Order | Heartbeat | Ask) -> None:
        self._bus.publish(*self.operator.outgoing(message))
        if isinstance(message, Mission | Stop | Resume):
            self._own.keep(message)

    def begin(self, epoch_ns: int, duration_ns: int) -> None:
        """Gives the drive's mission."""
        now_ns = self.clock.now_ns()
        self.epoch_ns = epoch_ns
        self._again_due_ns, self._ask_due_ns = now_ns + AGAIN_PERIOD_NS, now_ns
        self.say(self.operator.begin(now_ns, epoch_ns, duration_ns))

    def ask(self) -> None:
        """Asks now and then for orders that were not heard: other operators' messages need not come here,
        agents relay them."""
        now_ns = self.clock.now_ns()
        if self.operator.behind and now_ns >= self._ask_due_ns:
            self._ask_due_ns = now_ns + AGAIN_PERIOD_NS
            self.say(Ask(now_ns, self.author))

    def say_again(self) -> None:
        """Sends now and then the orders that somebody has not acknowledged: a process that starts again needs
        them too."""
        now_ns = self.clock.now_ns()
        if now_ns >= self._again_due_ns:
            self._again_due_ns = now_ns + AGAIN_PERIOD_NS
            for message in self.operator.wanted(self.watch.statuses, self.states, self.processes.up):
                self.say(message)

    # ------------------------------------------------------------------ who lacks what

    @property
    def is_ready(self) -> bool:
        """Whether all wait for a mission, and what was ordered before was heard."""
        statuses = self.watch.statuses
        if not all(self._begins(statuses.get(robot), self.states.get(robot)) for robot in self.fleet.ids):
            return False
        known = self.operator.foreign is not None or not self.operator.ahead(self.clock.now_ns())
        return self.processes.ours or known

    def _begins(self, status: Status | None, plant: PlantState | None) -> bool:
        """Whether a robot keeps the fleet from no drive. Those that were up before may stand after a stop: a
        new mission and a resume make them ready."""
        if self.processes.ours:
            return status is not None and is_ready(status.state)
        stands_by = status is not None and self.fleet.robot(status.robot).reserve
        return may_begin(status, plant, stands_by=stands_by)

    def waits(self, missing: Sequence[str]) -> str:
        """What keeps the fleet from starting, in words; `missing` are processes that are not there."""
        if missing:
            return some(missing)
        found = waits(self.fleet.ids, self.watch.statuses, self.states, self._begins)
        ahead = self.operator.ahead(self.clock.now_ns())
        if ahead and not found:
            says = "says" if len(ahead) == 1 else "say"
            return f"{robots(ahead)} {says} that something was ordered, and nobody relays it"
        return in_words(found) if found else in_words(self.checks.waits())

    @property
    def without_mission(self) -> list[int]:
        """Robots whose agent has not acknowledged the mission, or whose plant does not have its epoch."""
        version, statuses = self.operator.mission_version, self.watch.statuses
        return [
            robot
            for robot in self.fleet.ids
            if robot not in statuses
            or statuses[robot].mission_version < version
            or not self.operator.has_epoch(self.states.get(robot))
        ]

    @property
    def members(self) -> list[int]:
        """Robots that have a place in the formation now."""
        return self.watch.members(self.time_s)

    @property
    def without_order(self) -> list[int]:
        """Robots whose agents have not acknowledged the last stop or resume."""
        version = self.operator.order_version
        return [robot for robot, each in self.watch.statuses.items() if each.order_version < version]

    @property
    def on_other_file(self) -> list[int]:
        """Robots whose agents read another fleet file, and have refused the mission for that."""
        version, ours = self.operator.mission_version, self.operator.digest
        return [
            robot
            for robot, status in self.watch.statuses.items()
            if status.mission_version < version and status.digest and status.digest != (ours,)
        ]


def _unrecorded(_now_ns: int, _key: str, payload: bytes) -> Message | None:
    return valid(payload)
