"""A run in memory, as columns of numbers: fed live while it happens, or read back from its MCAP file.

Both ways end in the same `Recording`, so the figures and metrics of a run do not depend on which.
Times are fleet time (s): wall clock minus the mission's epoch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from os import PathLike
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from agent.fleet.fleet import Fleet
from agent.links.fault_plan import FaultPlan
from agent.messages import key_expressions
from agent.messages.codec import newer
from agent.messages.types import (
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
    Stop,
    Wrench,
)
from deploy.recording.columns import Store
from deploy.recording.link_table import Floats, LinkRows, LinkTable
from deploy.recording.recorder import RecordingError
from deploy.recording.tables import (
    PLANT_COLUMNS,
    WRENCH_COLUMNS,
    HandRows,
    Rows,
    StatusRows,
    StatusTable,
    Table,
)

MCAP_NAME: Final = "run.mcap"
FLEET_NAME: Final = "fleet.toml"
# A message whose time is further than this from its reception is nobody's measurement (garbage, or
# a host whose clock was never set): it would stretch the run by hours.
CLOCK_TOLERANCE_NS: Final = 60_000_000_000
_RUN_NS_MAX: Final = 12 * 3600 * 10**9
"""For so long after the start a clock that drifts on purpose is told from garbage."""
_BEACON: Final = TOPICS.index("beacon")
_OF_ROBOTS: Final = (HandState, PlantState, Wrench, Status, LinkTrace, Checks, Beacon)


@dataclass(frozen=True)
class RobotData:
    """All that one robot sent. `truth` is empty unless its plant's measurements are noisy."""

    id: int
    plant: Table
    truth: Table
    hand: Table
    multipliers: Table
    wrench: Table
    status: StatusTable

    @cached_property
    def body(self) -> Table:
        """Where the body was, as well as that is known: the truth when recorded, else the measurement.
        Without what its plant itself said is not to be used."""
        table = self.truth if len(self.truth) else self.plant
        return table.only(table["healthy"] > 0.0)


class LiveFaults(NamedTuple):
    """One message about live fault rules, and when it was received (ns, wall clock).

    `robot` and `role` are those of the process that says that it holds the rules, 0 and "" where an
    operator sends them. A process says that it holds a set no more by one without rules.
    """

    received_ns: int
    robot: int
    role: str
    message: Faults


