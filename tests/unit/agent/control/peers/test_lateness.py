"""How late a link usually is: what is late as always is not silent, what is later is."""

from __future__ import annotations

from random import Random

import pytest

from handfast.agent.control.peers.lateness import (
    LATE_MAX_NS,
    OUTAGE_PERIODS,
    UNSURE_NS,
    Lateness,
)

S = 1_000_000_000


def alarms(lateness: Lateness, loss: float, hz: int, delay_s: float, seconds: int, seed: int = 1) -> int:
    """How often in so long a drive a robot that loses messages independently would be taken to be silent."""
    dice, period_ns = Random(seed), S // hz
    last = found = 0
    for k in range(1, hz * seconds):
        if dice.random() >= loss:
            gap_ns = (k - last) * period_ns
            found += gap_ns + delay_s * S > lateness.forgiven_ns + UNSURE_NS
            lateness.take(k * period_ns, round(delay_s * S), gap_ns, period_ns)
            last = k
    return found


@pytest.mark.parametrize("delay_s", [0.02, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3, 0.5])
def test_losses_and_delays_as_usual_are_no_silence(loss: float, delay_s: float):
    lateness = Lateness()
    alarms(lateness, loss, 25, delay_s, 20)  # learns
    assert alarms(lateness, loss, 25, delay_s, 600, seed=2) <= 5
    assert lateness.forgiven_ns <= LATE_MAX_NS


def test_on_a_good_link_nothing_is_forgiven():
    lateness = Lateness()
    alarms(lateness, 0.0, 50, 0.02, 10)
    assert lateness.forgiven_ns == 0
    alarms(lateness, 0.02, 50, 0.02, 100)
    assert lateness.forgiven_ns < S // 20


def test_an_outage_says_nothing_of_what_is_usual():
    lateness = Lateness()
    alarms(lateness, 0.0, 50, 0.02, 10)
    for k in range(20):
        lateness.take(5 * k * S, S // 50, 5 * S, S // 50)
    assert lateness.forgiven_ns == 0
    slow = Lateness()
    for k in range(40):
        slow.take(k * OUTAGE_PERIODS * S, S // 10, OUTAGE_PERIODS * S, S)
    assert slow.forgiven_ns < S


@pytest.mark.parametrize("burst", [5, 20, 40, 60])
def test_of_a_burst_the_oldest_says_how_old_what_is_known_gets(burst: int):
    """All messages of a slot come at once, each one period younger than the one before."""
    lateness, period_ns = Lateness(), S // 50
    for slot in range(1, 30):
        known_ns = burst * period_ns  # of the last one before, when they come
        if slot > 10:
            assert known_ns < lateness.forgiven_ns + UNSURE_NS
        for k in range(burst):
            lateness.take(slot * burst * period_ns, (burst - 1 - k) * period_ns, period_ns, period_ns)


# ---------------------------------------------------------------------- promises

PERIOD = S // 50


def promised(lateness: Lateness, promise: int, count: int, *, loss: float = 0.0, delay_s: float = 0.0) -> int:
    """How often one that sends only every `promise` periods would be taken to be silent."""
    dice, last, found, apart_ns = Random(3), 0, 0, promise * PERIOD
    for k in range(1, count):
        if dice.random() >= loss:
            gap_ns = (k - last) * apart_ns
            found += gap_ns + delay_s * S > lateness.forgiven_ns + UNSURE_NS
            lateness.take_promised(k * apart_ns, round(delay_s * S), gap_ns, apart_ns, apart_ns)
            lateness.expect_promised(PERIOD, apart_ns, apart_ns)
            last = k
    return found


def test_silence_that_was_promised_is_forgiven_and_no_more_than_that():
    lateness = Lateness()
    promised(lateness, 25, 20)
    assert promised(lateness, 25, 200) == 0
    assert lateness.forgiven_ns == 25 * PERIOD - UNSURE_NS


def test_a_promise_within_what_counts_as_silence_forgives_nothing():
    lateness = Lateness()
    promised(lateness, 12, 200)
    assert lateness.forgiven_ns == lateness.usual_ns == lateness.missed_ns == 0


@pytest.mark.parametrize("loss", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.2])
def test_no_more_is_forgiven_than_the_promise_and_what_would_be_without_it(loss: float, delay_s: float):
    lateness = Lateness()
    promised(lateness, 10, 3000, loss=loss, delay_s=delay_s)
    forgiven_ns, usual_ns, missed_ns = lateness.forgiven_ns, lateness.usual_ns, lateness.missed_ns
    lateness.expect(10 * PERIOD)
    most_ns = lateness.forgiven_ns
    lateness.expect(PERIOD)
    assert 0 < forgiven_ns == min(most_ns, lateness.forgiven_ns + 10 * PERIOD)
    assert usual_ns <= max(lateness.usual_ns, 2 * UNSURE_NS)
    assert missed_ns >= 3 * 10 * PERIOD
