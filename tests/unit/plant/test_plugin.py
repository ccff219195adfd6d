"""handfast.plant.plugin: a body of others drives, and what its class does wrong is one line."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf, nan
from typing import Any

import pytest

from handfast.agent.common import plugins
from handfast.agent.common.plugins import PluginError
from handfast.agent.common.settings import setting
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.data_files import FLEETS
from handfast.plant.backend import Begin, Check, Command, Plant, Reading, Setup
from handfast.plant.plugin import LATE_STEPS, PluginBody, begin, begin_virtual

DRIVE = Command(1.0, 0.0)


@dataclass(frozen=True)
class Ground:
    slip: float = setting(0.1, "Slip.")


class Good(Plant):
    section = "ground"
    Settings = Ground

    def step(self, now_ns: int, command: Command | None) -> Reading:
        self.asked = command
        return Reading(now_ns, Pose(*self.setup.start, 0.5, 0.0), 1.0, 0.0)


class Real(Good):
    section = None
    Settings = None
    vehicle = True
    simulated = Good

    def checks(self, now_ns: int) -> list[Check]:
        return [] if now_ns < 100 else [Check("radio", "warning", "weak")]


class Radio(Good):
    section = None
    Settings = None

    def __init__(self, setup: Setup) -> None:
        raise OSError("no radio")


class Old(Good):
    section = None
    Settings = None

    def __init__(self, robot: int, start: object) -> None: ...


class Table(Good):
    section = None
    Settings = None

    def __init__(self, setup: Setup) -> None:
        raise TypeError("no number")


class Nothing(Good):
    section = None
    Settings = None

    def __new__(cls, *_: object) -> Any:
        return 5


class Number(Real):
    simulated = 5  # type: ignore[assignment]


class Text(Real):
    simulated = "bp:Nope"  # type: ignore[assignment]


class Other(Real):
    simulated = Ground  # type: ignore[assignment]


@pytest.fixture(autouse=True)
def _known() -> Iterator[None]:
    for plugin in (Good, Real, Radio, Old, Table, Nothing, Number, Text, Other):
        plugins.register(plugin.__name__, plugin)
    yield
    plugins._registered.clear()


def fleet(name: str, *overrides: str) -> Fleet:
    return load_fleet(FLEETS / "pair.toml", [f"robot.1.plant={name}", *overrides])


def body(step: Callable[..., Any], clock: Callable[[], int] = lambda: 0) -> tuple[PluginBody, list[str]]:
    """A body whose class's step is this, and what was said of it."""
    made = type("Drag", (Plant,), {"step": step, "__module__": __name__})
    setup = Setup(load_fleet(FLEETS / "pair.toml").robot(1), None, (1.0, 2.0, 3.0), 0.02, 0.2, 1)
    said: list[str] = []
    return PluginBody(
        "Drag", made(setup), Pose(1.0, 2.0, 3.0, 0.0, 0.0), 20_000_000, said.append, clock
    ), said


def test_it_is_made_with_all_that_it_needs() -> None:
    made = fleet("Good", "robot.1.ground.slip=0.3", "fleet.seed=5")
    setups = [begin(made, 1, Begin(0))._plant.setup, begin(made, 1, Begin(0, (4.0, 5.0, 6.0)))._plant.setup]
    assert setups[0].settings == Ground(0.3)
    assert setups[0].robot == made.robot(1)
    assert setups[0].start == (made.robot(1).x_m, made.robot(1).y_m, made.robot(1).heading_rad)
    assert setups[1].start == (4.0, 5.0, 6.0)
    assert (setups[0].period_s, setups[0].timeout_s) == (0.02, 0.2)
    assert setups[0].seed != begin(fleet("Good"), 1, Begin(0))._plant.setup.seed


def test_a_good_one_is_left_alone() -> None:
    good = begin(fleet("Good"), 1, Begin(0))
    reading = good.step(7, DRIVE)
    assert (reading.healthy, reading.note, reading.time_ns) == (True, "", 7)
    assert good.pose == reading.pose
    assert list(good.checks(7)) == []
    good.clear_to_drive()
    good.close()


def test_a_vehicle_has_checks_and_a_stand_in() -> None:
    made = fleet("Real")
    assert made.robot(1).kind.vehicle
    real = begin(made, 1, Begin(0))
    assert [check.level for check in real.checks(0)] == ["ok"]
    assert [check.name for check in real.checks(100)] == ["radio"]
    assert type(begin_virtual(made, 1, Begin(0))._plant) is Good


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            "Radio",
            r"^plant Radio: cannot be made: OSError: no radio \(test_plugin.py:\d+\)$",
        ),
        (
            "Old",
            r"^plant Old: cannot be made: TypeError: .*missing 1 required positional argument: 'start'"
            r"; write def __init__\(self, setup\)$",
        ),
        ("Table", r"^plant Table: cannot be made: TypeError: no number \(test_plugin.py:\d+\)$"),
        (
            "Nothing",
            "^plant Nothing: cannot be made: its __new__ must make an instance of the class, not int",
        ),
    ],
)
def test_one_that_cannot_be_made(name: str, says: str) -> None:
    with pytest.raises(PluginError, match=says):
        begin(fleet(name), 1, Begin(0))


def _cancelled(*_: object) -> Reading:
    raise asyncio.CancelledError("away")


def _raises(*_: object) -> Reading:
    raise RuntimeError("no wheel\nat all")


def _stamped(stamp: Callable[[int], Any]) -> Callable[..., Reading]:
    return lambda self, now, command: Reading(stamp(now), Pose(0, 0, 0, 0, 0), 0, 0)


def _said(**rest: Any) -> Callable[..., Reading]:
    return lambda self, now, command: Reading(now, Pose(0, 0, 0, 0, 0), 0, 0, **rest)


