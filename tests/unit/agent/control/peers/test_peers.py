"""What a robot knows of the others: which messages it takes, whose clock counts, and whom it trusts."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from typing import Any

import numpy as np
import pytest

from agent.control.law import acting_error
from agent.control.peers.beliefs import DOUBT_AFTER_S, DOUBT_MAX, DOUBT_RATE
from agent.control.peers.lateness import LATE_MAX_NS, UNSURE_NS
from agent.control.peers.peers import (
    NEVER_CAME_NS,
    TRUST_GAINED_S,
    TRUST_LOST_S,
    Peers,
)
from agent.control.peers.prediction import Prediction, as_it_came, coasting, following, transition
from agent.formation.trajectory import Sample
from agent.messages.codec import decode, encode
from agent.messages.types import FUTURE_NS_MAX, NEIGHBOURS_MAX, SILENT_MAX, Beacon, HandState, Removed, Silent

PERIOD = 20_000_000
S = 1_000_000_000
C1, C2 = 0.4, 0.6
T0 = 1000 * S  # an epoch
OFFSETS = {5: (1.0, 0.0), 2: (0.0, -0.5), 9: (-1.0, 0.7)}


def message(
    robot: int = 2,
    sequence: int = 0,
    time_ns: int = T0,
    follows: bool = True,
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    constraint: tuple[float, float] = (0.0, 0.0),
    multipliers: tuple[tuple[int, float], ...] = (),
    navigation: tuple[float, float] = (0.0, 0.0),
    heard: tuple[tuple[int, int], ...] = (),
    degree: int = 1,
) -> HandState:
    forces = (*navigation, *constraint, 0.0, 0.0, 0.0)
    return HandState(
        robot, sequence, time_ns, follows, degree, *position, *velocity, *forces, multipliers, heard
    )


def beacon(
    robot: int = 2,
    time_ns: int = T0,
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
    follows: bool = True,
) -> Beacon:
    return Beacon(robot, 0, time_ns, follows, *position, *velocity, 0.0, 0, 0, -1, -1)


def circling(time_ns: int) -> Sample:
    """A reference with an acceleration."""
    t = (time_ns - T0) / S
    return cos(t), 2 * sin(t), -sin(t), 2 * cos(t), -cos(t), -2 * sin(t)


def standing(_time_ns: int) -> Sample:
    return 3.0, 4.0, 0.0, 0.0, 0.0, 0.0


def peers(reference: Callable[[int], Sample] = circling, epoch_ns: int = T0, **options: Any) -> Peers:
    def motion(robot: int, time_ns: int) -> Sample | None:
        if robot not in OFFSETS:
            return None
        x, y, *rest = reference(time_ns)
        return x + OFFSETS[robot][0], y + OFFSETS[robot][1], *rest

    made = Peers(1, C1, C2, PERIOD, motion, **options)
    made.forecast.epoch_ns = epoch_ns
    return made


def heard(known: Peers, *messages: HandState, now_ns: int = T0 + PERIOD) -> Peers:
    for one in messages:
        assert known.accept(one, now_ns) is None
    return known


def predicted(known: Peers, robot: int, time_ns: int) -> Prediction:
    return known.predict(known.get(robot), time_ns)


def ages(known: Peers, now_ns: int) -> list[int | None]:
    return [known.get(robot).age_ns(now_ns) for robot in sorted(OFFSETS)]


def total(known: Peers, name: str) -> int:
    return sum(getattr(peer, name) for peer in known.known)


# ---------------------------------------------------------------------- prediction


def test_a_robot_that_follows_is_carried_along_its_own_way():
    known, said = peers(decay=0.9), {}
    for robot in OFFSETS:
        vectors = (0.3 * robot, 1.0), (0.2, -0.1 * robot), (0.1, 0.2)
        said[robot] = message(robot, 0, T0 + PERIOD, True, *vectors)
    heard(known, *said.values(), now_ns=T0 + 2 * PERIOD)
    for robot, (x, y) in OFFSETS.items():
        since, then = (
            (a + x, b + y, *rest) for a, b, *rest in map(circling, (T0 + PERIOD, T0 + PERIOD + S // 2))
        )
        expected = following(said[robot], then, since, 0.5, C1, C2, 0.9, None)
        assert predicted(known, robot, T0 + PERIOD + S // 2) == expected


def test_a_robot_far_from_its_place_makes_for_it_no_faster_than_it_may():
    near, far = peers(standing, most=1.0), peers(standing)
    said = message(2, 0, T0, position=(30.0, 4.0))
    for known in (near, far):
        heard(known, said)
    x, y = acting_error((27.0, 0.5), (0.0, 0.0), C1, C2, 1.0)
    assert predicted(near, 2, T0).navigation == pytest.approx((-C1 * x, -C1 * y))
    assert predicted(far, 2, T0).navigation == pytest.approx((-C1 * 27.0, -C1 * 0.5))


def test_before_the_epoch_a_robot_stands():
    """A message of the warm-up is of a robot at rest that begins to follow at the epoch."""
    known = peers(standing)
    heard(
        known, *(message(r, 0, T0 - 5 * PERIOD, position=(3.0, 4.5)) for r in OFFSETS), now_ns=T0 - 4 * PERIOD
    )
    assert predicted(known, 2, T0).position == pytest.approx((3.0, 4.5))
    later = predicted(known, 9, T0 + S)
    offset = np.array(OFFSETS[9])
    error = np.array((3.0, 4.5)) - (3.0, 4.0) - offset
    a11, _, a21, *_ = transition(C1, C2, 0.0, 1.0)
    assert later.position == pytest.approx(a11 * error + (3.0, 4.0) + offset)
    assert later.velocity == pytest.approx(a21 * error)


def test_a_robot_that_brakes_coasts_from_its_message():
    known = peers()
    braking = message(2, 0, T0 - S, False, (1.0, 2.0), (0.5, 0.0))
    heard(known, message(5), braking)
    assert predicted(known, 2, T0 + S) == coasting(braking, 2.0)
    assert predicted(known, 5, T0 + S) != coasting(message(5), 1.0)


def test_a_robot_without_a_place_coasts():
    stray = message(7, 0, T0, True, (1.0, 2.0), (0.5, 0.0))
    known = heard(peers(), stray)
    assert predicted(known, 7, T0 + S) == coasting(stray, 1.0)


def test_a_robot_whose_process_is_gone_brakes():
    """Its plant sees to that; it follows again when it has been heard again, not by its token alone."""
    said = message(2, 0, T0, True, (1.0, 2.0), (0.5, 0.0))
    known = heard(peers(), said)
    known.present(2, False)
    assert predicted(known, 2, T0 + S) == coasting(said, 1.0)
    known.present(2, True)
    assert not known.get(2).here
    assert predicted(known, 2, T0 + S) == coasting(said, 1.0)
    again = said._replace(time_ns=T0 + 2 * PERIOD)
    heard(known, again, now_ns=T0 + 3 * PERIOD)
    assert known.get(2).here
    assert predicted(known, 2, T0 + S) != coasting(again, 0.96)


def test_what_was_on_its_way_from_a_process_that_is_gone_does_not_bring_it_back():
    known = heard(peers(), message(2, 0, T0))
    known.present(2, False)
    heard(known, message(2, 1, T0 + PERIOD), now_ns=T0 + 2 * PERIOD)
    assert known.accept_beacon(beacon(2, T0 + 2 * PERIOD), T0 + 3 * PERIOD) is None
    assert not known.get(2).here


@pytest.mark.parametrize("age_ns", [0, PERIOD, 2 * S])
def test_without_prediction_a_state_is_taken_as_it_came(age_ns: int):
    known = peers(predict=False)
    said = message(2, 0, T0, True, (1.0, 2.0), (0.5, -0.3), (0.1, 0.2), navigation=(0.7, 0.8))
    heard(known, said, said._replace(robot=5, following=False))
    assert ages(known, T0 + age_ns) == [age_ns, age_ns, None]
    assert predicted(known, 2, T0 + age_ns) == as_it_came(said)
    assert predicted(known, 5, T0 + age_ns) == coasting(said, 0.0)


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
    expected = [predicted(known, robot, T0 + S) for robot in OFFSETS]
    now = T0 + PERIOD
    for time_ns, sequence, follows in ((now + 2 * FUTURE_NS_MAX, 5, True), (T0, 4, False), (T0 - 1, 3, True)):
        wild = message(
            2, sequence, time_ns, follows, (9.0, 9.0), (0.0, 0.0), (5.0, 5.0), ((1, 7.0),), degree=50
        )
        assert known.accept(wild, now) is not None
    assert [predicted(known, robot, T0 + S) for robot in OFFSETS] == expected
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


def test_a_message_that_waits_is_dropped_for_a_newer_one():
    """A clock that jumps ahead: what waits is of before."""
    known = heard(peers(), message(2, 0, T0))
    now = T0 + PERIOD
    heard(known, message(2, 1, now), message(2, 2, now + 3 * PERIOD), now_ns=now)
    known.begin(now + PERIOD)
    assert ages(known, now + PERIOD)[0] == -2 * PERIOD
    assert total(known, "received") == 2


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
    assert predicted(both, 2, T0 + 3 * PERIOD) == predicted(plain, 2, T0 + 3 * PERIOD)
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


# ---------------------------------------------------------------------- multipliers and degrees


def test_a_copy_of_the_shared_multiplier_is_taken_once():
    known = heard(
        peers(),
        message(2, multipliers=((7, 100.0), (1, 3.0)), degree=3),
        message(5, multipliers=((7, 5.0),)),  # not about this edge
    )
    assert known.take_copy(2) == 3.0
    assert known.take_copy(2) is None
    assert known.take_copy(5) is None
    assert known.take_copy(4) is None  # never heard of
    heard(known, message(2, 1, T0 + PERIOD, multipliers=((1, -2.0),)), now_ns=T0 + 2 * PERIOD)
    heard(known, message(2, 2, T0 + 2 * PERIOD, multipliers=()), now_ns=T0 + 3 * PERIOD)
    assert known.take_copy(2) is None  # the latest has none
    assert known.get(2).degree == 1


# ---------------------------------------------------------------------- trust and doubt


def test_trust_goes_fast_and_comes_back_slowly():
    known = peers()
    peer, period_s = known.get(2), PERIOD / S
    assert peer.trust == 0.0
    gained = [known.update_trust(peer, True, period_s) for _ in range(100)]
    assert gained[:2] == pytest.approx([period_s / TRUST_GAINED_S, 2 * period_s / TRUST_GAINED_S])
    assert gained[round(TRUST_GAINED_S / period_s)] == 1.0
    lost = [known.update_trust(peer, False, period_s) for _ in range(50)]
    assert lost[0] == pytest.approx(1.0 - period_s / TRUST_LOST_S)
    assert lost[round(TRUST_LOST_S / period_s)] == 0.0


def test_doubt_grows_with_silence_and_has_an_end():
    known = heard(peers(), message(2, 0, T0))
    peer = known.get(2)
    assert [peer.doubt(T0 + at) for at in (0, PERIOD, round(DOUBT_AFTER_S * S))] == [0.0] * 3
    assert peer.doubt(T0 + S) == pytest.approx(DOUBT_RATE * (1.0 - DOUBT_AFTER_S))
    assert peer.doubt(T0 + 100 * S) == DOUBT_MAX
    assert known.accept_beacon(beacon(2, T0 + S), T0 + S + PERIOD) is None  # a beacon ends it, too
    assert peer.doubt(T0 + S + PERIOD) == 0.0


# ---------------------------------------------------------------------- clocks that differ


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


def test_a_clock_that_was_behind_and_is_set_is_not_refused():
    """Its messages would be of the future for what it was, and nothing could unlearn that."""
    known = ahead(-40 * PERIOD, 2)
    now = T0 + PERIOD
    for tick in range(3):
        now = T0 + (1 + tick) * PERIOD
        assert known.accept(message(2, tick, now - PERIOD, heard=echo(0)), now) is None
    assert ages(known, now)[0] == PERIOD
    assert known.get(2).clock.used_ns == 0


def test_how_far_ahead_a_refused_clock_is():
    known = heard(peers(), message(2, 0, T0))
    now = T0 + PERIOD
    assert known.get(2).ahead_ns == 0
    assert known.accept(message(5, 0, now + 800_000_000), now) == "future"
    assert known.accept(message(5, 1, now + 790_000_000), now) == "future"
    assert (known.get(2).ahead_ns, known.get(5).ahead_ns) == (0, 790_000_000)
    assert known.accept(message(5, 2, now - 1), now) is None  # it was set right
    assert known.get(5).ahead_ns == 0


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


def test_no_more_is_echoed_than_a_message_holds():
    """In a large fleet a robot meets many others: those that it heard last are what counts."""
    known = peers()
    robots = range(100, 100 + NEIGHBOURS_MAX + 10)
    for tick in range(2):
        for number, robot in enumerate(robots):
            stamp = T0 + tick * PERIOD + number
            heard(known, message(robot, tick, stamp), now_ns=stamp + PERIOD)
    echoed = known.heard()
    assert [robot for robot, _ in echoed] == list(robots)[10:]
    decode(encode(message(1, heard=echoed)))


def test_a_message_that_waits_is_echoed_by_when_it_came():
    known = peers()
    for tick in range(3):
        now = T0 + tick * PERIOD
        heard(known, message(2, tick, now), now_ns=now)
    assert known.heard() == ((2, 0),)


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
                assert shown == predicted(plain, robot, T0 + offset_ns + age_ns)


def test_equal_clocks_change_no_bit():
    """What is known of them is no reason to reckon otherwise: runs are compared with simulations."""
    known, plain = ahead(0, 2, 5, 9), peers()
    for robot in OFFSETS:
        assert known.get(robot).clock.error_us == PERIOD // 1000
        state = message(robot, 5, T0, True, (0.1, 1.0), (0.3, -0.2), (0.1, 0.2))
        heard(known, state._replace(heard=echo(0)))
        heard(plain, state)
        assert predicted(known, robot, T0 + 3 * PERIOD) == predicted(plain, robot, T0 + 3 * PERIOD)


# ---------------------------------------------------------------------- late is not lost


def stream(known: Peers, robot: int, count: int, late_ns: int, every: int = 1) -> int:
    """`count` hand states of a robot that comes every period, or less often, each `late_ns` after its stamp;
    returns when the last one came."""
    for k in range(0, count * every, every):
        stamp = T0 + k * PERIOD
        assert known.accept(message(robot, k, stamp), stamp + late_ns) is None
    return stamp + late_ns


@pytest.mark.parametrize("late_s", [0.02, 0.3, 0.5, 1.0])
def test_a_link_that_is_always_late_is_not_silent(late_s: float):
    known = peers()
    now = stream(known, 2, 60, round(late_s * S))
    assert known.get(2).is_heard(now + PERIOD)
    assert not known.get(2).is_heard(now + UNSURE_NS + PERIOD + round(0.3 * S))


def test_what_comes_rarely_is_expected_rarely():
    often, rarely = peers(), peers()
    now = {known: stream(known, 2, 60, PERIOD, every) for known, every in ((often, 1), (rarely, 15))}
    gap = UNSURE_NS + PERIOD
    assert not often.get(2).is_heard(now[often] + gap)
    assert rarely.get(2).is_heard(now[rarely] + gap)


def test_one_outage_does_not_make_a_link_late():
    known = peers()
    now = stream(known, 2, 60, PERIOD)
    heard(known, message(2, 2000, now + 10 * S), now_ns=now + 10 * S + PERIOD)
    assert known.get(2).forgiven_ns < S // 2
    for k in range(1, 30):
        stamp = now + 10 * S + k * PERIOD
        heard(known, message(2, 2000 + k, stamp), now_ns=stamp + PERIOD)
    assert known.get(2).forgiven_ns == 0


def test_no_more_than_so_much_is_forgiven():
    known = peers()
    stream(known, 2, 60, 9 * S)
    assert known.get(2).forgiven_ns == LATE_MAX_NS


# ---------------------------------------------------------------------- where the silent may be


def test_who_is_silent_may_be_anywhere_on_its_way_since():
    known = heard(peers(horizon_s=1.0), message(2, 5, T0, position=(1.0, 0.0), velocity=(0.5, 0.0)))
    peer = known.get(2)
    assert peer.is_heard(T0 + UNSURE_NS - PERIOD)
    assert not peer.is_heard(T0 + 2 * UNSURE_NS)
    belief = known.belief(peer)
    for share in (0.0, 0.2, 0.5, 0.75, 1.0):  # a way with a bend
        x, y = known.predict(peer, round(T0 + share * 2 * S)).position
        assert any(each.distance(x, y) <= each.radius_at(share * 2.0) + 0.01 for each in belief.stretches)
    assert known.belief(peer) is belief  # made once
    peer.here = False  # it brakes, or has only been cut off
    assert not peer.is_heard(T0 + PERIOD)
    assert known.belief(peer) is belief


def test_who_stood_and_was_not_following_may_have_begun_to():
    known = heard(peers(standing, horizon_s=1.0), message(2, 5, T0, follows=False))
    belief = known.belief(known.get(2))
    assert len(belief.stretches) > 1
    gone = heard(peers(standing, horizon_s=1.0), message(7, 5, T0, follows=False))  # it has no place
    assert len(gone.belief(gone.get(7)).stretches) == 1


def test_who_was_driven_by_somebody_else_may_have_been_driven_on():
    stood = heard(peers(), message(7, 5, T0, follows=False, position=(1.0, 0.0), velocity=(0.0, 0.0)))
    drove = heard(peers(), message(7, 5, T0, follows=False, position=(1.0, 0.0), velocity=(0.8, 0.0)))
    (there,) = stood.belief(stood.get(7)).stretches
    wide, *_ = drove.belief(drove.get(7)).stretches
    assert wide.radius >= there.radius + 0.8


def test_who_was_never_heard_is_where_it_starts():
    known = peers(starts={2: (1.5, -2.0)})
    (there,) = known.belief(known.get(2)).stretches
    assert there[:5] == (1.5, -2.0, 0.0, 0.0, 0.0)
    assert known.belief(known.get(7)) is None
    heard(known, message(2, 5, T0, position=(9.0, 0.0)))
    assert known.belief(known.get(2)).stretches[0].x > 5.0


# ---------------------------------------------------------------------- hearsay


def told(known: Peers, now_ns: int, sender: int = 3) -> Beacon:
    """What robot `sender`, who knows what `known` does, says of the silent."""
    unheard = known.given_up(now_ns)
    return beacon(sender, now_ns)._replace(silent=known.silent(now_ns), unheard=unheard)


def test_who_is_not_heard_is_told_of_for_ever_with_the_way_that_it_may_stand_on():
    for wait in (S, 3600 * S):
        knows = heard(peers(horizon_s=0.5), message(2, 5, T0, position=(1.0, 2.0), velocity=(0.5, 0.0)))
        assert knows.silent(T0 + 2 * PERIOD) == ()
        new = peers(starts={2: (0.0, 0.0)})
        (row,) = knows.silent(T0 + wait)
        assert row[:7] == (2, T0, True, 1.0, 2.0, 0.5, 0.0)
        assert new.accept_beacon(told(knows, T0 + wait), T0 + wait + PERIOD) is None
        assert new.get(2).age_ns(T0 + S) is None  # an edge needs hand states
        assert new.get(2).time_ns == T0
        (there,) = new.belief(new.get(2)).stretches
        for each in knows.belief(knows.get(2)).stretches:
            assert there.distance(each.x, each.y) + each.radius <= there.radius + 1e-9
        assert new.silent(T0 + wait + S)[0][:7] == row[:7]  # and told on


def test_one_deaf_to_a_robot_is_told_of_it_by_those_who_hear_it():
    hears = heard(peers(), message(2, 5, T0, position=(1.0, 2.0), velocity=(0.5, 0.0)))
    assert hears.silent(T0 + PERIOD) == ()
    deaf = beacon(3, T0 + PERIOD)._replace(unheard=(2, 1))
    assert hears.accept_beacon(deaf, T0 + 2 * PERIOD) is None
    (row,) = hears.silent(T0 + 2 * PERIOD)
    assert row == (2, T0, True, 1.0, 2.0, 0.5, 0.0, 1.0, 2.0, 0.0)
    assert hears.get(3).deaf  # to robot 1, whose peers these are
    assert hears.accept_beacon(beacon(3, T0 + 5 * PERIOD), T0 + 6 * PERIOD) is None
    assert not hears.get(3).deaf


def test_hearsay_is_no_news_of_who_was_heard_since_nor_of_oneself():
    known = heard(peers(), message(2, 5, T0 + S, position=(1.0, 2.0)), now_ns=T0 + 2 * S)
    row = (T0, True, 9.0, 9.0, 0.0, 0.0, 9.0, 9.0, 0.0)
    future = T0 + 3 * S, *row[1:]
    rows = (2, *row), (1, *row), (5, *future)
    said = beacon(3, T0 + 2 * S)._replace(silent=tuple(map(Silent._make, rows)))
    assert known.accept_beacon(said, T0 + 2 * S + PERIOD) is None
    assert predicted(known, 2, T0 + S).position == (1.0, 2.0)
    assert {peer.robot for peer in known.known if peer.message is not None} == {2, 3}


def test_who_comes_into_a_drive_has_to_be_told_of_all():
    there = peers(starts={2: (1.5, -2.0), 3: (0.0, 3.0), 4: (9.0, 0.0)})
    new = peers(starts={2: (1.5, -2.0), 3: (0.0, 3.0), 4: (9.0, 0.0)})
    assert there.silent(T0) == (), "before the drive nothing is said of who never came"
    for known in (there, new):
        known.forecast.epoch_ns = T0 + S
    there.begin(T0)
    now = T0 + 30 * S
    heard(there, message(4, 5, T0 + 9 * S), now_ns=T0 + 9 * S + PERIOD)
    assert there.unknown == []
    new.begin(now)
    assert new.unknown == [2, 3, 4]
    assert new.silent(now) == (), "it does not know whether they never came"
    assert new.accept_beacon(told(there, now), now + PERIOD) is None
    assert new.unknown == []
    assert new.get(2).message is None, "it is looked for on its way from its start"
    on = {row.robot: row.time_ns for row in new.silent(now + 2 * PERIOD)}
    assert (on[2], on[4]) == (NEVER_CAME_NS, T0 + 9 * S), "and told on"


def test_who_was_carried_off_need_not_be_known():
    new = peers(starts={2: (1.5, -2.0)})
    new.begin(T0 + S)
    assert new.unknown == [2]
    new.remove([Removed(2, T0 + S)])
    assert new.unknown == []


def test_of_many_silent_robots_all_are_told_in_turn():
    known = peers()
    robots = range(2, 3 + 2 * SILENT_MAX)
    for robot in robots:
        heard(known, message(robot, 5, T0, position=(float(robot), 0.0)))
    said = {row.robot for _ in range(3) for row in known.silent(T0 + 2 * S)}
    assert said == set(robots)
    assert len(known.silent(T0 + 2 * S)) == SILENT_MAX
    new = peers()
    assert new.rounds_to_tell == 0
    assert new.accept_beacon(beacon(3, T0)._replace(unheard=tuple(robots)), T0 + PERIOD) is None
    assert new.rounds_to_tell == 3


def test_a_robot_is_given_up_when_nothing_has_come_from_itself_for_long():
    known = peers(horizon_s=1.0, starts={2: (0.0, 0.0), 4: (1.0, 0.0)})
    known.begin(T0)
    heard(known, message(2, 5, T0 + S), now_ns=T0 + S + PERIOD)
    assert known.given_up(T0 + S) == ()
    assert known.given_up(T0 + S + 2 * PERIOD) == (4,)  # never heard since the start
    assert known.given_up(T0 + 3 * S) == (2, 4)


def test_a_body_that_was_carried_off_is_nowhere_until_it_is_heard_again():
    known = heard(peers(starts={4: (1.0, 0.0)}), message(2, 5, T0))
    known.remove([Removed(2, T0 + S), Removed(4, T0), Removed(1, T0)])
    for robot in (2, 4):
        assert known.get(robot).is_gone
        assert known.belief(known.get(robot)) is None
    assert known.silent(T0 + 10 * S) == ()
    row = Silent(2, T0 + S // 2, True, 9.0, 9.0, 0.0, 0.0, 9.0, 9.0, 0.0)  # of one who has not heard of it
    assert known.accept_beacon(beacon(3, T0 + 10 * S)._replace(silent=(row,)), T0 + 11 * S) is None
    assert known.get(2).is_gone
    heard(known, message(2, 6, T0 + 2 * S), now_ns=T0 + 2 * S + PERIOD)
    assert not known.get(2).is_gone
    assert known.belief(known.get(2)) is not None
    known.remove([Removed(2, T0 + 3 * S)])  # a second time
    assert known.get(2).is_gone


@pytest.mark.parametrize("by", ["hand state", "beacon"])
def test_who_is_heard_is_there_though_its_clock_be_behind_the_operators(by: str):
    """Later missions say again what the first one said: that takes nobody away a second time."""
    known = heard(peers(), message(2, 5, T0))
    removed = [Removed(2, T0 + 60 * S)]
    known.remove(removed)
    assert known.get(2).is_gone
    if by == "beacon":
        assert known.accept_beacon(beacon(2, T0 + S), T0 + S + PERIOD) is None
    else:
        heard(known, message(2, 6, T0 + S), now_ns=T0 + S + PERIOD)
    assert not known.get(2).is_gone
    known.remove(removed)
    assert not known.get(2).is_gone
