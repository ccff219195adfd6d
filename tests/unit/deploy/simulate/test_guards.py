"""Guards around a drive: a plugin that never returns becomes a fault, and the collector is left as it was."""

from __future__ import annotations

import gc
import signal
import weakref
from collections.abc import Iterator

import pytest

import handfast
from handfast import Command, Law, Moment, Plant, Pose, Reading, Setup
from handfast.agent.common import plugins
from handfast.deploy.analysis import patience
from handfast.deploy.simulate import guards
from handfast.deploy.simulate.guards import OBJECTS, seldom_looked_for


class LoopLaw(Law):
    def acceleration(self, now: Moment) -> tuple[float, float]:
        while self.robot == 2 and now.time > 0.5:
            pass
        return now.navigation


class LoopPlant(Plant):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.steps = 0

    def step(self, now_ns: int, command: Command | None) -> Reading:
        self.steps += 1
        while self.setup.robot.id == 2 and self.steps > 60:
            pass
        return Reading(now_ns, Pose(*self.setup.start, 0.0, 0.0), 0.0, 0.0)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(patience, "ANSWER_S", 0.3)
    monkeypatch.setattr(guards, "_LOOK_S", 0.1)
    yield
    plugins._registered.clear()


def test_a_law_that_hangs_is_a_fault_that_names_it() -> None:
    before = signal.getsignal(signal.SIGALRM)
    recording = handfast.simulate("pair", law=LoopLaw, duration=2, check=False)
    (reason,) = (reason for reason in recording.reasons if "LoopLaw" in reason)
    assert "did not return within 0.3 s (" in reason
    assert recording.times[-1] > 1.9, "the drive went on"
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_plant_that_hangs_is_not_asked_again() -> None:
    recording = handfast.simulate("pair", plant=LoopPlant, duration=2, check=False)
    (reason,) = (reason for reason in recording.reasons if "LoopPlant" in reason)
    assert "did not return within 0.3 s" in reason
    assert recording.robots[2].states.state[-1] != "running"


def test_what_is_slow_and_no_code_of_others_is_left_alone() -> None:
    assert not guards._is_in_a_call(None)
    seen: list[bool] = []

    def look(_number: int, frame: object) -> None:
        seen.append(guards._is_in_a_call(frame))  # type: ignore[arg-type]

    before = signal.signal(signal.SIGALRM, look)
    try:
        signal.raise_signal(signal.SIGALRM)
        plugins.attempt(lambda: signal.raise_signal(signal.SIGALRM), lambda error: None)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert seen == [False, True]


@pytest.fixture(autouse=True)
def _restored() -> Iterator[None]:
    before = gc.get_threshold()
    gc.unfreeze()  # what tests before this one have frozen
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


def test_it_is_as_it_was_afterwards_whatever_happens() -> None:
    def drive() -> None:
        with seldom_looked_for():
            assert gc.get_threshold() == (OBJECTS, 7, 8)
            assert gc.get_freeze_count() > 0
            raise KeyError

    gc.set_threshold(500, 7, 8)
    with pytest.raises(KeyError):
        drive()
    assert gc.get_threshold() == (500, 7, 8)
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("objects", [0, 10 * OBJECTS])
def test_who_has_it_look_less_often_or_never_keeps_that(objects: int) -> None:
    gc.set_threshold(objects, 7, 8)
    with seldom_looked_for():
        assert gc.get_threshold() == (objects, 7, 8)


def test_what_others_have_frozen_stays_so() -> None:
    gc.freeze()
    with seldom_looked_for():
        pass
    assert gc.get_freeze_count() > 0


class _Node:
    """One of those that a drive is made of: they know each other."""

    def __init__(self) -> None:
        self.other = self


def test_what_a_drive_was_made_of_is_gone_when_the_next_begins() -> None:
    """Whoever drives thousands of runs does not grow with each."""
    gc.disable()
    try:
        with seldom_looked_for():
            node = _Node()
            left = weakref.ref(node)
        del node
        assert left() is not None, "nobody has looked"
        with seldom_looked_for():
            assert left() is None
    finally:
        gc.enable()
