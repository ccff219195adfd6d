"""Clocks: what one shows that is wrong on purpose, and the machine's, carried on from one reading."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.common import clock
from agent.common.time import NS_PER_S, LocalTime
from agent.runtime.clock import RealClock

EPOCH = 1_700_000_000 * NS_PER_S
MS = 1_000_000


# ---------------------------------------------------------------------- what a wrong clock shows


def test_a_right_clock_shows_the_time():
    for local in (LocalTime(), LocalTime(epoch_ns=EPOCH)):
        assert local.local_ns(EPOCH + 5) == local.true_ns(EPOCH + 5) == EPOCH + 5


def test_a_skewed_clock_is_ahead_by_as_much_all_the_time():
    local = LocalTime(-300 * MS)
    for true_ns in (NS_PER_S, EPOCH):
        assert local.local_ns(true_ns) == true_ns - 300 * MS
        assert local.true_ns(true_ns - 300 * MS) == true_ns


def test_drift_counts_from_the_epoch():
    local = LocalTime(100 * MS, 50e-6, EPOCH)
    for since_s, ahead_ns in ((-10, 0), (0, 0), (1, 50_000), (100, 5 * MS)):
        true_ns = EPOCH + since_s * NS_PER_S
        assert local.local_ns(true_ns) == true_ns + 100 * MS + ahead_ns
    slow = LocalTime(0, -0.01, EPOCH)
    assert slow.local_ns(EPOCH + 10 * NS_PER_S) == EPOCH + 9_900_000_000


def test_nothing_drifts_while_the_epoch_is_not_known():
    assert LocalTime(7, 0.01).local_ns(EPOCH) == EPOCH + 7


@given(
    skew_ns=st.integers(-3600 * NS_PER_S, 3600 * NS_PER_S),
    drift=st.floats(-0.01, 0.01),
    since_ns=st.integers(-3600 * NS_PER_S, 10 * 86_400 * NS_PER_S),
)
def test_true_time_is_the_first_at_which_the_clock_shows_it(skew_ns: int, drift: float, since_ns: int):
    local = LocalTime(skew_ns, drift, EPOCH)
    shown_ns = EPOCH + since_ns
    true_ns = local.true_ns(shown_ns)
    assert local.local_ns(true_ns - 1) < shown_ns <= local.local_ns(true_ns)


@given(drift=st.floats(-0.01, 0.01), since_ns=st.integers(-10, 10 * 86_400 * NS_PER_S))
def test_a_drifting_clock_never_goes_back(drift: float, since_ns: int):
    local = LocalTime(0, drift, EPOCH)
    assert local.local_ns(EPOCH + since_ns + 1) >= local.local_ns(EPOCH + since_ns)


# ---------------------------------------------------------------------- the machine's


class Machine:
    """Stands for the module `time`; sleeping moves its clocks, and reading them costs 40 ns."""

    def __init__(self) -> None:
        self.monotonic, self.wall = 5_000, EPOCH
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        self.monotonic, self.wall = self.monotonic + 20, self.wall + 20
        return self.monotonic

    def time_ns(self) -> int:
        self.monotonic, self.wall = self.monotonic + 20, self.wall + 20
        return self.wall

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.pass_ns(round(seconds * NS_PER_S))

    def pass_ns(self, time_ns: int) -> None:
        self.monotonic, self.wall = self.monotonic + time_ns, self.wall + time_ns


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    made = Machine()
    monkeypatch.setattr(clock, "time", made)
    return made


def test_a_wall_clock_that_is_set_moves_nobody(machine: Machine):
    real = RealClock()
    before = real.now_ns()
    assert before == pytest.approx(machine.wall, abs=100)
    machine.wall += 3600 * NS_PER_S
    machine.pass_ns(NS_PER_S)
    assert real.now_ns() - before == pytest.approx(NS_PER_S, abs=100)


def test_sleeps_until_the_time_and_not_when_it_is_past(machine: Machine):
    real = RealClock()
    due = real.now_ns() + 20 * MS
    real.sleep_until(due)
    assert real.now_ns() == pytest.approx(due, abs=200)
    real.sleep_until(due - MS)
    assert len(machine.slept) == 1


def test_a_clock_that_is_wrong_on_purpose(machine: Machine):
    real = RealClock(100 * MS, 0.01)
    assert real.now_ns() == pytest.approx(machine.wall + 100 * MS, abs=100)
    epoch_ns = machine.wall + NS_PER_S
    real.begin(epoch_ns)
    real.begin(epoch_ns - 60 * NS_PER_S)  # only the first counts
    machine.pass_ns(NS_PER_S)
    assert real.now_ns() == pytest.approx(machine.wall + 100 * MS, abs=200)
    machine.pass_ns(100 * NS_PER_S)
    assert real.now_ns() == pytest.approx(machine.wall + 1100 * MS, abs=200)


def test_sleeps_by_its_own_clock(machine: Machine):
    real = RealClock(100 * MS, 0.01)
    real.begin(machine.wall)
    machine.pass_ns(100 * NS_PER_S)
    due = real.now_ns() + 1010 * MS
    real.sleep_until(due)
    assert machine.slept == [pytest.approx(1.0, abs=1e-6)]
    assert real.now_ns() == pytest.approx(due, abs=200)