def _nothing() -> None:
    """Takes no arguments."""


@pytest.mark.parametrize(
    ("step", "says"),
    [
        (_raises, r"^Drag: step failed with RuntimeError: no wheel \(test_plugin.py:\d+\)$"),
        (
            _nothing,
            r"^Drag: step failed with TypeError: .*takes 0 positional arguments but 3 were given; write def "
            r"step\(self, now_ns, command\)$",
        ),
        (_cancelled, r"^Drag: step failed with CancelledError: away \(test_plugin.py:\d+\)$"),
        (lambda self, now, command: None, "^Drag: step returned NoneType, not a Reading: Reading"),
        (
            lambda self, now, command: Reading(now, Pose("1", 0, 0, 0, 0), 0, 0),
            'whose x is "1", not a finite number$',
        ),
        (
            lambda self, now, command: Reading(now, Pose(0, 0, 0, 0, 0), True, 0),
            "whose force is true, not a finite number$",
        ),
        (
            lambda self, now, command: Reading(now, Pose(0, 0, 0, 0, 0), 1e308, 0),
            r"which may be 1e\+15 at most$",
        ),
        (lambda self, now, command: (now, 1, 2), "^Drag: step returned tuple, not a Reading: Reading"),
        (
            lambda self, now, command: Reading(now, Pose(0, nan, 0, 0, 0), 0, 0),
            "Reading whose y is nan, not a finite number$",
        ),
        (
            lambda self, now, command: Reading(now, Pose(0, 0, 0, 0, 0), inf, 0),
            "Reading whose force is inf, not a finite number$",
        ),
        (
            lambda self, now, command: Reading(now, Pose(0, 0, "a", 0, 0), 0, 0),
            'Reading whose heading is "a", not a finite number$',
        ),
        (lambda self, now, command: Reading(now, (0, 0, 0, 0, 0), 0, 0), "pose is tuple, not a Pose$"),
        (_stamped(lambda now: 0.5), r"time_ns is 0.5, not a whole number from 0 to now_ns, \d+$"),
        (_stamped(lambda now: True), "time_ns is true, not a whole number"),
        (_stamped(lambda now: 10**40), "time_ns is 1000+, not a whole number from 0 to now_ns"),
        (_stamped(lambda now: now + 10**12), r"time_ns is \d+, not a whole number from 0 to now_ns"),
        (_stamped(lambda now: -2 * NS_PER_S), "time_ns is -2000000000, not a whole number from 0 to now_ns"),
        (_said(note=5), "whose note is 5, not a text$"),
        (_said(obeying="no"), 'whose obeying is "no", not True or False$'),
        (_said(healthy=1), "whose healthy is 1, not True or False$"),
        (_said(asked=0.5), "whose asked is 0.5, not None, nor a tuple of a speed and a yaw rate$"),
        (_said(asked=(0.5, nan)), r"whose asked\[1\] is nan, not a finite number$"),
    ],
)
def test_a_step_that_fails(step: Callable[..., Any], says: str) -> None:
    made, said = body(step)
    for now_ns in range(3):
        reading = made.step(now_ns, DRIVE)
        assert (reading.healthy, reading.time_ns) == (False, now_ns)
        assert reading.pose == (1.0, 2.0, 3.0, 0.0, 0.0), "where it was last"
    assert said == [reading.note], "said once"
    assert re.search(says, reading.note), reading.note
    assert made.checks(0)[0].level == "blocking"


@pytest.mark.parametrize(
    ("checks", "says"),
    [
        (5, "^Drag: checks returned 5, not a list of Check"),
        (None, "^Drag: checks returned None, not a list of Check"),
        ([1], "^Drag: checks returned a list with 1, not a list of Check"),
        ([Check("radio", "bad", "weak")], 'level one of "ok", "warning", "blocking"$'),
        ([Check("radio", "ok", 5)], "^Drag: checks returned a list with .*5.*, not a list of Check"),  # type: ignore[arg-type]
    ],
)
def test_checks_that_are_none(checks: Any, says: str) -> None:
    made, said = body(_said())
    made._plant.checks = lambda now_ns: checks  # type: ignore[method-assign]
    assert [check.level for check in made.checks(0)] == ["blocking"]
    assert re.search(says, made.failed), made.failed
    assert said == [made.failed]


def test_after_a_failure_it_is_only_asked_to_brake() -> None:
    asked: list[Command | None] = []

    def step(self: Plant, now_ns: int, command: Command | None) -> Reading:
        asked.append(command)
        if now_ns == 1:
            raise ValueError("once")
        return Reading(now_ns, Pose(now_ns, 0, 0, 0.1, 0), 0, 0)

    made, said = body(step)
    readings = [made.step(now_ns, DRIVE) for now_ns in range(4)]
    assert asked == [DRIVE, DRIVE, None, None]
    assert [reading.healthy for reading in readings] == [True, False, False, False]
    assert [reading.pose.x for reading in readings] == [0, 0, 2, 3], "it is seen again"
    assert len(said) == 1


def test_steps_that_are_too_slow_are_named() -> None:
    clock = iter(range(0, 10**12, 25_000_000))
    made, said = body(lambda self, now, command: Reading(now, Pose(0, 0, 0, 0, 0), 0, 0), lambda: next(clock))
    readings = [made.step(now_ns, DRIVE) for now_ns in range(LATE_STEPS + 5)]
    assert said == [
        "Drag: step is too slow: 20 times more than the period of 20 ms, 25 ms the last time; its ticks are "
        "overrun"
    ]
    assert [reading.note for reading in readings[-6:]] == said * 6
    assert all(reading.healthy for reading in readings)
    assert not any(reading.note for reading in readings[: LATE_STEPS - 1])
