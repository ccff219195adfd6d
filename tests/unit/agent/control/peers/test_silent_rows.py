"""What others tell of those who are not heard."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.rolling import Rolls, arc, arc_of, middle
from handfast.agent.control.peers.silent import ROWS_OF_MANY
from handfast.agent.messages.types import SILENT_MAX, Beacon, HandState, Silent
from tests.unit.agent.control.peers.neighbours import (
    PERIOD,
    T0,
    S,
    beacon,
    heard,
    message,
    peers,
    predicted,
    rows,
)


def told(known: Peers, now_ns: int, sender: int = 3) -> Beacon:
    """What robot `sender`, who knows what `known` does, says of the silent."""
    unheard = known.given_up(now_ns)
    return beacon(sender, now_ns)._replace(silent=rows(known, now_ns), unheard=unheard)


def test_who_is_not_heard_is_told_of_for_ever_with_the_way_that_it_may_stand_on():
    for wait in (S, 3600 * S):
        knows = heard(peers(horizon_s=0.5), message(2, 5, T0, position=(1.0, 2.0), velocity=(0.5, 0.0)))
        assert rows(knows, T0 + 2 * PERIOD) == ()
        new = peers(starts={2: (0.0, 0.0)})
        (row,) = rows(knows, T0 + wait)
        assert row[:7] == (2, T0, True, 1.0, 2.0, 0.5, 0.0)
        assert new.accept_beacon(told(knows, T0 + wait), T0 + wait + PERIOD) is None
        assert new.get(2).age_ns(T0 + S) is None  # an edge needs hand states
        assert new.get(2).time_ns == T0
        (there,) = new.whereabouts.belief(new.get(2)).stretches
        for each in knows.whereabouts.belief(knows.get(2)).stretches:
            assert there.distance(each.x, each.y) + each.radius <= there.radius + 1e-9
        assert rows(new, T0 + wait + S)[0][:7] == row[:7]  # and told on


@pytest.mark.parametrize("wait", [S // 2, 3 * S])
def test_where_the_body_of_a_silent_one_rolls_to_is_passed_on(wait: int) -> None:
    """By those who heard it last: another that had only its beacon would look for it elsewhere."""
    rolls = {"rolls_on": {2: Rolls(3.5, 0.4)}, "horizon_s": 1.0}
    obeys = ((0.5, 1.0, 0.9),)
    said = message(2, 5, T0, position=(1.0, 2.0), velocity=(0.7, 0.6))._replace(obeys=obeys)
    knows, new = heard(peers(**rolls), said), peers(starts={2: (0.0, 0.0)}, **rolls)
    silent = rows(knows, T0 + wait)
    rolling = tuple(knows.rolling(silent))
    assert rolling == ((2, *obeys[0]),)
    beacon_of_3 = told(knows, T0 + wait)._replace(rolling=rolling)
    assert new.accept_beacon(beacon_of_3, T0 + wait + PERIOD) is None
    assert new.get(2).message.obeys == obeys
    belief = new.whereabouts.belief(new.get(2))
    for age, x, y in arc_of(said, Rolls(3.5, 0.4)):
        assert any(
            each.after <= age + 1e-9 and each.distance(x, y) <= each.radius for each in belief.stretches
        )
    if wait > S:  # the straight way that is told does not have the arc in it as well: it would say nothing
        assert max(each.radius for each in belief.stretches) < 0.9
    assert rows(new, T0 + wait + S)[0][:7] == silent[0][:7], "and told on"
    assert tuple(new.rolling(rows(new, T0 + wait + S))) == rolling


def test_of_one_that_has_said_that_it_is_somewhere_on_its_way_others_know_that_way() -> None:
    """Its bridge died, and then its agent fell silent: whoever had no word from it hears that from others."""
    rolls = {"rolls_on": {2: Rolls(3.5, 0.4)}, "horizon_s": 1.0}
    obeys = (0.5, 1.0, 0.9)
    way = arc(1.0, 2.0, obeys, Rolls(3.5, 0.4))
    circle = HandState.placed(2, 5, T0, False, 1, (*middle(way), 0.0, 0.0), 1.8, (obeys,))
    knows, new = heard(peers(**rolls), circle), peers(starts={2: (0.0, 0.0)}, **rolls)
    silent = rows(knows, T0 + 5 * S)
    beacon_of_3 = told(knows, T0 + 5 * S)._replace(rolling=tuple(knows.rolling(silent)))
    assert new.accept_beacon(beacon_of_3, T0 + 5 * S + PERIOD) is None
    for each in (knows, new):
        belief = each.whereabouts.belief(each.get(2))
        assert belief is not None
        assert max(stretch.radius for stretch in belief.stretches) < 0.4
        for _, x, y in way:
            assert any(stretch.distance(x, y) <= stretch.radius for stretch in belief.stretches)


def test_one_deaf_to_a_robot_is_told_of_it_by_those_who_hear_it():
    hears = heard(peers(), message(2, 5, T0, position=(1.0, 2.0), velocity=(0.5, 0.0)))
    assert rows(hears, T0 + PERIOD) == ()
    deaf = beacon(3, T0 + PERIOD)._replace(unheard=(2, 1))
    assert hears.accept_beacon(deaf, T0 + 2 * PERIOD) is None
    (row,) = rows(hears, T0 + 2 * PERIOD)
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


def test_of_many_silent_robots_all_are_told_in_turn():
    known = peers()
    robots = range(2, 3 + 2 * SILENT_MAX)
    for robot in robots:
        heard(known, message(robot, 5, T0, position=(float(robot), 0.0)))
    said = {row.robot for _ in range(3) for row in rows(known, T0 + 2 * S)}
    assert said == set(robots)
    assert len(rows(known, T0 + 2 * S)) == SILENT_MAX
    new = peers()
    assert new.rows.rounds_to_tell == 0
    assert new.accept_beacon(beacon(3, T0)._replace(unheard=tuple(robots)), T0 + PERIOD) is None
    assert new.rows.rounds_to_tell == 3
    assert new.accept_beacon(beacon(3, T0 + S)._replace(unheard=(2,)), T0 + S + PERIOD) is None
    assert new.rows.rounds_to_tell == 1, "it hears the others by now: of those nobody needs to be told"


def large(**options: Any) -> Peers:
    """Of a fleet so large that beacons are seldom."""
    return peers(beacon_ns=S // 5, beacon_max_ns=4 * S, **options)


def test_in_a_large_fleet_who_listens_to_a_robot_tells_of_it_and_the_others_of_a_few():
    """If all told of all, in a fleet in trouble everybody would tell everybody of everybody."""
    known, robots = large(horizon_s=1.0), tuple(range(2, 12))
    for robot in robots:
        heard(known, message(robot, 5, T0, position=(float(robot), 0.0)))
    known.listen({2, 3, 4, 5}, T0 + PERIOD)
    now_ns = T0 + S - PERIOD
    for _ in range(2):
        told = [row.robot for row in rows(known, now_ns)]
        assert set(told) >= {2, 3, 4, 5}
        assert len(told) == 4 + ROWS_OF_MANY
    seen = {row.robot for _ in range(4) for row in rows(known, now_ns)}
    assert seen == set(robots), "and yet everybody's turn comes"
