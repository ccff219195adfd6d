"""The end of many processes: who is waited for, and for how long."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.deploy.processes import child
from handfast.deploy.processes.child import END_LOOK_S, END_TIMES, end_all


class Clock:
    now_s = 100.0


class Fake:
    """A process that ends so long after it was asked to."""

    def __init__(self, clock: Clock, ends_after_s: float) -> None:
        self._clock, self._ends_after_s = clock, ends_after_s
        self._ends_s = float("inf")
        self.killed = False

    def terminate(self) -> None:
        self._ends_s = self._clock.now_s + self._ends_after_s

    def kill(self) -> None:
        self.killed = True
        self._ends_s = self._clock.now_s

    def wait(self, timeout_s: float) -> bool:
        self._clock.now_s = max(self._clock.now_s, min(self._clock.now_s + timeout_s, self._ends_s))
        return self._clock.now_s >= self._ends_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(child.time, "monotonic", lambda: made.now_s)
    return made


def ended(clock: Clock, *after_s: float) -> tuple[list[bool], float]:
    """Who was killed, and how long it took, with 2 s for each next one."""
    made: list[Any] = [Fake(clock, each) for each in after_s]
    began_s = clock.now_s
    stubborn = end_all(made, 2.0)
    assert [each.killed for each in made] == [each in stubborn for each in made]
    return [each.killed for each in made], clock.now_s - began_s


def test_all_are_asked_and_nobody_waits_for_more_than_the_last(clock: Clock) -> None:
    killed, took_s = ended(clock, 0.3, 0.0, 0.7)
    assert not any(killed)
    assert took_s == pytest.approx(0.7, abs=END_LOOK_S)


def test_one_that_is_frozen_is_killed(clock: Clock) -> None:
    killed, took_s = ended(clock, 0.3, float("inf"), 0.1)
    assert killed == [False, True, False]
    assert took_s == pytest.approx(2.3, abs=2 * END_LOOK_S)


def test_where_they_end_one_after_the_other_none_is_killed_while_they_do(clock: Clock) -> None:
    """As on a machine that has little time for them."""
    killed, took_s = ended(clock, *(1.5 * k for k in range(1, 6)))
    assert not any(killed)
    assert took_s == pytest.approx(7.5, abs=END_LOOK_S)


def test_but_not_for_ever(clock: Clock) -> None:
    killed, took_s = ended(clock, *(1.5 * k for k in range(1, 60)))
    assert any(killed)
    assert took_s == pytest.approx(2.0 * END_TIMES, abs=2 * END_LOOK_S)


def test_nothing_is_nothing_to_wait_for(clock: Clock) -> None:
    assert ended(clock) == ([], 0.0)
