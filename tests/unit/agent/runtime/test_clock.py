"""The machine's clock, carried on from one reading."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.runtime import loop
from handfast.agent.runtime.loop import RealClock

pytestmark = pytest.mark.patches

EPOCH = 1_700_000_000 * NS_PER_S
MS = 1_000_000


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
    monkeypatch.setattr(loop, "time", made)
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


def test_two_processes_between_which_the_clock_was_set_differ_by_as_much(machine: Machine):
    before = RealClock().machine
    machine.wall += 3600 * NS_PER_S
    after = RealClock().machine
    assert after.boot == before.boot == loop.boot()
    assert after.offset_ns - before.offset_ns == pytest.approx(3600 * NS_PER_S, abs=100)


def test_another_boot_is_another_clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    names = set()
    for text in ("one", "another"):
        (tmp_path / "boot_id").write_text(text)
        monkeypatch.setattr(loop, "_BOOT_ID", tmp_path / "boot_id")
        names.add(loop.boot())
    monkeypatch.setattr(loop, "_BOOT_ID", tmp_path / "none")
    names.add(loop.boot())  # a system that does not tell: by the host's name
    assert len(names) == 3
