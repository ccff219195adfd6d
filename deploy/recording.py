"""A run in memory, as columns of numbers: fed live while it happens, or read back from its MCAP file.

Both ways end in the same `Recording`, so the figures and metrics of a run do not depend on which.
Times are fleet time (s): wall clock minus the mission's epoch.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent import keys
from agent.fleet import Fleet
from agent.messages import HandState, Message, Mission, PlantState, Status, Stop, Wrench
from deploy.recorder import RecordingError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MCAP_NAME: Final = "run.mcap"
FLEET_NAME: Final = "fleet.toml"
# A message whose time is further than this from its reception is nobody's measurement (garbage, or
# a host whose clock was never set): it would stretch the run by hours.
CLOCK_TOLERANCE_NS: Final = 60_000_000_000
_AGE_MAX: Final = 2**62

PLANT_COLUMNS: Final = ("x", "y", "heading", "speed", "yaw_rate", "force", "torque", "driving", "healthy")
HAND_COLUMNS: Final = (
    "following", "x", "y", "vx", "vy", "navigation_x", "navigation_y", "constraint_x", "constraint_y",
)  # fmt: skip
WRENCH_COLUMNS: Final = ("force", "torque", "brake")
MULTIPLIER_COLUMNS: Final = ("neighbour", "value")


class Table:
    """Columns over time: `t` (n,) s ascending, `values` (n, k), and ``table["x"]`` (n,)."""

    def __init__(self, names: tuple[str, ...], t: Floats, values: Floats) -> None:
        self.names, self.t, self.values = names, t, values

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, name: str) -> Floats:
        return self.values[:, self.names.index(name)]


@dataclass(frozen=True)
class StatusTable:
    """The statuses of one agent: n of them, with all ticks and ages that they hold, in order.

    t (n,) s; states, reasons: n texts; counters: n dictionaries of totals; tick_us, ages_us: all
    values of all statuses, microseconds, of which status k holds ``tick_counts[k]`` and
    ``age_counts[k]``. Ages of neighbours that were never heard are left out.
    """

    t: Floats
    states: Sequence[str]
    reasons: Sequence[str]
    counters: Sequence[Mapping[str, int]]
    tick_us: Ints
    tick_counts: Ints
    ages_us: Ints
    age_counts: Ints

    def __len__(self) -> int:
        return len(self.t)

    def ages_between(self, start: float, end: float) -> Ints:
        """Ages (us) in the statuses of fleet time (start, end]."""
        return self.ages_us[np.repeat((self.t > start) & (self.t <= end), self.age_counts)]

    def totals(self) -> Mapping[str, int]:
        """Counters of the last status, empty without one."""
        return self.counters[-1] if self.counters else {}

    def at(self, t: float) -> tuple[str, str] | None:
        """State and reason at fleet time `t`: those of the last status until then, else of the first."""
        if not self.states:
            return None
        index = max(int(np.searchsorted(self.t, t, side="right")) - 1, 0)
        return self.states[index], self.reasons[index]


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

    @property
    def body(self) -> Table:
        """Where the body was, as well as that is known: the truth when recorded, else the measurement."""
        return self.truth if len(self.truth) else self.plant


@dataclass(frozen=True)
class Recording:
    """One run. `robots` has an entry for every robot of the fleet, in the fleet's order."""

    fleet: Fleet
    robots: Mapping[int, RobotData]
    missions: Sequence[Mission]
    stops: Sequence[Stop]
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
        return max(self.missions, key=lambda mission: mission.version) if self.missions else None

    @cached_property
    def stopped_s(self) -> float | None:
        """Fleet time of the operator's first stop within the drive, None without one."""
        if self.epoch_ns is None or not self.stops:
            return None
        first = min((stop.time_ns - self.epoch_ns) / 1e9 for stop in self.stops)
        return max(first, 0.0) if first < self.planned_s else None

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
        from deploy.mcap_file import read_mcap  # here: that module builds on this one

        return read_mcap(Path(path), None if fleet_path is None else Path(fleet_path))


class _Rows:
    """One growing table: times and a flat row of numbers for every message."""

    def __init__(self, kind: type[Message], robot: int, names: tuple[str, ...]) -> None:
        self.kind, self.robot, self.names = kind, robot, names
        self.times, self.values = array("q"), array("d")
        first = kind._fields.index(names[0])
        self._columns = slice(first, first + len(names))

    def append(self, message: Any) -> None:
        self.times.append(message[2])
        self.values.extend(message[self._columns])

    def table(self, epoch_ns: int) -> Table:
        times = np.array(self.times, dtype=np.int64)
        values = np.array(self.values, dtype=np.float64).reshape(len(times), len(self.names))
        if len(times) > 1 and not (times[1:] > times[:-1]).all():
            times, order = np.unique(times, return_index=True)
            values = values[order]
        return Table(self.names, (times - epoch_ns) / 1e9, values)


class _HandRows(_Rows):
    def __init__(self, robot: int) -> None:
        super().__init__(HandState, robot, HAND_COLUMNS)
        self._multiplier_times, self._multipliers = array("q"), array("d")

    def append(self, message: HandState) -> None:
        super().append(message)
        for pair in message.multipliers:
            self._multiplier_times.append(message.time_ns)
            self._multipliers.extend(pair)

    def multipliers(self, epoch_ns: int) -> Table:
        times = np.array(self._multiplier_times, dtype=np.int64)
        values = np.array(self._multipliers, dtype=np.float64).reshape(len(times), 2)
        order = np.argsort(times, kind="stable")
        return Table(MULTIPLIER_COLUMNS, (times[order] - epoch_ns) / 1e9, values[order])