@dataclass(frozen=True)
class Recording:
    """One run. `robots` has an entry for every robot of the fleet, in the fleet's order."""

    fleet: Fleet
    robots: Mapping[int, RobotData]
    missions: Sequence[Mission]
    """Each of them once, as it was first said."""
    stops: Sequence[Stop]
    """Likewise."""
    epoch_ns: int | None
    """Wall clock of fleet time zero; None when no mission was recorded (time then starts with the data)."""
    mode: str = "run"
    seed: int = 0
    reasons: Sequence[str] = ()
    """Reasons for a failed verdict that the operator's side gave (`Recorder.set_outcome`)."""
    interrupted: bool = False
    foreign: int = 0
    """Valid messages that belong to no robot of the fleet or carry an absurd time; they are left out."""
    warnings: Sequence[str] = ()
    fleet_toml: str | None = None
    links: LinkTable = field(default_factory=lambda: LinkRows(Store()).table({}, 0))
    """What links did to messages on purpose. Beacons, which go from all to all, are left out."""
    live_faults: Sequence[LiveFaults] = ()
    """Live fault rules as operators sent them, and as processes said that they held them; as they came."""
    events: Sequence[Event] = ()
    """What was done to processes on purpose."""
    resumes: Sequence[Resume] = ()
    """Leaves to drive again, each of them once, as it was first said."""

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(self.robots)

    @cached_property
    def planned_s(self) -> float:
        """For how long the fleet was told to drive."""
        mission = self.mission
        return mission.duration_ns / 1e9 if mission else self.fleet.fleet.duration_s

    @property
    def mission(self) -> Mission | None:
        """The one that holds in the end."""
        return _last(self.missions)

    def fleet_time_s(self, time_ns: int) -> float:
        """Wall clock (ns) as fleet time."""
        return (time_ns - (self.epoch_ns or 0)) / 1e9

    def halts(self, robot: int) -> list[tuple[float, float]]:
        """Fleet times (start, end) within which a robot had to stand: from a stop to the leave that ends it,
        which has a greater version and is for this robot; inf where none did."""
        orders: list[tuple[float, Stop | Resume]] = []
        orders += [(self.fleet_time_s(stop.time_ns), stop) for stop in self.stops]
        orders += [(self.fleet_time_s(resume.time_ns), resume) for resume in self.resumes]
        found: list[tuple[float, float]] = []
        stopped = resumed = -1
        since_s: float | None = None
        for t, order in sorted(orders, key=lambda entry: entry[0]):
            if isinstance(order, Stop):
                stopped = max(stopped, order.version)
            elif not order.robots or robot in order.robots:
                resumed = max(resumed, order.version)
            halted = stopped >= 0 and stopped >= resumed
            if halted and since_s is None:
                since_s = t
            elif not halted and since_s is not None:
                found.append((since_s, t))
                since_s = None
        return found if since_s is None else [*found, (since_s, inf)]

    @cached_property
    def stopped_s(self) -> float | None:
        """Fleet time of the operator's stop within the drive that was for good, None without one."""
        if self.epoch_ns is None or not self.stops:
            return None
        lasts = [self.halts(robot)[-1:] for robot in self.ids]
        starts = [halts[0][0] for halts in lasts if halts and halts[0][1] == inf]
        if not starts or len(starts) < len(lasts):
            return None  # some drove on
        last_s = max(starts)
        return max(last_s, 0.0) if last_s < self.planned_s else None

    @cached_property
    def data_end_s(self) -> float:
        """Fleet time of the last pose of any robot, 0 without data."""
        return max([0.0, *(float(robot.body.t[-1]) for robot in self.robots.values() if len(robot.body))])

    @cached_property
    def end_s(self) -> float:
        """End of the drive: as planned, or earlier when it was stopped or the data end."""
        ends = [self.planned_s, self.data_end_s]
        return max(0.0, min(ends if self.stopped_s is None else [*ends, self.stopped_s]))

    @cached_property
    def grid(self) -> Floats:
        """(k,) common times (s) of the run: every period of the fleet from 0 to `end_s`."""
        rate_hz = self.fleet.fleet.rate_hz
        # The last tick counts although its stamp may be a hair early.
        return np.arange(int(self.end_s * rate_hz + 0.01) + 1) / rate_hz

    def hand_positions(self, grid: Floats | None = None) -> Floats:
        """Hand points (k, n, 2), m, W, at `grid` (k,) s, for the robots in order (eq. 2, from the pose).

        Linear between poses, held before the first and after the last; NaN for a robot without any.
        """
        grid = self.grid if grid is None else grid
        out = np.full((len(grid), len(self.robots), 2), np.nan)
        for index, (robot, data) in enumerate(zip(self.fleet.robots, self.robots.values(), strict=True)):
            body = data.body
            if len(body):
                heading = body["heading"]
                x = body["x"] + robot.hand_offset_m * np.cos(heading)
                y = body["y"] + robot.hand_offset_m * np.sin(heading)
                out[:, index, 0] = np.interp(grid, body.t, x)
                out[:, index, 1] = np.interp(grid, body.t, y)
        return out

    @classmethod
    def from_folder(cls, folder: str | PathLike[str]) -> Recording:
        """Read the run in `folder` (its ``run.mcap`` and ``fleet.toml``).

        Raises:
            RecordingError: when it is not a run's folder, or its recording cannot be read.
            FleetError: when its fleet file is not valid.
        """
        path = Path(folder)
        if not path.is_dir():
            what = "is not a folder" if path.exists() else "does not exist"
            raise RecordingError(f"{path} {what}; give the folder that a run has left (it holds {MCAP_NAME})")
        if not (path / MCAP_NAME).is_file():
            raise RecordingError(f"{path} holds no {MCAP_NAME}; give the folder that a run has left")
        return cls.from_mcap(path / MCAP_NAME, path / FLEET_NAME)

    @classmethod
    def from_mcap(cls, path: str | PathLike[str], fleet_path: str | PathLike[str] | None = None) -> Recording:
        """Read the recording at `path`, with the fleet file at `fleet_path`, else with the one inside it.

        A file that was cut short, at whatever byte, is read to its last complete chunk, which
        `warnings` then says.

        Raises:
            RecordingError, FleetError: as `from_folder`.
        """
        from deploy.recording.mcap_reader import read_mcap  # here: that module builds on this one

        return read_mcap(Path(path), None if fleet_path is None else Path(fleet_path))


def _last(missions: Sequence[Mission]) -> Mission | None:
    last: Mission | None = None
    for mission in missions:
        if newer(mission, last):
            last = mission
    return last


_Sink = Rows | StatusRows

