"""A run in memory, as columns of numbers.

Times are fleet time (s): wall clock minus the mission's epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, wraps
from math import inf
from typing import Final, NamedTuple, TypeVar

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import (
    Beacon,
    Event,
    Faults,
    Mission,
    Resume,
    StatusText,
    Stop,
)
from handfast.deploy.recording.tables import (
    LinkTable,
    StatusTable,
    Table,
)

T = TypeVar("T")

TRUTH_S: Final = 0.5
"""Where no truth was recorded for longer than this, what was measured stands for it."""


@dataclass(frozen=True)
class RobotData:
    """All that one robot sent, over time. `truth` is empty unless its plant's measurements are noisy; in
    virtual time it tells of a vehicle, too, while no bridge does."""

    id: int
    plant: Table
    truth: Table
    hand: Table
    multipliers: Table
    wrench: Table
    status: StatusTable

    @cached_property
    def body(self) -> Table:
        """Where the body was, as well as that is known: the truth where it was recorded, else the
        measurement. Without what its plant itself said is not to be used."""
        told, true = (each.only(each["healthy"] > 0.0) for each in (self.plant, self.truth))
        return true.filled(told, TRUTH_S) if len(true) else told

    @cached_property
    def _turned(self) -> Floats:
        """Headings (k,) rad of `body`, without jumps of a whole turn."""
        turned: Floats = np.unwrap(self.body["heading"])
        return turned

    def heading(self, t: Floats) -> Floats:
        """Headings (k,) rad, counter-clockwise from east, at `t` (k,) s: between poses the shorter way round,
        held before the first and after the last, not wrapped; NaN without any pose."""
        return np.interp(t, self.body.t, self._turned) if len(self.body) else np.full(len(t), np.nan)


class LiveFaults(NamedTuple):
    """One message about live fault rules, and when it was received (ns, wall clock).

    `robot` and `role` are those of the process that says that it holds the rules, 0 and "" where an
    operator sends them. A process says that it holds a set no more by one without rules.
    """

    received_ns: int
    robot: int
    role: str
    message: Faults


class Damage(NamedTuple):
    """A part of a recording's file that could not be read: of what came from `start_s` to `end_s` (fleet
    time) nothing is known; infinite: from its beginning, or to its end."""

    file: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Recording:
    """One run, with all that was recorded of it.

    `robots` has an entry for every robot of the fleet, in the fleet's order.
    """

    fleet: Fleet
    robots: Mapping[int, RobotData]
    missions: Sequence[Mission]
    """Each mission once, as it was first sent."""
    stops: Sequence[Stop]
    """Each stop once, as it was first sent."""
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
    links: LinkTable = field(default_factory=LinkTable.empty)
    """What links did to messages on purpose. Beacons, which go from all to all, are left out."""
    live_faults: Sequence[LiveFaults] = ()
    """Live fault rules as operators sent them, and as processes said that they held them; as they came."""
    events: Sequence[Event] = ()
    """What was done to processes on purpose."""
    resumes: Sequence[Resume] = ()
    """Each resume once, as it was first sent."""
    beacons: Mapping[int, Sequence[Beacon]] = field(default_factory=dict)
    """The last of each robot within the drive."""
    status_texts: Sequence[StatusText] = ()
    """What vehicles said themselves, as it came."""
    damage: Sequence[Damage] = ()
    """What of its file is lost."""

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(self.robots)

    @cached_property
    def planned_s(self) -> float:
        """For how long the fleet was to drive by its mission, s."""
        mission = self.mission
        return mission.duration_ns / 1e9 if mission else self.fleet.fleet.duration_s

    @property
    def mission(self) -> Mission | None:
        """The mission that holds in the end, None without any."""
        return self.held_missions[-1] if self.held_missions else None

    @cached_property
    def held_missions(self) -> Sequence[Mission]:
        """The missions that held one after the other, for one who heard what the recording holds."""
        held: list[Mission] = []
        for mission in self.missions:
            if newer(mission, held[-1] if held else None):
                held.append(mission)
        return held

    def fleet_time_s(self, time_ns: int) -> float:
        """Wall clock (ns) as fleet time."""
        return (time_ns - (self.epoch_ns or 0)) / 1e9

    def halts(self, robot: int) -> list[tuple[float, float]]:
        """Fleet times (start, end) within which a robot had to stand: from a stop to the resume that ends it,
        which has a greater version and is for this robot; inf where none did.

        A stop from before the drive was given holds in the drive only for a robot whose agent says so: one
        that came up after it is not held.
        """
        found = self._halts(robot)
        begun_s = self.begun_s
        if begun_s is None or not found or found[-1][1] <= begun_s or self._knows_of_before(robot, begun_s):
            return found
        # Stops within the drive count all the same.
        return [
            *((start, min(end, begun_s)) for start, end in found if start < begun_s),
            *self._halts(robot, begun_s),
        ]

    @cached_property
    def begun_s(self) -> float | None:
        """Fleet time at which the drive was ordered, None when it was not."""
        times = [mission.time_ns for mission in self.missions if mission.epoch_ns == self.epoch_ns]
        return self.fleet_time_s(min(times)) if times else None

    def _knows_of_before(self, robot: int, begun_s: float) -> bool:
        """Whether a robot's agent said in the drive, before any stop or resume was given there, that it knew
        of the last stop from before."""
        stops = [stop.version for stop in self.stops if self.fleet_time_s(stop.time_ns) < begun_s]
        given = [(order.time_ns, order.version) for order in self.stops]
        given += [(order.time_ns, order.version) for order in self.resumes]
        later = [version for time_ns, version in given if self.fleet_time_s(time_ns) >= begun_s]
        status = self.robots[robot].status
        known = status.order_versions[status.t >= begun_s]
        return bool(((known >= max(stops, default=0)) & (known < min(later, default=inf))).any())

    def _halts(self, robot: int, from_s: float = -inf) -> list[tuple[float, float]]:
        """See `halts`: as the orders from `from_s` on have it."""
        orders: list[tuple[float, Stop | Resume]] = []
        orders += [(self.fleet_time_s(stop.time_ns), stop) for stop in self.stops]
        orders += [(self.fleet_time_s(resume.time_ns), resume) for resume in self.resumes]
        found: list[tuple[float, float]] = []
        stopped = resumed = -1
        since_s: float | None = None
        for t, order in sorted((entry for entry in orders if entry[0] >= from_s), key=lambda entry: entry[0]):
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


def once(compute: Callable[[Recording], T]) -> Callable[[Recording], T]:
    """`compute`, done once for each recording: what it gave is kept with it, as a cached property is."""
    name = f"{compute.__module__}.{compute.__qualname__}"

    @wraps(compute)
    def found(recording: Recording) -> T:
        known = recording.__dict__
        if name not in known:
            known[name] = compute(recording)
        value: T = known[name]
        return value

    return found