class _StatusRows:
    kind: type[Message] = Status

    def __init__(self, robot: int) -> None:
        self.robot = robot
        self.times = array("q")
        self._texts: list[tuple[str, str]] = []
        self._counters: list[Mapping[str, int]] = []
        self._ticks, self._tick_counts = array("q"), array("q")
        self._ages, self._age_counts = array("q"), array("q")
        self._known: dict[str, str] = {}

    def append(self, message: Any) -> None:
        known = self._known.setdefault  # the same few texts come thousands of times: keep one of each
        ticks = [value for value in message.tick_us if 0 <= value < _AGE_MAX]
        ages = [value for value in message.ages_us if 0 <= value < _AGE_MAX]
        self.times.append(message.time_ns)
        self._texts.append((known(message.state, message.state), known(message.reason, message.reason)))
        self._counters.append({known(name, name): value for name, value in message.counters})
        self._ticks.extend(ticks)
        self._tick_counts.append(len(ticks))
        self._ages.extend(ages)
        self._age_counts.append(len(ages))

    def table(self, epoch_ns: int) -> StatusTable:
        times = np.array(self.times, dtype=np.int64)
        assert len(times) == len(self._texts)
        states, reasons = zip(*self._texts, strict=True) if self._texts else ((), ())
        columns = (self._ticks, self._tick_counts, self._ages, self._age_counts)
        ticks, tick_counts, ages, age_counts = (np.array(column, dtype=np.int64) for column in columns)
        if any(later < earlier for earlier, later in pairwise(self.times)):
            times = np.maximum.accumulate(times)  # a clock that went back: keep the order of arrival
        return StatusTable(
            (times - epoch_ns) / 1e9, states, reasons, self._counters, ticks, tick_counts, ages, age_counts
        )


_Sink = _Rows | _StatusRows


class RunData:
    """Collects a run, message by message: `feed` all of them, then ask for the `recording`."""

    def __init__(self, fleet: Fleet, *, mode: str = "run", seed: int | None = None) -> None:
        self.fleet, self.mode = fleet, mode
        self.seed = fleet.fleet.seed if seed is None else seed
        self.foreign = 0
        self.missions: list[Mission] = []
        self.stops: list[Stop] = []
        self._plant = {robot.id: _Rows(PlantState, robot.id, PLANT_COLUMNS) for robot in fleet.robots}
        self._truth = {robot.id: _Rows(PlantState, robot.id, PLANT_COLUMNS) for robot in fleet.robots}
        self._hand = {robot.id: _HandRows(robot.id) for robot in fleet.robots}
        self._wrench = {robot.id: _Rows(Wrench, robot.id, WRENCH_COLUMNS) for robot in fleet.robots}
        self._status = {robot.id: _StatusRows(robot.id) for robot in fleet.robots}
        self._sinks: dict[str, _Sink] = {}
        prefix = fleet.fleet.name
        for robot in self._plant:
            self._sinks |= {
                keys.plant_state(prefix, robot): self._plant[robot],
                keys.plant_truth(prefix, robot): self._truth[robot],
                keys.hand(prefix, robot): self._hand[robot],
                keys.wrench(prefix, robot): self._wrench[robot],
                keys.status(prefix, robot): self._status[robot],
            }
        self._mission_key, self._stop_key = keys.mission(prefix), keys.stop(prefix)

    def feed(self, received_ns: int, key: str, message: Message) -> None:
        """Take one message that was received on `key` at `received_ns` (wall clock or virtual time)."""
        sink = self._sinks.get(key)
        if abs(message.time_ns - received_ns) > CLOCK_TOLERANCE_NS:
            self.foreign += 1
        elif sink is not None and type(message) is sink.kind and message[0] == sink.robot:
            sink.append(message)
        elif type(message) is Mission and key == self._mission_key:
            self.missions.append(message)
        elif type(message) is Stop and key == self._stop_key:
            self.stops.append(message)
        else:
            self.foreign += 1

    def recording(
        self,
        *,
        reasons: Sequence[str] = (),
        interrupted: bool = False,
        warnings: Sequence[str] = (),
        fleet_toml: str | None = None,
    ) -> Recording:
        """The run as it stands; what is fed later does not change it."""
        mission = max(self.missions, key=lambda mission: mission.version) if self.missions else None
        epoch_ns = mission.epoch_ns if mission else self._first_ns()
        robots = {
            robot: RobotData(
                robot,
                self._plant[robot].table(epoch_ns),
                self._truth[robot].table(epoch_ns),
                self._hand[robot].table(epoch_ns),
                self._hand[robot].multipliers(epoch_ns),
                self._wrench[robot].table(epoch_ns),
                self._status[robot].table(epoch_ns),
            )
            for robot in self._plant
        }
        return Recording(
            self.fleet,
            robots,
            tuple(self.missions),
            tuple(self.stops),
            mission.epoch_ns if mission else None,
            self.mode,
            self.seed,
            tuple(reasons),
            interrupted,
            self.foreign,
            tuple(warnings),
            fleet_toml,
        )

    def _first_ns(self) -> int:
        return min((rows.times[0] for rows in self._plant.values() if rows.times), default=0)
