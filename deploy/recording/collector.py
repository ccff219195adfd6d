"""Collecting a run, message by message, into a `Recording`.

A live run and the reader of its MCAP file (`deploy.recording.mcap_reader`) both feed the same collector, so
figures and metrics do not depend on which it was.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, resolve
from handfast.agent.formation.mission_plan import PlanError, plan_of
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import (
    TIME_NS_MAX,
    TOPICS,
    Ask,
    Beacon,
    Checks,
    Event,
    Faults,
    HandState,
    Heartbeat,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    StatusText,
    Stop,
    Wrench,
)
from handfast.deploy.recording.columns import Store
from handfast.deploy.recording.recording import LiveFaults, Recording, RobotData
from handfast.deploy.recording.rows import HandRows, LinkRows, Rows, StatusRows

# A message whose time is further than this from its reception is nobody's measurement (garbage, or
# a host whose clock was never set): it would stretch the run by hours.
CLOCK_TOLERANCE_NS: Final = 60_000_000_000
_RUN_NS_MAX: Final = 12 * 3600 * 10**9
"""A clock that drifts on purpose is accepted for so long after the start; later stamps count as garbage."""
BEACONS: Final = 32
"""So many of each robot's last beacons are kept: those of some seconds."""
_BEACON: Final = TOPICS.index("beacon")
_OF_ROBOTS: Final = (HandState, PlantState, Wrench, Status, LinkTrace, Checks, Beacon, StatusText)


_Sink = Rows | StatusRows

ASIDE_MESSAGES: Final = 20_000
"""After so many messages, what was collected is moved from memory to a file."""


