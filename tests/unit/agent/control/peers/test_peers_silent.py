"""Where those may be who are not heard, and what others tell of them."""

from __future__ import annotations

import pytest

from agent.control.peers.lateness import UNSURE_NS
from agent.control.peers.peers import (
    NEVER_CAME_NS,
    TELLS_NS,
    Peers,
)
from agent.messages.types import SILENT_MAX, Beacon, Removed, Silent
from tests.unit.agent.control.peers.neighbours import (
    PERIOD,
    T0,
    S,
    beacon,
    heard,
    message,
    peers,
    predicted,
    standing,
)

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
    assert new.accept_beacon(beacon(3, T0 + S)._replace(unheard=(2,)), T0 + S + PERIOD) is None
    assert new.rounds_to_tell == 1, "it hears the others by now: of those nobody needs to be told"


def test_nobody_is_told_of_before_a_mission_is_near():
    known = heard(peers(), message(2, 5, T0, position=(1.0, 0.0)))
    now_ns = T0 + 10 * S
    assert known.tells(now_ns)
    assert [row.robot for row in known.silent(now_ns)] == [2]
    for epoch_ns in (0, now_ns + TELLS_NS + 1):
        known.forecast.epoch_ns = epoch_ns
        assert not known.tells(now_ns)
        assert known.silent(now_ns) == ()
    known.forecast.epoch_ns = now_ns + TELLS_NS
    assert [row.robot for row in known.silent(now_ns)] == [2]


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
