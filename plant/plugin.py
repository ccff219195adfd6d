"""Drives a body that is a plugin, and says in one line what its class does wrong.

A body that has failed is unhealthy from then on, so its robot is in fault, and is only ever asked to brake.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Any, Final, TypeVar

from agent.common import random_streams
from agent.common.plugins import PluginError, blame, number
from agent.common.time import NS_PER_S
from agent.common.wording import show
from agent.control.hand import Pose
from agent.fleet import plants
from agent.fleet.model import Fleet
from agent.messages.types import FLOAT_MAX, LEVELS
from plant.backend import Begin, Check, Command, Plant, PlantBackend, Reading, Setup

T = TypeVar("T")

BLOCKING: Final = LEVELS[2]
LATE_STEPS: Final = 20
"""So many steps one after another make a body slow: a single one may be the machine's doing."""


class PluginBody(PlantBackend):
    """The body `plant`, an instance of the class `name`.

    Args:
        begin: where it is until its first step, at rest.
        period_ns: time between two steps.
        say: takes what goes wrong, once each.
        clock: ns of any clock: what the time of a step is measured with.

    Attributes:
        failed: what its class did wrong, "" for nothing.
    """

    def __init__(
        self,
        name: str,
        plant: Plant,
        begin: Pose,
        period_ns: int,
        say: Callable[[str], None],
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self._name, self._plant, self._period_ns, self._say, self._clock = name, plant, period_ns, say, clock
        self._pose = begin
        self.failed = ""
        self._late, self._slow = 0, ""
        self._ready = (Check("plant", "ok", "it is there"),) if plant.vehicle else ()

    @property
    def pose(self) -> Pose:
        """Where it was (W) at the last step."""
        return self._pose

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        begun_ns = self._clock()
        try:
            reading = _plain(self._plant.step(now_ns, None if self.failed else command))
        except (Exception, SystemExit) as error:
            is_ours = isinstance(error, _NoReadingError)
            self._fail(f"step {error if is_ours else f'failed with {blame(error, type(self._plant))}'}")
            pose = self._pose._replace(speed=0.0, yaw_rate=0.0)  # it is where it was seen last
            return Reading(now_ns, pose, 0.0, 0.0, False, self.failed)
        self._pose = reading.pose
        if self.failed:
            return reading._replace(healthy=False, note=self.failed)
        self._time(self._clock() - begun_ns)
        return reading._replace(note=self._slow) if self._slow and not reading.note else reading

    def _asked(self, what: str, method: Callable[..., T], *arguments: object) -> T | None:
        """What a method returns, None where it fails."""
        try:
            return method(*arguments)
        except (Exception, SystemExit) as error:
            self._fail(f"{what} failed with {blame(error, type(self._plant))}")
            return None

    def _fail(self, wrong: str) -> None:
        if not self.failed:
            self.failed = f"{self._name}: {wrong}"
            self._say(self.failed)

    def _time(self, took_ns: int) -> None:
        """Notes that steps take longer than there is time for."""
        self._late = self._late + 1 if took_ns > self._period_ns else 0
        if self._late == LATE_STEPS and not self._slow:
            self._slow = (
                f"{self._name}: step is too slow: {LATE_STEPS} times more than the period of "
                f"{self._period_ns / 1e6:g} ms, {took_ns / 1e6:.0f} ms the last time; its ticks are overrun"
            )
            self._say(self._slow)

    def clear_to_drive(self) -> None:
        """See `PlantBackend.clear_to_drive`."""
        self._asked("clear_to_drive", self._plant.clear_to_drive)

    def checks(self, now_ns: int) -> Sequence[Check]:
        """See `PlantBackend.checks`."""
        found = self._asked("checks", self._plant.checks, now_ns)
        if self.failed:
            return (Check("plant", BLOCKING, self.failed),)
        return found or self._ready

    def close(self) -> None:
        """See `PlantBackend.close`."""
        self._asked("close", self._plant.close)


def _plain(reading: Any) -> Reading:
    """What a step returned, its numbers as Python's own; `_NoReadingError` where it is no reading."""
    if not isinstance(reading, Reading):
        what = "not a Reading: Reading(now_ns, Pose(...), force, torque)"
        raise _NoReadingError(f"returned {type(reading).__name__}, {what}")
    pose: object = reading.pose
    if not isinstance(pose, Pose):
        raise _NoReadingError(f"returned a Reading whose pose is {type(pose).__name__}, not a Pose")
    numbers = {**pose._asdict(), "force": reading.force, "torque": reading.torque}
    for name, value in numbers.items():
        numbers[name] = number(value)
        if not abs(numbers[name]) <= FLOAT_MAX:
            limit = f", which may be {FLOAT_MAX:g} at most" if abs(numbers[name]) < inf else ""
            raise _NoReadingError(f"returned a Reading whose {name} is {show(value)}{limit}")
    stamp: Any = reading.time_ns
    note: Any = reading.note
    if not isinstance(stamp, int) or not isinstance(note, str):
        raise _NoReadingError("returned a Reading whose time_ns is no whole number, or whose note is no text")
    *five, force, torque = numbers.values()
    return reading._replace(pose=Pose(*five), force=force, torque=torque)


class _NoReadingError(Exception):
    """A step returned something else than a reading; the text says what."""


def begin(fleet: Fleet, robot: int, how: Begin) -> PluginBody:
    """The body of a robot whose plant is a plugin; see `agent.fleet.plants.Kind.body`.

    Raises:
        agent.common.plugins.PluginError: its class cannot be used, or fails while it is made.
    """
    reference = fleet.robot(robot).plant
    return _made(reference, plants.load(reference), fleet, robot, how)


def begin_virtual(fleet: Fleet, robot: int, how: Begin) -> PluginBody:
    """As `begin`, of what stands for it in virtual time; see `agent.fleet.plants.Kind.virtual`."""
    reference = fleet.robot(robot).plant
    plugin = plants.load(reference)
    return _made(reference, plugin.simulated or plugin, fleet, robot, how)


def _made(reference: str, plugin: type[Plant], fleet: Fleet, robot: int, how: Begin) -> PluginBody:
    row = fleet.robot(robot)
    start = how.at or (row.x_m, row.y_m, row.heading_rad)
    settings = None if row.kind.section is None else row.section(row.kind.section.hint)
    if plugin.step is Plant.step:
        raise PluginError(f"plant {reference}: it has no method step(self, now_ns, command)")
    seed = random_streams.stream(fleet.fleet.seed, "plugin", robot)
    period_s, timeout_s = fleet.period_ns / NS_PER_S, fleet.control.wrench_timeout_s
    try:
        plant = plugin(Setup(row, settings, start, period_s, timeout_s, seed, how.look))
    except (Exception, SystemExit) as error:
        why = f"cannot be made: {blame(error, plugin)}"
        raise PluginError(f"plant {reference}: {why}; __init__ takes self and one Setup") from None
    return PluginBody(f"plant {reference}", plant, Pose(*start, 0.0, 0.0), fleet.period_ns, how.log)
