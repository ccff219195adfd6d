"""handfast.deploy.simulate.hangs: a law or a plant that never returns in mid-drive ends as a fault of its
robot."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

import handfast
from handfast import Command, Law, Moment, Plant, Pose, Reading, Setup
from handfast.agent.common import plugins
from handfast.deploy.analysis import patience
from handfast.deploy.simulate import hangs


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
    monkeypatch.setattr(hangs, "_LOOK_S", 0.1)
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
    assert not hangs._is_in_a_call(None)
    seen: list[bool] = []

    def look(_number: int, frame: object) -> None:
        seen.append(hangs._is_in_a_call(frame))  # type: ignore[arg-type]

    before = signal.signal(signal.SIGALRM, look)
    try:
        signal.raise_signal(signal.SIGALRM)
        plugins.attempt(lambda: signal.raise_signal(signal.SIGALRM), lambda error: None)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert seen == [False, True]
