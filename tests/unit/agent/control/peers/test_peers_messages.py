"""Which messages a robot takes, refuses, and keeps for the next tick."""

from __future__ import annotations

import pytest

from handfast.agent.messages.types import FUTURE_NS_MAX
from tests.unit.agent.control.peers.neighbours import (
    OFFSETS,
    PERIOD,
    T0,
    S,
    ages,
    beacon,
    heard,
    message,
    peers,
    predicted,
    total,
)
from tests.values import values

# ---------------------------------------------------------------------- taken and refused


def test_reasons_of_refusal():
    known = heard(peers(), message(2, 4, T0))
    now = T0 + PERIOD
    before = (total(known, "received"), total(known, "lost"), total(known, "delayed"), ages(known, now))
    assert known.accept(message(2, 5, now + FUTURE_NS_MAX + 1), now) == "future"
    assert known.accept(message(2, 4, T0), now) == "duplicate"
    assert known.accept(message(2, 3, T0 - 1), now) == "out_of_order"
    assert known.accept(message(2, 9, T0 - PERIOD), now) == "out_of_order"  # the time decides
    after = (total(known, "received"), total(known, "lost"), total(known, "delayed"), ages(known, now))
    assert after == before
    assert total(known, "duplicated") == 1


def test_a_refused_message_changes_nothing():
    known = heard(peers(), *(message(robot, 4, T0, position=(1.0, 2.0)) for robot in OFFSETS))
    expected = [values(predicted(known, robot, T0 + S)) for robot in OFFSETS]
    now = T0 + PERIOD
    for time_ns, sequence, follows in ((now + 2 * FUTURE_NS_MAX, 5, True), (T0, 4, False), (T0 - 1, 3, True)):
        wild = message(
            2, sequence, time_ns, follows, (9.0, 9.0), (0.0, 0.0), (5.0, 5.0), ((1, 7.0),), degree=50
        )
        assert known.accept(wild, now) is not None
    assert [values(predicted(known, robot, T0 + S)) for robot in OFFSETS] == expected
    assert known.take_copy(2) is None
    assert known.get(2).degree == 1


def test_lost_messages_are_counted_by_the_gaps():
    known = peers()
    for sequence in (3, 4, 7, 8, 12):  # the first says nothing of what was before
        heard(known, message(2, sequence, T0 + sequence * PERIOD), now_ns=T0 + (sequence + 1) * PERIOD)
    assert total(known, "received") == 5
    assert total(known, "lost") == 2 + 3


def test_duplicates_are_counted():
    known = heard(peers(), message(2, 0, T0), message(5, 0, T0))
    for _ in range(3):
        assert known.accept(message(2, 0, T0), T0 + PERIOD) == "duplicate"
    assert [total(known, name) for name in ("received", "duplicated", "lost")] == [2, 3, 0]


def test_a_sender_that_starts_again_is_taken_and_loses_nothing():
    known = heard(peers(), message(2, 500, T0))
    heard(known, message(2, 0, T0 + S), now_ns=T0 + S + PERIOD)
    assert ages(known, T0 + S + PERIOD)[0] == PERIOD
    assert total(known, "lost") == 0
    heard(known, message(2, 2, T0 + S + 2 * PERIOD), now_ns=T0 + S + 3 * PERIOD)
    assert total(known, "lost") == 1


def test_ages():
    known = heard(peers(), message(5, 0, T0))
    assert ages(known, T0 + S) == [None, S, None]
    assert ages(known, T0 - 5) == [None, -5, None]  # its clock is ahead


# ---------------------------------------------------------------------- messages of this tick


def test_a_message_of_this_tick_waits_for_the_next():
    known = heard(peers(), message(2, 0, T0), now_ns=T0 + PERIOD)
    now = T0 + PERIOD
    assert known.accept(message(2, 1, now), now) is None
    assert ages(known, now)[0] == PERIOD
    known.begin(now)
    assert ages(known, now)[0] == PERIOD  # still this tick
    known.begin(now + PERIOD)
    assert ages(known, now + PERIOD)[0] == PERIOD
    assert (total(known, "received"), total(known, "lost")) == (2, 0)


def test_a_neighbour_whose_messages_always_come_in_their_own_tick_is_heard():
    """Its process always wakes a little earlier than this one: each drain then holds the message of
    this tick, before the last one's has been taken."""
    known = peers()
    for tick in range(50):
        now = T0 + tick * PERIOD
        assert known.accept(message(2, tick, now), now) is None  # the drain
        known.begin(now)  # the tick
        assert ages(known, now)[0] == (None if tick == 0 else PERIOD), f"tick {tick}"
    assert (total(known, "received"), total(known, "lost")) == (49, 0)


def test_a_message_from_a_clock_ahead_is_taken_at_once():
    """More than a tick ahead and less than FUTURE_NS_MAX: it is no message of this tick."""
    known = peers()
    heard(known, message(2, 0, T0 + 3 * PERIOD), now_ns=T0)
    assert ages(known, T0)[0] == -3 * PERIOD
    heard(known, message(5, 0, T0 + FUTURE_NS_MAX), now_ns=T0)


# ---------------------------------------------------------------------- beacons


def test_a_beacon_tells_where_a_robot_is_and_what_it_knows():
    known = peers()
    assert known.accept_beacon(beacon(7, T0, (1.0, 2.0), (0.3, 0.4)), T0 + PERIOD) is None
    peer = known.get(7)
    found = predicted(known, 7, T0)
    assert (found.position, found.velocity) == ((1.0, 2.0), (0.3, 0.4))
    assert peer.age_ns(T0 + S) is None  # an edge needs hand states
    assert (peer.received, peer.lost) == (0, 0)


def test_an_older_beacon_does_not_move_a_robot_that_was_heard_since():
    known = heard(peers(), message(2, 5, T0 + PERIOD, position=(1.0, 2.0)), now_ns=T0 + 2 * PERIOD)
    assert known.accept_beacon(beacon(2, T0, (9.0, 9.0)), T0 + 2 * PERIOD) is None
    assert predicted(known, 2, T0 + PERIOD).position == pytest.approx((1.0, 2.0))


def test_a_hand_state_says_more_than_the_beacon_of_its_tick():
    """An agent drains beacons before hand states, and both of one tick bear one stamp."""
    said = message(2, 5, T0, True, (1.0, 2.0), (0.5, 0.0), (0.1, 0.2), ((1, 3.0),), degree=4)
    plain, both = peers(), peers()
    assert both.accept_beacon(beacon(2, T0, (1.0, 2.0), (0.5, 0.0)), T0 + PERIOD) is None
    for known in (plain, both):
        heard(known, said)
    assert values(predicted(both, 2, T0 + 3 * PERIOD)) == values(predicted(plain, 2, T0 + 3 * PERIOD))
    assert predicted(both, 2, T0).constraint == (0.1, 0.2)
    assert both.accept_beacon(beacon(2, T0, (1.0, 2.0), (0.5, 0.0)), T0 + PERIOD) is None
    assert predicted(both, 2, T0).constraint == (0.1, 0.2)
    assert both.take_copy(2) == 3.0
    assert both.get(2).degree == 4


def test_a_beacon_from_the_future_is_refused():
    known = peers()
    assert known.accept_beacon(beacon(2, T0 + FUTURE_NS_MAX + 1), T0) == "future"
