"""What a robot knows of the others: how it carries them forward, and whom it trusts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handfast.agent.control.law import acting_error
from handfast.agent.control.peers.lateness import LATE_MAX_NS, STOOD_KEPT_NS, UNSURE_NS
from handfast.agent.control.peers.peers import TRUST_GAINED_S, TRUST_LOST_S, Peers
from handfast.agent.control.peers.prediction import as_it_came, coasting, following, transition
from handfast.agent.messages.types import HandState, Removed, Silent
from tests.unit.agent.control.peers.neighbours import (
    C1,
    C2,
    OFFSETS,
    PERIOD,
    T0,
    S,
    ages,
    beacon,
    circling,
    heard,
    message,
    peers,
    predicted,
    rows,
    standing,
)
from tests.values import values

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
        step = transition(C1, C2, 0.9, 0.5)
        expected = following(said[robot], then, since, 0.5, C1, C2, 0.9, None, 0.0, step)
        assert values(predicted(known, robot, T0 + PERIOD + S // 2)) == values(expected)


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
    assert values(predicted(known, 2, T0 + S)) == values(coasting(braking, 2.0))
    assert values(predicted(known, 5, T0 + S)) != values(coasting(message(5), 1.0))


def test_a_robot_whose_process_is_gone_brakes():
    """Its plant sees to that; it follows again when it has been heard again, not by its token alone."""
    said = message(2, 0, T0, True, (1.0, 2.0), (0.5, 0.0))
    known = heard(peers(), said)
    known.present(2, False)
    assert values(predicted(known, 2, T0 + S)) == values(coasting(said, 1.0))
    known.present(2, True)
    assert not known.get(2).here
    assert values(predicted(known, 2, T0 + S)) == values(coasting(said, 1.0))
    again = said._replace(time_ns=T0 + 2 * PERIOD)
    heard(known, again, now_ns=T0 + 3 * PERIOD)
    assert known.get(2).here
    assert values(predicted(known, 2, T0 + S)) != values(coasting(again, 0.96))


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
    assert values(predicted(known, 2, T0 + age_ns)) == values(as_it_came(said))
    assert values(predicted(known, 5, T0 + age_ns)) == values(coasting(said, 0.0))


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


@pytest.mark.parametrize("stands", [True, False])
def test_a_robot_whose_process_stands_now_and_then_is_silent_and_not_late(stands: bool):
    """Its body brakes meanwhile: predicted as one that drives on, it would be where nobody looks for it."""
    known, stamp = peers(), T0
    for k in range(200):
        stamp += 8 * PERIOD if k % 12 == 11 else PERIOD
        stood_ms = 140 if stands and k % 12 == 11 else 0
        heard(known, message(2, k, stamp)._replace(stood_ms=stood_ms), now_ns=stamp + PERIOD)
    lateness = known.get(2).lateness
    if stands:
        assert lateness.forgiven_ns == 0
    else:  # lost by its link, they are what is usual there
        assert lateness.forgiven_ns > S // 2


@pytest.mark.parametrize("stands", [True, False])
def test_what_waited_while_the_own_process_stood_was_not_late(stands: bool):
    known, now = peers(), T0
    for k in range(60):
        now = T0 + (k + 1) * PERIOD
        if 20 <= k < 50:
            continue  # it stands, and they wait
        known.stood = stands and k == 50
        for number in range(20, 51) if k == 50 else (k,):
            heard(known, message(2, number, T0 + number * PERIOD), now_ns=now)
        if k == 50:
            assert (known.get(2).lateness.forgiven_ns > 0) is not stands
    assert known.get(2).lost == 0


@pytest.mark.parametrize("beacons", [False, True])
@pytest.mark.parametrize("stood_ms", [0, 99, 100])
def test_nothing_is_forgiven_the_late_link_of_a_robot_that_stood_lately(stood_ms: int, beacons: bool):
    """The next time it may have braked, and would be predicted as driving on."""
    known, late_ns = peers(), 8 * S // 10
    for k in range(100):
        stamp = T0 + k * PERIOD
        heard(known, message(2, k, stamp), now_ns=stamp + late_ns)
    lateness = known.get(2).lateness
    assert lateness.forgiven_ns > S // 2
    stamp += PERIOD
    said = message(2, 100, stamp)._replace(stood_ms=stood_ms)
    if beacons:
        known.accept_beacon(beacon(2, stamp)._replace(stood_ms=stood_ms), stamp + late_ns)
        stamp += PERIOD  # what it says next has nothing of it any more
        said = message(2, 101, stamp)
    heard(known, said, now_ns=stamp + late_ns)
    assert (lateness.forgiven_ns > S // 2) is (stood_ms < 100)
    for k in range(round(STOOD_KEPT_NS / PERIOD) + 1):
        stamp += PERIOD
        heard(known, message(2, 102 + k, stamp), now_ns=stamp + late_ns)
        if k == 100 and stood_ms >= 100:
            assert lateness.forgiven_ns == 0
    assert lateness.forgiven_ns > S // 2


@pytest.mark.parametrize(
    ("rate_hz", "full_hz"), [(2.0, 2.0), (3.0, 3.0), (4.0, 4.0), (4.0, 16.0), (5.0, 5.0), (5.0, 20.0)]
)
def test_who_is_in_time_is_heard_at_any_rate_though_processes_stood(rate_hz: float, full_hz: float):
    """At 4 Hz a message is a period old at the next tick: 0.25 s, after which one may have stopped."""
    period = round(S / rate_hz)
    known = peers(period_ns=round(S / full_hz))
    known.keep_pace(period)
    known.stood_until_ns = T0 + S  # and says so
    stamp = T0
    for k in range(8):
        stamp = T0 + k * period
        heard(known, message(2, k, stamp)._replace(stood_ms=150), now_ns=stamp + period)
    peer = known.get(2)
    assert peer.is_heard(stamp + period)
    assert not peer.is_heard(stamp + 2 * period)


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_of_whom_only_beacons_are_listened_to_two_may_be_lost(late_s: float):
    """Where hand states were lost, beacons are, and they are rarer."""
    known, late_ns = peers(beacon_ns=S // 5), round(late_s * S)
    for k in range(400):
        if k % 4:
            heard(known, message(2, k, T0 + k * PERIOD), now_ns=T0 + k * PERIOD + late_ns)
    now = T0 + 399 * PERIOD + late_ns
    known.ignore(2)
    peer = known.get(2)
    assert peer.is_heard(now + S // 2)
    for k in range(1, 5):  # some hand states were still on their way
        heard(known, message(2, 1000 + k, now + k * PERIOD), now_ns=now + k * PERIOD + late_ns)
    now += S // 2
    assert known.accept_beacon(beacon(2, now), now + late_ns + PERIOD) is None
    assert peer.is_heard(now + late_ns + 3 * S // 5)
    assert not peer.is_heard(now + late_ns + 3 * S)


def test_no_more_than_so_much_is_forgiven():
    known = peers()
    stream(known, 2, 60, 9 * S)
    assert known.get(2).lateness.forgiven_ns == LATE_MAX_NS


# ---------------------------------------------------------------------- multipliers and degrees


# ---------------------------------------------------------------------- beacons that come seldom


def seldom(known: Peers, stamp: int, next_ms: int = 2000, robot: int = 2, late_ns: int = PERIOD) -> int:
    """A beacon that says when the next one comes; when that is."""
    told = beacon(robot, stamp)._replace(next_ms=next_ms)
    assert known.accept_beacon(told, stamp + late_ns) is None
    return stamp + next_ms * S // 1000


def test_within_what_a_robot_said_it_is_not_silent():
    known = peers(beacon_ns=S // 5, beacon_max_ns=2 * S)
    due = seldom(known, T0)
    peer = known.get(2)
    assert peer.is_heard(due)
    assert rows(known, due) == ()
    assert not peer.is_heard(due + S)
    due = seldom(known, due, 400)
    assert not peer.is_heard(due + S // 2), "it has something to tell: the next comes soon"
    assert peer.is_heard(seldom(known, due))


def test_where_messages_are_lost_more_is_forgiven_one_that_speaks_seldom():
    """So that two that are lost in a row do not make it silent, nor ten."""
    known, peer, stamp = peers(beacon_ns=S // 5, beacon_max_ns=2 * S), None, T0
    for k in range(60):
        stamp += 2 * S
        if k % 5 not in (3, 4):
            seldom(known, stamp)
    peer = known.get(2)
    assert LATE_MAX_NS < peer.lateness.forgiven_ns <= LATE_MAX_NS + 2 * (2 * S - S // 5)


def test_who_begins_to_be_listened_to_must_be_heard_at_once():
    """What is known of it is old by as much as it said, and what comes now is not."""
    known = peers(beacon_ns=S // 5, beacon_max_ns=2 * S)
    now = seldom(known, T0) - S
    known.listen({2}, now)
    peer = known.get(2)
    assert peer.is_heard(now + UNSURE_NS + PERIOD), "a message takes a period"
    assert not peer.is_heard(now + UNSURE_NS + 4 * PERIOD)
    heard(known, message(2, 5, now), now_ns=now + PERIOD)
    assert peer.is_heard(now + UNSURE_NS - PERIOD)
    assert not peer.is_heard(now + UNSURE_NS + PERIOD)


def test_beacons_alone_are_not_enough_of_one_that_is_listened_to():
    known = peers(beacon_ns=S // 5, beacon_max_ns=2 * S)
    known.get(2)
    known.listen({2}, T0)
    due = seldom(known, T0 + S)
    due = seldom(known, due)
    assert not known.get(2).is_heard(due)
    known.ignore(2)
    assert known.get(2).is_heard(due)


def test_whoever_has_just_started_says_of_nobody_that_it_does_not_hear_him_before_he_had_to_speak():
    known = peers(beacon_ns=S // 5, beacon_max_ns=2 * S, horizon_s=1.0)
    known.begin(T0)
    known.get(2)
    assert known.given_up(T0 + S + 17 * S // 10) == ()
    assert known.given_up(T0 + S + 19 * S // 10) == (2,)


def test_whom_another_does_not_hear_he_is_told_of_until_he_speaks_again():
    known = peers(beacon_ns=S // 5, beacon_max_ns=2 * S)
    seldom(known, T0 - S)
    told = beacon(5, T0)._replace(next_ms=2000, unheard=(2, 99))
    assert known.accept_beacon(told, T0 + PERIOD) is None
    seldom(known, T0 + S)
    assert [row.robot for row in rows(known, T0 + 2 * S)] == [2], "heard here, and told of to robot 5"
    seldom(known, T0 + 2 * S, robot=5)
    assert [row.robot for row in rows(known, T0 + 29 * S // 10)] == [2]
    seldom(known, T0 + 3 * S)
    assert rows(known, T0 + 31 * S // 10) == ()


# ---------------------------------------------------------------------- promises


def promising(time_ns: int, periods: int, rounds: int = 0, **fields: Any) -> HandState:
    """A hand state of robot 2 that promises the next one within so many periods."""
    return message(2, rounds, time_ns, **fields)._replace(next_ms=periods * PERIOD // 1_000_000)


def test_within_a_promise_a_beacon_brings_the_place_and_leaves_the_forces():
    known = peers(standing, bound_m=0.005, decay=0.9)
    said = promising(T0, 50, position=(3.0, 4.0), constraint=(0.4, 0.0))
    heard(known, said)
    then_ns = T0 + 10 * PERIOD
    known.accept_beacon(beacon(2, then_ns, (3.1, 4.0), (0.2, 0.0)), then_ns + PERIOD)
    found = predicted(known, 2, then_ns)
    assert (found.position, found.velocity) == ((3.1, 4.0), (0.2, 0.0))
    assert found.constraint[0] == pytest.approx(
        predicted(heard(peers(standing, decay=0.9), said), 2, then_ns).constraint[0]
    )
    assert found.constraint[0] == pytest.approx(0.4 * np.exp(-0.9 * 0.2))


def test_a_beacon_of_one_that_does_not_follow_any_more_leaves_no_forces():
    known = peers(standing, bound_m=0.005, decay=0.9)
    heard(known, promising(T0, 50, position=(3.0, 4.0), constraint=(0.4, 0.0)))
    then_ns = T0 + 10 * PERIOD
    known.accept_beacon(beacon(2, then_ns, follows=False), then_ns + PERIOD)
    assert predicted(known, 2, then_ns).constraint == (0.0, 0.0)


# ---------------------------------------------------------------------- lower rates, late ticks


def test_who_may_have_spoken_while_the_own_process_stood_is_not_given_up() -> None:
    known = peers(horizon_s=1.0)
    heard(known, message(2, 0, T0), message(3, 0, T0))
    later = T0 + 2 * S
    assert set(known.given_up(later)) >= {2, 3}
    known.missed_ns = lambda since_ns: S + PERIOD
    assert set(known.given_up(later)) == set()


# ---------------------------------------------------------------------- given up, carried off


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
        assert known.whereabouts.belief(known.get(robot)) is None
    assert rows(known, T0 + 10 * S) == ()
    row = Silent(2, T0 + S // 2, True, 9.0, 9.0, 0.0, 0.0, 9.0, 9.0, 0.0)  # of one who has not heard of it
    assert known.accept_beacon(beacon(3, T0 + 10 * S)._replace(silent=(row,)), T0 + 11 * S) is None
    assert known.get(2).is_gone
    heard(known, message(2, 6, T0 + 2 * S), now_ns=T0 + 2 * S + PERIOD)
    assert not known.get(2).is_gone
    assert known.whereabouts.belief(known.get(2)) is not None
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
