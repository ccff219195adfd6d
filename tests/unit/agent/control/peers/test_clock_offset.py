"""The offset of a neighbour's clock, from stamps and echoes alone."""

from __future__ import annotations

import pytest

from handfast.agent.control.peers.lateness import DRIFT_MAX, LEAK_NS, ClockOffset
from tests.two_clocks import MS, PERIOD, Delay, S, Side, exchange, run

T0 = 1000 * S


def constant(delay_ns: int) -> Delay:
    return lambda _: delay_ns


def told(least_ns: int, echo_us: int | None, period_ns: int = PERIOD) -> ClockOffset:
    """One that has seen `least_ns` twice and was told `echo_us`."""
    clock = ClockOffset(period_ns)
    for tick in range(2):
        now = T0 + tick * period_ns
        clock.take(now, now - least_ns, echo_us)
    return clock


# ---------------------------------------------------------------------- the interval


@pytest.mark.parametrize("offset_ms", [35, 50, 100, 101, -64, -240, 3000])
@pytest.mark.parametrize("delay_us", [100, 7_000, 30_000])
def test_an_offset_is_found_within_its_error(offset_ms: int, delay_us: int):
    one, other = Side(), Side(offset_ms * MS)
    run(one, other, constant(delay_us * 1000), constant(delay_us * 1000), S)
    for side, truth in ((one, offset_ms * 1000), (other, -offset_ms * 1000)):
        assert abs(side.estimate.offset_us - truth) <= side.estimate.error_us
        assert 10_000 <= side.estimate.error_us <= 20_000 + delay_us


