"""Which messages a robot takes, refuses, and keeps for the next tick."""

from __future__ import annotations

import pytest

from handfast.agent.messages.types import FUTURE_NS_MAX, HandState
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


def test_a_late_message_is_counted_as_delayed():
    known = peers()
    for sequence, age in enumerate((PERIOD, 2 * PERIOD, 2 * PERIOD + 1, 10 * PERIOD)):
        stamp = T0 + sequence * S
        heard(known, message(2, sequence, stamp), now_ns=stamp + age)
    assert total(known, "delayed") == 2


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


def test_numbers_that_jump_lose_nothing():
    """A mission sets them from a count to its rounds: no more is lost than there was time for."""
    known = heard(peers(), message(2, 7, T0))
    heard(known, message(2, 2**20, T0 + PERIOD), now_ns=T0 + 2 * PERIOD)
    assert total(known, "lost") == 0
    heard(known, message(2, 2**21, T0 + 3 * PERIOD), now_ns=T0 + 4 * PERIOD)
    assert total(known, "lost") == 1


def test_sequence_numbers_far_apart_keep_the_counters_small():
    """Sequence numbers may be anything up to 2**62: what is sent as a counter must stay an int64."""
    known = peers()
    for step in range(12):
        number = 0 if step % 2 else 2**62 - 1
        heard(known, message(2, number, T0 + step * PERIOD), now_ns=T0 + (step + 1) * PERIOD)
    assert total(known, "lost") < 2**63


@pytest.mark.parametrize("jitter_ns", [-PERIOD // 4, PERIOD // 4])
def test_losses_are_counted_by_stamps_that_jitter(jitter_ns: int):
    known = heard(peers(), message(2, 0, T0))
    heard(known, message(2, 1, T0 + PERIOD + jitter_ns), now_ns=T0 + 3 * PERIOD)
    heard(known, message(2, 4, T0 + 4 * PERIOD), now_ns=T0 + 5 * PERIOD)
    assert total(known, "lost") == 2


def test_counts_of_each():
    known = heard(peers(), message(2, 0, T0), message(5, 0, T0), message(9, 0, T0))
    now = T0 + 8 * PERIOD
    heard(known, message(9, 4, T0 + 4 * PERIOD), message(5, 6, T0 + 6 * PERIOD), now_ns=now)
    assert known.accept(message(9, 4, T0 + 4 * PERIOD), now) == "duplicate"
    assert known.accept(message(2, 8, now), now) is None  # waits
    assert known.accept(message(2, 8, now), now) == "duplicate"
    counts = [(p.received, p.lost, p.delayed, p.duplicated) for p in map(known.get, sorted(OFFSETS))]
    assert counts == [(1, 0, 0, 1), (2, 5, 0, 0), (2, 3, 1, 1)]


def test_one_that_is_not_listened_to_any_more_loses_nothing():
    known = heard(peers(), message(2, 0, T0))
    known.ignore(2)
    heard(known, message(2, 200, T0 + 200 * PERIOD), now_ns=T0 + 201 * PERIOD)
    assert total(known, "lost") == 0


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


def test_early_and_late_by_turns_loses_nothing():
    known = peers()
    late: list[HandState] = []
    for tick in range(60):
        now = T0 + tick * PERIOD
        for one in late:
            assert known.accept(one, now) is None
        late = []
        if tick % 3:
            assert known.accept(message(2, tick, now), now) is None
        else:
            late.append(message(2, tick, now))
        known.begin(now)
        if tick:
            assert ages(known, now)[0] == PERIOD, f"tick {tick}"
    assert total(known, "lost") == 0


def test_a_duplicate_of_a_waiting_message_is_a_duplicate():
    known = peers()
    assert known.accept(message(2, 0, T0), T0) is None
    assert known.accept(message(2, 0, T0), T0) == "duplicate"
    known.begin(T0 + PERIOD)
    assert (total(known, "received"), total(known, "duplicated")) == (1, 1)


def test_a_message_from_a_clock_ahead_is_taken_at_once():
    """More than a tick ahead and less than FUTURE_NS_MAX: it is no message of this tick."""
    known = peers()
    heard(known, message(2, 0, T0 + 3 * PERIOD), now_ns=T0)
    assert ages(known, T0)[0] == -3 * PERIOD
    heard(known, message(5, 0, T0 + FUTURE_NS_MAX), now_ns=T0)


def test_a_message_that_waits_is_taken_before_a_newer_one():
    """A clock that jumps ahead: what waits is of before."""
    known = heard(peers(), message(2, 0, T0))
    now = T0 + PERIOD
    heard(known, message(2, 1, now), message(2, 2, now + 3 * PERIOD), now_ns=now)
    known.begin(now + PERIOD)
    assert ages(known, now + PERIOD)[0] == -2 * PERIOD
    assert total(known, "received") == 3


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


def test_a_beacon_of_this_tick_waits_for_the_next():
    """For a robot whose clock is behind, all beacons are of this tick or of one to come."""
    known = heard(peers(), message(2, 5, T0, position=(1.0, 2.0)))
    now = T0 + PERIOD
    assert known.accept_beacon(beacon(2, now, (1.1, 2.0)), now) is None
    known.begin(now)
    assert predicted(known, 2, T0).position == (1.0, 2.0)
    assert known.accept_beacon(beacon(3, now + PERIOD, (5.0, 5.0)), now + PERIOD) is None
    known.begin(now + PERIOD)
    assert predicted(known, 2, now).position == pytest.approx((1.1, 2.0))
    assert known.get(3).message is None
    known.begin(now + 2 * PERIOD)
    assert predicted(known, 3, now + PERIOD).position == pytest.approx((5.0, 5.0))


def test_a_beacon_from_the_future_is_refused():
    known = peers()
    assert known.accept_beacon(beacon(2, T0 + FUTURE_NS_MAX + 1), T0) == "future"