ASIDE_MESSAGES: Final = 20_000
"""After so many, what was collected is put aside."""


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
        # Agents say them again: what is kept is who said it first.
        self._missions: dict[Mission, Mission] = {}
        self._stops: dict[Stop, Stop] = {}
        self._resumes: dict[Resume, Resume] = {}
        self.events: list[Event] = []
        self.live_faults: list[LiveFaults] = []
        self._links = LinkRows(store)
        plan = FaultPlan(fleet)
        self._clocks = {robot.id: plan.clock(robot.id) for robot in fleet.robots}
        self._texts: dict[str, str] = {}
        self._plant = {robot.id: Rows(PlantState, robot.id, PLANT_COLUMNS, store) for robot in fleet.robots}
        self._truth = {robot.id: Rows(PlantState, robot.id, PLANT_COLUMNS, store) for robot in fleet.robots}
        self._hand = {robot.id: HandRows(robot.id, store) for robot in fleet.robots}
        self._wrench = {robot.id: Rows(Wrench, robot.id, WRENCH_COLUMNS, store) for robot in fleet.robots}
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
        told = {key_expressions.relayed(prefix, robot) for robot in self._plant}
        self._missions_from = {key_expressions.mission(prefix), *told}
        self._stops_from = {key_expressions.stop(prefix), *told}
        self._resumes_from = {key_expressions.resume(prefix), *told}
        self._events_key = key_expressions.events(prefix)
        self._told: dict[str, type[Message]] = {
            key_expressions.heartbeat(prefix): Heartbeat,
            key_expressions.ask(prefix): Ask,
        }
        for robot in self._plant:
            self._told |= {
                key_expressions.checks(prefix, robot): Checks,
                key_expressions.beacon(prefix, robot): Beacon,
            }
        """What is recorded for those who read it there, and nothing is made of."""
        self._traced = {
            key: robot
            for robot in self._plant
            for key in (key_expressions.links(prefix, robot), key_expressions.plant_links(prefix, robot))
        }
        self._faults_from: dict[str, tuple[int, str]] = {key_expressions.faults(prefix): (0, "")} | {
            key_expressions.faults_held(prefix, robot, role): (robot, role)
            for robot in self._plant
            for role in key_expressions.ROLES
        }

    def feed(self, received_ns: int, key: str, message: Message) -> None:
        """Take one message that was received on `key` at `received_ns` (wall clock or virtual time)."""
        self._fed += 1
        if self._fed % ASIDE_MESSAGES == 0:
            self._store.put_aside()
        sink = self._sinks.get(key)
        if abs(message.time_ns - received_ns) > CLOCK_TOLERANCE_NS and not self._is_meant(
            received_ns, key, message
        ):
            self.foreign += 1
        elif sink is not None and type(message) is sink.kind and message[0] == sink.robot:
            sink.append(message)
        elif type(message) is Mission and key in self._missions_from:
            self._missions.setdefault(message._replace(time_ns=0), message)
        elif type(message) is Stop and key in self._stops_from:
            self._stops.setdefault(message._replace(time_ns=0), message)
        elif type(message) is Resume and key in self._resumes_from:
            self._resumes.setdefault(message._replace(time_ns=0), message)
        elif type(message) is LinkTrace and self._is_ours(key, message):
            entries = tuple(entry for entry in message.entries if entry[1] != _BEACON)
            self._links.append(message._replace(entries=entries))
        elif type(message) is Faults and key in self._faults_from:
            rules = self._texts.setdefault(message.rules, message.rules)  # said once a second: keep one
            self.live_faults.append(
                LiveFaults(received_ns, *self._faults_from[key], message._replace(rules=rules))
            )
        elif type(message) is Event and key == self._events_key:
            self.events.append(message)
        elif self._told.get(key) is not type(message):
            self.foreign += 1

    def _is_ours(self, key: str, trace: LinkTrace) -> bool:
        return self._traced.get(key) == trace.robot and all(
            source in self._plant for source, *_ in trace.entries
        )

    def _is_meant(self, received_ns: int, key: str, message: Message) -> bool:
        """Whether a time that is far from its reception is what the faults on purpose make of it."""
        robot = message.robot if isinstance(message, _OF_ROBOTS) else 0
        if isinstance(message, (Faults, Mission, Stop, Resume)):
            # They are said again for hours, always with the time at which they were sent.
            known = self._missions_from | self._stops_from | self._resumes_from
            return message.time_ns < received_ns and (key in self._faults_from or key in known)
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
        mission = _last(list(self._missions.values()))
        epoch_ns = mission.epoch_ns if mission else self._first_ns()
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
        )

    def _first_ns(self) -> int:
        known = [rows.times.whole() for rows in self._plant.values()]
        return min((int(times[0]) for times in known if len(times)), default=0)