@pytest.mark.parametrize("offset_ms", [60, 100, -64, -240])
def test_an_offset_of_a_few_periods_is_used_on_a_good_link(offset_ms: int):
    one, other = Side(), Side(offset_ms * MS)
    run(one, other, constant(MS // 10), constant(MS // 10), S)
    assert one.estimate.used_ns == pytest.approx(offset_ms * MS, abs=PERIOD // 2)
    assert other.estimate.used_ns == pytest.approx(-one.estimate.used_ns, abs=1000)


@pytest.mark.parametrize("slow_ms", [0, 5, 200, 500])
@pytest.mark.parametrize("offset_ms", [0, 3, -12])
def test_a_link_that_is_slow_one_way_is_no_offset(slow_ms: int, offset_ms: int):
    one, other = Side(), Side(offset_ms * MS)
    for _ in exchange(one, other, constant(slow_ms * MS), constant(0), 2 * S):
        assert one.estimate.used_ns == other.estimate.used_ns == 0


@pytest.mark.parametrize(
    ("least_ms", "echo_ms", "offset_ms", "error_ms", "used_ms"),
    [
        (20, 20, 0, 20, 0),
        (0, 20, 10, 10, 0),  # holds 0
        (500, 20, -240, 260, 0),
        (-20, 40, 30, 10, 30),  # proven beyond twice the error
        (-20, 80, 50, 30, 50 * 2 / 3),  # between
        (80, -20, -50, 30, -50 * 2 / 3),
        (-100, 200, 150, 50, 150),
        (-20, 20, 20, 10, 20),  # not known better than to half a period
        (-30, 20, 25, 10, 25),  # a tick that woke late
    ],
)
def test_the_estimate(least_ms: int, echo_ms: int, offset_ms: int, error_ms: int, used_ms: float):
    clock = told(least_ms * MS, echo_ms * 1000)
    assert (clock.offset_us, clock.error_us) == (offset_ms * 1000, error_ms * 1000)
    assert clock.used_ns == pytest.approx(used_ms * MS, abs=1)


# ---------------------------------------------------------------------- when nothing is known


def test_nothing_is_known_before_both_ends_have_heard_twice():
    clock = ClockOffset(PERIOD)
    assert (clock.used_ns, clock.offset_us, clock.error_us, clock.least_us) == (0, 0, -1, None)
    assert clock.take(T0, T0 + 80 * MS, None) is False
    assert (clock.error_us, clock.least_us) == (-1, None)
    assert clock.take(T0 + PERIOD, T0 + PERIOD + 80 * MS, None) is True
    assert (clock.error_us, clock.least_us) == (-1, -80_000)
    assert clock.take(T0 + 2 * PERIOD, T0 + 2 * PERIOD + 80 * MS, 100_000) is False
    assert (clock.offset_us, clock.error_us, clock.used_ns) == (90_000, 10_000, 90 * MS)
    assert clock.take(T0 + 3 * PERIOD, T0 + 3 * PERIOD + 80 * MS, None) is False  # says nothing this time
    assert (clock.offset_us, clock.error_us, clock.used_ns) == (90_000, 10_000, 90 * MS)


def test_an_absurd_echo_does_no_harm():
    clock = told(-100 * MS, 120_000)
    assert clock.used_ns == 110 * MS
    # What the own stamps prove alone is at least 100 ms.
    for echo_us, used_ns in ((2**62 - 1, 100 * MS), (-(2**62) + 1, 0), (120_000, 110 * MS)):
        clock.take(T0 + S, T0 + S + 100 * MS, echo_us)
        assert clock.used_ns == used_ns
        assert max(abs(clock.offset_us), clock.error_us) < 2**63  # goes into a status


# ---------------------------------------------------------------------- the least delay


def test_the_least_delay_leaks():
    clock = told(20 * MS, 20_000)
    start = T0 + PERIOD
    changes = 0
    for tick in range(1, 501):  # 10 s of congestion
        now = start + tick * PERIOD
        changes += clock.take(now, now - 300 * MS, 20_000)
    assert clock.least_us == 20_000 + 10 * DRIFT_MAX * 1e6
    assert changes == 10 * S * DRIFT_MAX / LEAK_NS  # no work at every message
    # A silence leaks as much.
    silent = told(20 * MS, 20_000)
    silent.take(start + 10 * S, start + 10 * S - 300 * MS, 20_000)
    assert silent.least_us == clock.least_us
    assert silent.take(start + 10 * S + 1, start + 10 * S + 1 - 300 * MS, 20_000) is False
    # What is as small as the least keeps it.
    for tick in range(501, 1001):
        now = start + tick * PERIOD
        assert clock.take(now, now - 25 * MS, 20_000) is False
    assert clock.take(now + PERIOD, now + PERIOD - 300 * MS, 20_000) is False
    assert clock.least_us == 25_000


@pytest.mark.parametrize("drift", [400e-6, -400e-6])
def test_a_drift_is_followed(drift: float):
    one, other = Side(), Side(0, drift)
    for true_ns in exchange(one, other, constant(MS), constant(2 * MS), 300 * S):
        if true_ns > S:
            truth_us = (other.clock(true_ns) - true_ns) / 1000
            assert abs(one.estimate.offset_us - truth_us) <= one.estimate.error_us + 200
    assert one.estimate.used_ns == pytest.approx(drift * 300 * S, abs=PERIOD)


@pytest.mark.parametrize(("before_ms", "after_ms"), [(0, 800), (800, 0), (-200, 150), (150, -200)])
@pytest.mark.parametrize("which", [0, 1])
def test_a_node_that_starts_again_with_another_clock(before_ms: int, after_ms: int, which: int):
    """The other end forgets the clock that was, whichever way it was set."""
    sides = Side(), Side()
    sides[which].set_clock(0, before_ms * MS)
    run(*sides, constant(MS), constant(MS), 2 * S)
    truth = [before_ms * MS, -before_ms * MS][which == 0]
    assert sides[0].estimate.used_ns == pytest.approx(truth, abs=PERIOD // 2)
    sides[which].set_clock(2 * S, after_ms * MS)
    # A clock that was set back has to come to where it was before it is heard again.
    run(*sides, constant(MS), constant(MS), 2 * S + max(0, before_ms - after_ms) * MS + S // 5)
    truth = [after_ms * MS, -after_ms * MS][which == 0]
    for side, sign in zip(sides, (1, -1), strict=True):
        assert side.estimate.used_ns == pytest.approx(sign * truth, abs=PERIOD // 2)