class RunData:
    """Collects a run, message by message: `feed` all of them, then ask for the `recording`.

    Args:
        aside: folder in which what has been collected may wait; None keeps all of it in memory.
    """

    def __init__(
        self, fleet: Fleet, *, mode: str = "run", seed: int | None = None, aside: Path | None = None
    ) -> None:
        store = self._store = Store(aside)
        self._fed = 0
        self.fleet, self.mode = fleet, mode
        self.seed = fleet.fleet.seed if seed is None else seed
        self.foreign = 0
        # Agents relay orders: the first message of each is kept.
        self._missions: dict[Mission, Mission] = {}
        self._geometry: Geometry | None = None
        self._stops: dict[Stop, Stop] = {}
        self._resumes: dict[Resume, Resume] = {}
        self.events: list[Event] = []
        self.status_texts: list[StatusText] = []
        self.live_faults: list[LiveFaults] = []
        self._links = LinkRows(store)
        plan = FaultPlan(fleet)
        self._clocks = {robot.id: plan.clock(robot.id) for robot in fleet.robots}
        self._texts: dict[str, str] = {}
        self._plant = {robot.id: Rows(PlantState, robot.id, store) for robot in fleet.robots}
        self._truth = {robot.id: Rows(PlantState, robot.id, store) for robot in fleet.robots}
        self._hand = {robot.id: HandRows(robot.id, store) for robot in fleet.robots}
        self._wrench = {robot.id: Rows(Wrench, robot.id, store) for robot in fleet.robots}
        self._status = {robot.id: StatusRows(robot.id, store) for robot in fleet.robots}
        self._sinks: dict[str, _Sink] = {}
        prefix = fleet.fleet.name
        for robot in self._plant:
            self._sinks |= {
                key_expressions.plant_state(prefix, robot): self._plant[robot],
                key_expressions.plant_truth(prefix, robot): self._truth[robot],
                key_expressions.hand(prefix, robot): self._hand[robot],
                key_expressions.wrench(prefix, robot): self._wrench[robot],
                key_expressions.status(prefix, robot): self._status[robot],
            }
        relays = {key_expressions.relayed(prefix, robot) for robot in self._plant}
        self._orders_from: dict[type, set[str]] = {
            Mission: {key_expressions.mission(prefix), *relays},
            Stop: {key_expressions.stop(prefix), *relays},
            Resume: {key_expressions.resume(prefix), *relays},
        }
        self._events_key = key_expressions.events(prefix)
        self._ignored: dict[str, type[Message]] = {
            key_expressions.heartbeat(prefix): Heartbeat,
            key_expressions.ask(prefix): Ask,
        }
        """Messages that are recorded for people, and of which no table is made."""
        self._beacons: dict[int, deque[Beacon]] = {robot: deque(maxlen=BEACONS) for robot in self._plant}
        self._texts_from: dict[str, int] = {}
        self._beacons_from: dict[str, int] = {}
        self._traced: dict[str, int] = {}
        self._faults_from: dict[str, tuple[int, str]] = {key_expressions.faults(prefix): (0, "")}
        self._over_ns = TIME_NS_MAX
        """When the drive is over, by the last mission."""
        for robot in self._plant:
            self._ignored[key_expressions.checks(prefix, robot)] = Checks
            self._texts_from[key_expressions.status_texts(prefix, robot)] = robot
            self._beacons_from[key_expressions.beacon(prefix, robot)] = robot
            self._traced[key_expressions.links(prefix, robot)] = robot
            self._traced[key_expressions.plant_links(prefix, robot)] = robot
            for role in key_expressions.ROLES:
                self._faults_from[key_expressions.faults_held(prefix, robot, role)] = robot, role

    def feed(self, received_ns: int, key: str, message: Message) -> None:
        """Take one message that was received on `key` at `received_ns` (wall clock or virtual time)."""
        self._fed += 1
        if self._fed % ASIDE_MESSAGES == 0:
            self._store.put_aside()
        sink = self._sinks.get(key)
        off_ns = message.time_ns - received_ns
        is_near = -CLOCK_TOLERANCE_NS <= off_ns <= CLOCK_TOLERANCE_NS
        if not is_near and not self._is_meant(received_ns, key, message):
            self.foreign += 1
        elif sink is not None and sink.is_of(message):
            sink.append(message)
        elif not self._take(received_ns, key, message):
            self.foreign += 1

    def _take(self, received_ns: int, key: str, message: Message) -> bool:
        """Take a message of which there is no table; return False for one of nobody's."""
        if isinstance(message, (Mission, Stop, Resume)):
            return self._take_order(key, message)
        if isinstance(message, LinkTrace):
            if not self._is_ours(key, message):
                return False
            entries = tuple(entry for entry in message.entries if entry.topic != _BEACON)
            self._links.append(message._replace(entries=entries))
        elif isinstance(message, Faults):
            if (source := self._faults_from.get(key)) is None:
                return False
            rules = self._texts.setdefault(message.rules, message.rules)  # said once a second: keep one
            self.live_faults.append(LiveFaults(received_ns, *source, message._replace(rules=rules)))
        elif isinstance(message, Event) and key == self._events_key:
            self.events.append(message)
        elif isinstance(message, StatusText) and self._texts_from.get(key) == message.robot:
            self.status_texts.append(message)
        elif isinstance(message, Beacon) and self._beacons_from.get(key) == message.robot:
            if message.time_ns <= self._over_ns:
                self._beacons[message.robot].append(message)
        else:
            return self._ignored.get(key) is type(message)
        return True

    def _take_order(self, key: str, order: Mission | Stop | Resume) -> bool:
        """Keep an order once: operators and agents repeat it."""
        if key not in self._orders_from[type(order)]:
            return False
        if isinstance(order, Mission):
            self._take_mission(order)
        elif isinstance(order, Stop):
            self._stops.setdefault(order._replace(time_ns=0), order)
        else:
            self._resumes.setdefault(order._replace(time_ns=0), order)
        return True

    def _take_mission(self, mission: Mission) -> None:
        """Keeps a mission once; one that cannot be driven is not what the fleet did."""
        content = mission._replace(time_ns=0)
        if content in self._missions:
            return
        if self._geometry is None and not mission.robots:
            self._geometry = resolve(self.fleet)
        try:
            plan_of(mission, self.fleet, self._geometry)
        except PlanError:
            self.foreign += 1
        else:
            self._missions[content] = mission
            self._over_ns = mission.epoch_ns + mission.duration_ns

    def _is_ours(self, key: str, trace: LinkTrace) -> bool:
        return self._traced.get(key) == trace.robot and all(
            entry.source in self._plant for entry in trace.entries
        )

    def _is_meant(self, received_ns: int, key: str, message: Message) -> bool:
        """Whether a time that is far from its reception is what the faults on purpose make of it."""
        robot = message.robot if isinstance(message, _OF_ROBOTS) else 0
        if isinstance(message, (Faults, Mission, Stop, Resume)):
            # They are sent again for hours, always with the time at which they were sent.
            known = any(key in keys for keys in self._orders_from.values())
            return message.time_ns < received_ns and (key in self._faults_from or known)
        skew_ns, drift = self._clocks.get(robot, (0, 0.0))
        off_ns = abs(message.time_ns - skew_ns - received_ns)
        return bool(skew_ns or drift) and off_ns <= CLOCK_TOLERANCE_NS + abs(drift) * _RUN_NS_MAX

    def recording(
        self,
        *,
        reasons: Sequence[str] = (),
        interrupted: bool = False,
        warnings: Sequence[str] = (),
        fleet_toml: str | None = None,
    ) -> Recording:
        """The run as it stands; what is fed later does not change it."""
        mission, epoch_ns = self._mission(), self.begun_ns
        robots = {
            robot: RobotData(
                robot,
                self._plant[robot].table(epoch_ns, clock),
                self._truth[robot].table(epoch_ns, clock),
                self._hand[robot].table(epoch_ns, clock),
                self._hand[robot].multipliers(epoch_ns, clock),
                self._wrench[robot].table(epoch_ns, clock),
                self._status[robot].table(epoch_ns, clock),
            )
            for robot, clock in self._clocks.items()
        }
        return Recording(
            self.fleet,
            robots,
            tuple(self._missions.values()),
            tuple(self._stops.values()),
            mission.epoch_ns if mission else None,
            self.mode,
            self.seed,
            tuple(reasons),
            interrupted,
            self.foreign,
            tuple(warnings),
            fleet_toml,
            self._links.table(self._clocks, epoch_ns),
            tuple(self.live_faults),
            tuple(self.events),
            tuple(self._resumes.values()),
            {robot: tuple(beacons) for robot, beacons in self._beacons.items()},
            tuple(self.status_texts),
        )

    @property
    def begun_ns(self) -> int:
        """When its time is zero: the epoch of the last mission, or the first pose where none was heard."""
        mission = self._mission()
        return mission.epoch_ns if mission else self._first_ns()

    def _mission(self) -> Mission | None:
        mission: Mission | None = None
        for each in self._missions.values():
            mission = each if newer(each, mission) else mission
        return mission

    def _first_ns(self) -> int:
        known = [rows.times.whole() for rows in self._plant.values()]
        return min((int(times[0]) for times in known if len(times)), default=0)
