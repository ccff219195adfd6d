"""handfast.deploy.check.own_plant: a plant of others is made and asked once before anything drives."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from handfast.agent.common import plugins
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.analysis import patience
from handfast.deploy.check import own_plant
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.own_plant import check_own_plants
from handfast.deploy.console.data_files import FLEETS
from handfast.plant.backend import Command, Plant, Reading, Setup


class Good(Plant):
    def step(self, now_ns: int, command: Command | None) -> Reading:
        return Reading(now_ns, Pose(*self.setup.start, 0.0, 0.0), 0.0, 0.0)


class Slow(Good):
    def step(self, now_ns: int, command: Command | None) -> Reading:
        time.sleep(0.011)
        return super().step(now_ns, command)


class Hangs(Good):
    def step(self, now_ns: int, command: Command | None) -> Reading:
        time.sleep(0.3)
        return super().step(now_ns, command)


class WithoutStep(Plant):
    pass


class Late(Good):
    def step(self, now_ns: int, command: Command | None) -> Reading:
        return super().step(now_ns, command) if command is None else 1 / 0  # type: ignore[return-value]


class Heavy(Good):
    def __init__(self, setup: Setup) -> None:
        raise MemoryError("too heavy")


class Before(Good):
    def step(self, now_ns: int, command: Command | None) -> Reading:
        return super().step(now_ns, command)._replace(time_ns=-5)


class Touched(Good):
    vehicle = True

    def __init__(self, setup: Setup) -> None:
        raise AssertionError("it was touched")


@pytest.fixture(autouse=True)
def _known() -> Iterator[None]:
    for plugin in (Good, Slow, Late, Heavy, Touched, Hangs, WithoutStep, Before):
        plugins.register(plugin.__name__, plugin)
    yield
    plugins._registered.clear()


def found(name: str) -> list[Finding]:
    return list(check_own_plants(load_fleet(FLEETS / "delta.toml", [f"robot_defaults.plant={name}"])))


def test_what_is_said_of_each() -> None:
    assert found("unicycle") == []
    assert [(f.level, f.place) for f in found("Good")] == [("info", "robot[1].plant")]
    assert "plant Good cannot be predicted" in found("Good")[0].message
    assert [f.level for f in found("Slow")] == ["warning", "info"]
    assert "plant Slow: a step takes " in found("Slow")[0].message
    late, _ = found("Late")
    assert late.message.startswith(
        "plant Late: step failed with ZeroDivisionError: division by zero (test_own"
    )
    (heavy,) = found("Heavy")
    assert (heavy.level, "plant Heavy: cannot be made: MemoryError: too heavy" in heavy.message) == (
        "error",
        True,
    )
    before, _ = found("Before")
    assert "whose time_ns is -5, not a whole number" in before.message
    assert found("Touched") == []
    (without,) = found("WithoutStep")
    assert (without.level, without.message) == (
        "error",
        "plant WithoutStep: it has no method step(self, now_ns, command)",
    )


def test_one_that_never_returns_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "ANSWER_S", 0.05)
    (finding,) = found("Hangs")
    assert (finding.level, finding.message) == (
        "error",
        "plant Hangs: it did not return within 0.05 s, where its robot starts",
    )


def test_no_further_robot_is_asked_after_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = load_fleet(FLEETS / "delta.toml", ["robot_defaults.plant=Good", "robot.2.plant=Late"])
    assert [f.level for f in check_own_plants(fleet)] == ["info", "error", "info"]
    late = load_fleet(FLEETS / "delta.toml", ["robot_defaults.plant=Good"])
    monkeypatch.setattr(own_plant, "TIMED_S", 0.0)
    with monkeypatch.context() as patched:
        patched.setattr(own_plant, "_looked_at", lambda fleet, robot: iter([("info", str(robot))]))
        assert [f.message for f in check_own_plants(late)] == ["1"]


def test_check_says_it() -> None:
    fleet = load_fleet(FLEETS / "delta.toml", ["robot.3.plant=Late"])
    assert [f.place for f in check(fleet) if f.level == "error"] == ["robot[3].plant"]
