"""Drives a body that is a plugin, and says in one line what its class does wrong.

A body that has failed is unhealthy from then on, so its robot is in fault, and is only ever asked to brake.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Any, Final, TypeVar

from handfast.agent.common import random_streams
from handfast.agent.common.plugins import NoAnswerError, PluginError, attempt, blame, make, number, python
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable, show
from handfast.agent.control.hand import Pose
from handfast.agent.fleet import plants
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import FLOAT_MAX, FUTURE_NS_MAX, LEVELS, TEXT_MAX
from handfast.plant.backend import Begin, Check, Command, Plant, Reading, Setup, VirtualBody

T = TypeVar("T")

BLOCKING: Final = LEVELS[2]
LATE_STEPS: Final = 20
"""So many steps one after another make a body slow: a single one may be the machine's doing."""


class PluginBody(VirtualBody):
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
        self._hangs = False
        self._late, self._slow = 0, ""
        self._ready = (Check("plant", "ok", "it is there"),) if type(plant).vehicle else ()

    @property
    def pose(self) -> Pose:
        """Where it was (W) at the last step."""
        return self._pose

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        begun_ns = self._clock()
        asked = None if self.failed else command
        reading = self._asked(
            "step", lambda: _reading(self._plant.step(now_ns, asked), now_ns), "step(self, now_ns, command)"
        )
        if reading is None:
            pose = self._pose._replace(speed=0.0, yaw_rate=0.0)  # it is where it was seen last
            return Reading(now_ns, pose, 0.0, 0.0, False, self.failed)
        self._pose = reading.pose
        if self.failed:
            return reading._replace(healthy=False, note=self.failed)
        self._time(self._clock() - begun_ns)
        return reading._replace(note=self._slow) if self._slow and not reading.note else reading

    def _asked(self, what: str, call: Callable[[], T], signature: str = "") -> T | None:
        """What a call of its method `what` gives, None where it fails; `signature` as in `blame`."""
        if self._hangs:
            return None

        def failed(error: BaseException) -> None:
            self._hangs = isinstance(error, NoAnswerError)
            if isinstance(error, _WrongError):
                self._fail(f"{what} returned {error}")
            else:
                self._fail(f"{what} failed with {blame(error, type(self._plant), signature)}")

        return attempt(call, failed)

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
        self._asked("clear_to_drive", lambda: self._plant.clear_to_drive(), "clear_to_drive(self)")

    def checks(self, now_ns: int) -> Sequence[Check]:
        """See `PlantBackend.checks`."""
        found = self._asked("checks", lambda: _checks(self._plant.checks(now_ns)), "checks(self, now_ns)")
        if self.failed:
            return (Check("plant", BLOCKING, self.failed),)
        return found or self._ready

    def close(self) -> None:
        """See `PlantBackend.close`."""
        self._asked("close", lambda: self._plant.close(), "close(self)")


def _reading(given: Any, now_ns: int) -> Reading:
    """What a step returned, its values as Python's own; `_WrongError` where it is no reading."""
    if not isinstance(given, Reading):
        what = "not a Reading: Reading(now_ns, Pose(...), force, torque)"
        raise _WrongError(f"{type(given).__name__}, {what}")
    time_ns, pose, force, torque, healthy, note, obeying, asked = given
    if not isinstance(pose, Pose):
        raise _wrong("pose", type(pose).__name__, "not a Pose")
    numbers = {**pose._asdict(), "force": force, "torque": torque}
    for name, value in numbers.items():
        numbers[name] = _finite(name, value)
    stamp = python(time_ns)
    # Virtual time begins at 0, and what is seen late is from before; a clock that the step reads is ahead.
    earliest, latest = min(0, now_ns - NS_PER_S), now_ns + FUTURE_NS_MAX
    if isinstance(stamp, bool) or not isinstance(stamp, int) or not earliest <= stamp <= latest:
        raise _wrong("time_ns", show(time_ns), f"not a whole number from 0 to now_ns, {now_ns}")
    truths = {"healthy": python(healthy), "obeying": python(obeying)}
    for name, value in truths.items():
        if not isinstance(value, bool):
            raise _wrong(name, show(value), "not True or False")
    if not isinstance(note, str):
        raise _wrong("note", show(note), "not a text")
    *five, force, torque = numbers.values()
    text = printable(note[: TEXT_MAX + 1])  # longer ones are cut in messages, and marked
    return Reading(max(0, stamp), Pose(*five), force, torque, note=text, asked=_setpoint(asked), **truths)


def _finite(name: str, value: Any) -> float:
    found = number(value)
    if not abs(found) <= FLOAT_MAX:
        limit = f"which may be {FLOAT_MAX:g} at most"
        raise _wrong(name, show(value), limit if abs(found) < inf else "not a finite number")
    return found


def _setpoint(given: Any) -> tuple[float, float] | None:
    """`Reading.asked`, as Python's own."""
    if given is None:
        return None
    if not isinstance(given, tuple) or len(given) != 2:
        raise _wrong("asked", show(given), "not None, nor a tuple of a speed and a yaw rate")
    return _finite("asked[0]", given[0]), _finite("asked[1]", given[1])


def _checks(given: Any) -> Sequence[Check]:
    """What `checks` returned, in texts that a message holds; `_WrongError` where it is something else."""
    right = 'a list of Check(name, level, found, advice): texts, level one of "ok", "warning", "blocking"'
    if not isinstance(given, list | tuple):
        raise _WrongError(f"{show(given)}, not {right}")
    for check in given:
        texts = isinstance(check, Check) and all(isinstance(text, str) for text in check)
        if not texts or check.level not in LEVELS:
            raise _WrongError(f"a list with {show(check)}, not {right}")
    return [Check(*map(printable, check)) for check in given]


class _WrongError(Exception):
    """A method of a plant returned what it must not; the text says what, and what would be right."""


def _wrong(field: str, value: str, right: str) -> _WrongError:
    return _WrongError(f"a Reading whose {field} is {value}, {right}")


def begin(fleet: Fleet, robot: int, how: Begin) -> PluginBody:
    """The body of a robot whose plant is a plugin; see `agent.fleet.plants.Kind.body`.

    Raises:
        handfast.agent.common.plugins.PluginError: its class cannot be used, or fails while it is made.
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
    setup = Setup(row, settings, start, period_s, timeout_s, seed, how.look)

    def failure(wrong: str) -> PluginError:
        return PluginError(f"plant {reference}: cannot be made: {wrong}")

    plant = make(plugin, "__init__(self, setup)", failure, setup)
    return PluginBody(f"plant {reference}", plant, Pose(*start, 0.0, 0.0), fleet.period_ns, how.log)
