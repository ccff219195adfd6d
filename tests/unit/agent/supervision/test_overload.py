"""A loop that cannot keep its rate: what its robot wants, says and goes by."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.node import TOLD_SHARE
from handfast.agent.supervision.overload import CALM_MAX_NS, CALM_NS, HEARD_NS, WINDOW_NS, Overload

PERIOD = NS_PER_S // 50
STEPS = 2
GAP = NS_PER_S // 4


class Loop:
    """Ticks at the period that `Overload` gives, each so late as is asked for."""

    def __init__(
        self, steps: int = STEPS, period_ns: int = PERIOD, gap_ns: int = GAP, standing_ns: int = 0
    ) -> None:
        self.overload = Overload(steps, period_ns, gap_ns, standing_ns)
        self.now = NS_PER_S
        self.levels: list[tuple[float, int]] = []

    def run(self, seconds: float, lateness: Callable[[int], float]) -> None:
        """`lateness` says of a period (ns) by which share of it each tick is late."""
        until = self.now + round(seconds * NS_PER_S)
        overload = self.overload
        while self.now < until:
            self.now += overload.period_ns
            late_ns = round(lateness(overload.period_ns) * overload.period_ns)
            if late_ns * TOLD_SHARE > overload.period_ns:
                overload.late(self.now, late_ns)
            if not overload.idle and overload.look(self.now):
                self.levels.append((self.now / NS_PER_S, overload.level))

    def until_calm(self, within: float) -> None:
        begun = self.now
        while self.overload.level:
            self.run(0.1, in_time)
            assert self.now - begun < within * NS_PER_S


def in_time(_: int) -> float:
    return 0.0


def busy(needs_s: float) -> Callable[[int], float]:
    """A machine on which all that is to be done in a period takes `needs_s`, so much too late as it does."""
    return lambda period_ns: max(0.0, needs_s * NS_PER_S / period_ns - 0.4)


def test_a_loop_in_time_is_never_looked_at() -> None:
    loop = Loop()
    loop.run(5.0, in_time)
    assert loop.overload.idle
    assert not loop.levels
    assert loop.overload.text(loop.now) == ""
    assert loop.overload.counters() == {}


@pytest.mark.parametrize("late", [0.3, 1.0, 30.0])
def test_one_hitch_changes_nothing(late: float) -> None:
    loop = Loop()
    for _ in range(20):
        loop.overload.late(loop.now, round(late * PERIOD))
        loop.run(2.0, in_time)
    assert not loop.levels
    assert loop.overload.idle


def test_who_does_not_drive_yet_is_more_patient_and_forgets_it_when_it_begins() -> None:
    overload = Overload(STEPS, PERIOD, GAP)
    for k in range(60):
        if k % 4 == 0:
            overload.late(k * PERIOD, PERIOD)
        overload.look(k * PERIOD, drives=False)
    assert overload.wanted == 0
    overload.look(60 * PERIOD)
    assert overload.wanted == 0
    for k in range(60):
        overload.late((100 + k) * PERIOD, PERIOD)
        overload.look((100 + k) * PERIOD, drives=False)
    assert overload.wanted == 1


def test_a_loop_that_is_late_all_the_time_wants_a_lower_rate_at_once() -> None:
    loop = Loop()
    loop.run(0.15, lambda _: 0.6)
    assert loop.overload.wanted == loop.overload.level == 1
    assert loop.overload.period_ns == 2 * PERIOD
    assert loop.overload.text(loop.now) == "overloaded: this machine ran late by 0.024 s: 25 Hz"


def test_it_falls_until_the_rate_can_be_kept_and_no_further() -> None:
    for needs, level in ((0.015, 0), (0.03, 1), (0.06, 2), (0.15, 3)):
        loop = Loop()
        loop.run(1.4, busy(needs))
        assert loop.overload.level == level
        assert loop.overload.step == min(level, STEPS)


def test_beyond_the_last_step_the_rate_stays() -> None:
    loop = Loop(steps=0)
    loop.run(2.0, busy(0.2))
    assert (loop.overload.level, loop.overload.step, loop.overload.period_ns) == (1, 0, PERIOD)
    assert loop.overload.text(loop.now).endswith("s: slower")
    loop = Loop(steps=1)
    loop.run(2.0, busy(0.2))
    assert loop.overload.text(loop.now).endswith("s: 25 Hz, slower still")


def test_where_even_that_does_not_do_it_stands_and_drives_again_by_steps() -> None:
    loop = Loop(steps=1)
    loop.run(4.0, busy(0.3))
    assert [level for _, level in loop.levels] == [1, 2, 3]
    assert loop.overload.stands
    assert loop.overload.text(loop.now).endswith("s: 25 Hz, stands until it does not")
    loop.levels.clear()
    loop.until_calm(3 * CALM_NS / NS_PER_S + 1.0)
    assert [level for _, level in loop.levels] == [2, 1, 0]
    other = Loop(steps=1)
    other.overload.heard(7, 3, other.now, 0)
    other.run(0.1, in_time)
    assert not other.overload.stands, "another robot's word stops nobody"
    told = "overloaded: the machine of robot 7 runs late: 25 Hz, slower still"
    assert other.overload.text(other.now) == told
    other.overload.heard(8, 3, other.now, 0)
    other.run(0.1, in_time)
    assert other.overload.stands, "two do"


def test_who_stands_decides_rarely_until_it_would_keep_the_rate_at_which_it_drives() -> None:
    """Else it would have as much to do as when it drove, and never come back."""
    loop = Loop(steps=0, period_ns=5 * PERIOD, standing_ns=10 * PERIOD)
    loop.run(5.0, lambda _: 3.0)
    assert loop.overload.stands
    assert loop.overload.period_ns == 10 * PERIOD
    loop.run(5.0, lambda _: 0.3)  # 60 ms: at 10 Hz that is more than half a period
    assert loop.overload.stands
    loop.until_calm(within=30.0)
    assert loop.overload.period_ns == 5 * PERIOD


def test_it_comes_back_when_the_load_is_gone() -> None:
    loop = Loop()
    loop.run(10.0, busy(0.2))
    assert loop.overload.level == STEPS + 1
    loop.until_calm((STEPS + 1) * CALM_NS / NS_PER_S + 1.0)
    loop.run(10.0, in_time)
    assert loop.overload.idle
    counters = loop.overload.counters()
    assert counters["overload.asked_ms"] > 9000
    spent = [value for name, value in counters.items() if name.startswith("overload.level_")]
    assert len(spent) == STEPS + 1
    assert sum(spent) == pytest.approx(counters["overload.asked_ms"], abs=200)


def test_what_would_be_late_again_at_the_higher_rate_is_not_calm() -> None:
    loop = Loop()
    loop.run(1.0, busy(0.03))
    assert loop.overload.level == 1
    loop.run(
        20.0, lambda period_ns: 0.3 if period_ns > PERIOD else 0.6
    )  # 0.3 of the long one, 0.6 of the short
    assert loop.levels == [(loop.levels[0][0], 1)]


@pytest.mark.slow
@given(
    st.integers(0, 4),
    st.sampled_from([4.0, 10.0, 20.0, 50.0, 200.0]),
    st.floats(0.001, 2.0),
    st.floats(10.0, 60.0),
)
def test_it_neither_goes_beyond_its_steps_nor_to_and_fro(
    steps: int, rate: float, needs_s: float, seconds: float
) -> None:
    loop = Loop(steps, round(NS_PER_S / rate))
    loop.run(seconds, busy(needs_s))
    assert all(0 <= level <= steps + 2 for _, level in loop.levels)
    loop.levels.clear()
    loop.run(120.0, busy(needs_s))
    # Each try waits twice as long as the one before, and costs a change up and one down.
    assert len(loop.levels) <= 2 * 7
    loop.until_calm((steps + 2) * CALM_MAX_NS / NS_PER_S + 30.0)


@given(st.lists(st.tuples(st.floats(0.1, 5.0), st.floats(0.0, 0.2)), max_size=12), st.integers(0, 3))
def test_whatever_the_load_does_it_comes_back(loads: list[tuple[float, float]], steps: int) -> None:
    loop = Loop(steps)
    for seconds, needs_s in loads:
        loop.run(seconds, busy(needs_s))
        assert 0 <= loop.overload.wanted <= steps + 2
    loop.until_calm((steps + 2) * CALM_MAX_NS / NS_PER_S + 30.0)
    loop.run(5.0, in_time)
    assert loop.overload.idle


# ---------------------------------------------------------------------- together


def test_the_greatest_that_is_heard_counts_for_a_while() -> None:
    loop = Loop()
    loop.overload.heard(3, 1, loop.now, 0)
    loop.overload.heard(4, 2, loop.now, 0)
    loop.run(0.1, in_time)
    assert (loop.overload.level, loop.overload.wanted) == (2, 0)
    assert loop.overload.text(loop.now) == "overloaded: the machine of robot 4 runs late: 12.5 Hz"
    loop.overload.heard(4, 1, loop.now, 0)
    loop.run(0.1, in_time)
    assert loop.overload.text(loop.now) == "overloaded: the machine of robot 3 and 1 more runs late: 25 Hz"
    loop.overload.heard(4, 0, loop.now, 0)
    loop.run(HEARD_NS / NS_PER_S, in_time)
    assert loop.overload.level == 0  # robot 3 has not said it again
    assert loop.overload.idle


def test_nobody_hears_his_own_wish_back() -> None:
    """Two that hear each other say what each wants itself: when neither does any more, both are back."""
    pair = [Loop(), Loop()]
    pair[0].run(1.0, busy(0.06))
    pair[1].now = pair[0].now
    for _ in range(400):
        for loop, other in (pair, pair[::-1]):
            loop.overload.heard(9, other.overload.wanted, loop.now, 0)
            loop.run(0.05, in_time)
    assert [loop.overload.level for loop in pair] == [0, 0]


def test_who_is_late_at_the_rate_of_another_wants_a_lower_one_still() -> None:
    loop = Loop()
    loop.overload.heard(3, 1, loop.now, 60 * NS_PER_S)
    loop.run(1.0, in_time)
    loop.run(WINDOW_NS / NS_PER_S, busy(0.06))
    assert loop.overload.wanted == 2


# ---------------------------------------------------------------------- what it could not hear


def test_how_long_it_did_not_run_since_an_instant() -> None:
    overload = Overload(STEPS, PERIOD, GAP)
    overload.late(3 * NS_PER_S, NS_PER_S)
    overload.late(5 * NS_PER_S, NS_PER_S // 2)
    assert overload.missed_ns(0) == 3 * NS_PER_S // 2
    assert overload.missed_ns(5 * NS_PER_S // 2) == NS_PER_S  # half of the first is before
    assert overload.missed_ns(5 * NS_PER_S) == 0
    assert overload.stall(5 * NS_PER_S) == "overloaded: this machine ran late by 1 s"
    assert overload.stall(60 * NS_PER_S) == "overloaded: this machine ran late"
