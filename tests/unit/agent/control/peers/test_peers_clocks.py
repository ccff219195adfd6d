"""Neighbours whose clocks are off."""

from __future__ import annotations

import pytest

from handfast.agent.control.peers.peers import Peers
from handfast.agent.messages.types import FUTURE_NS_MAX
from tests.unit.agent.control.peers.neighbours import (
    OFFSETS,
    PERIOD,
    T0,
    S,
    ages,
    heard,
    message,
    peers,
    predicted,
    total,
)
from tests.values import values


def echo(offset_ns: int) -> tuple[tuple[int, int], ...]:
    """What a neighbour whose clock is so far ahead hears of robot 1's messages, each a period old."""
    return (7, 1), (1, (PERIOD + offset_ns) // 1000), (8, 2)


def ahead(offset_ns: int, *robots: int, epoch_ns: int = T0) -> Peers:
    """Knows these neighbours' clocks to be ahead by a multiple of the period; last heard at T0."""
    known = peers(epoch_ns=epoch_ns)
    for tick in range(-4, 1):
        now = T0 + tick * PERIOD
        stamp = now - PERIOD + offset_ns
        heard(known, *(message(r, tick + 4, stamp, heard=echo(offset_ns)) for r in robots), now_ns=now)
    for robot in robots:
        assert known.get(robot).clock.used_ns == offset_ns
    return known


@pytest.mark.parametrize("offset_ns", [5 * PERIOD, -7 * PERIOD])
def test_a_clock_that_is_off_makes_no_age_and_no_doubt(offset_ns: int):
    known = ahead(offset_ns, 2)
    assert ages(known, T0 + 3 * PERIOD) == [4 * PERIOD, None, None]
    assert known.get(2).doubt(T0 + 3 * PERIOD) == 0.0
    before = total(known, "delayed")  # what came before the offset was known
    for tick, age in ((1, PERIOD), (2, 2 * PERIOD), (3, 3 * PERIOD)):
        stamp = T0 + tick * PERIOD + offset_ns
        one = message(2, 4 + tick, stamp, heard=echo(offset_ns))
        heard(known, one, now_ns=stamp - offset_ns + age)
    assert total(known, "delayed") == before + 1


def test_the_messages_of_this_tick_wait_by_the_neighbours_clock():
    known = ahead(5 * PERIOD, 2, 5)
    now = T0 + PERIOD
    said = echo(5 * PERIOD)
    assert known.accept(message(2, 5, now + 5 * PERIOD - 1, heard=said), now) is None  # of the last tick
    assert known.accept(message(5, 5, now + 5 * PERIOD, heard=said), now) is None
    assert ages(known, now) == [1, 2 * PERIOD, None]
    known.begin(now + PERIOD)
    assert ages(known, now + PERIOD) == [PERIOD + 1, PERIOD, None]


def test_the_future_begins_by_the_neighbours_clock():
    known = ahead(5 * PERIOD, 2)
    now = T0 + PERIOD
    limit = now + 5 * PERIOD + FUTURE_NS_MAX
    assert known.accept(message(2, 5, limit + 1), now) == "future"
    assert known.accept(message(5, 5, now + FUTURE_NS_MAX + 1), now) == "future"
    assert known.accept(message(2, 5, limit), now) is None


def test_what_is_echoed():
    known = heard(peers(), message(2, 0, T0), message(9, 0, T0))
    assert known.heard() == ()  # one message alone proves nothing
    now = T0 + 2 * PERIOD
    heard(known, message(2, 1, T0 + PERIOD), message(9, 1, now + 4 * PERIOD), now_ns=now)
    heard(known, message(9, 2, now + 5 * PERIOD), now_ns=now + PERIOD)
    said = known.heard()
    assert said == ((2, 20_000), (9, -80_000))
    heard(known, message(2, 2, T0 + 2 * PERIOD), now_ns=T0 + 3 * PERIOD)
    assert known.heard() is said  # not made anew for every message


def test_a_refused_message_says_nothing_of_clocks():
    known = ahead(5 * PERIOD, 2)
    clock, now = known.get(2).clock, T0 + PERIOD
    said = clock.used_ns, clock.offset_us, clock.error_us, known.heard()
    lie = ((1, 9_000_000),)
    for refused in (
        message(2, 9, now + S, heard=lie),
        message(2, 4, T0 + 4 * PERIOD, heard=lie),
        message(2, 3, T0 + 4 * PERIOD - 1, heard=lie),
    ):
        for _ in range(3):
            assert known.accept(refused, now) is not None
    assert (clock.used_ns, clock.offset_us, clock.error_us, known.heard()) == said


@pytest.mark.parametrize("follows", [True, False])
@pytest.mark.parametrize("ticks", [5, -7])
def test_a_neighbour_is_carried_forward_in_its_own_clock(follows: bool, ticks: int):
    """It is where one with the right clock would be that much later (or earlier) on its way."""
    offset_ns = ticks * PERIOD
    for epoch_ns in (T0 - S, T0 + offset_ns + 2 * PERIOD):
        known, plain = ahead(offset_ns, 2, 5, 9, epoch_ns=epoch_ns), peers(epoch_ns=epoch_ns)
        vectors = (0.1, 1.0), (0.3, -0.2), (0.1, 0.2)
        for robot in OFFSETS:
            state = message(robot, 5, T0 + offset_ns, follows, *vectors)
            heard(known, state._replace(heard=echo(offset_ns)), now_ns=T0 + PERIOD)
            heard(plain, state, now_ns=T0 + offset_ns + PERIOD)
        for age_ns in (PERIOD // 2, 3 * PERIOD, S):
            for robot in OFFSETS:
                shown = predicted(known, robot, T0 + age_ns)
                assert values(shown) == values(predicted(plain, robot, T0 + offset_ns + age_ns))


def test_equal_clocks_change_no_bit():
    """What is known of them is no reason to reckon otherwise: runs are compared with simulations."""
    known, plain = ahead(0, 2, 5, 9), peers()
    for robot in OFFSETS:
        assert known.get(robot).clock.error_us == PERIOD // 1000
        state = message(robot, 5, T0, True, (0.1, 1.0), (0.3, -0.2), (0.1, 0.2))
        heard(known, state._replace(heard=echo(0)))
        heard(plain, state)
        assert values(predicted(known, robot, T0 + 3 * PERIOD)) == values(
            predicted(plain, robot, T0 + 3 * PERIOD)
        )
