"""Which vehicles roll on of those that robot 1 does not hear."""

from __future__ import annotations

import pytest

from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.rolling import Rolls, arc, middle
from handfast.agent.messages.types import HandState, Silent
from tests.unit.agent.control.peers.neighbours import PERIOD, T0, S, heard, message, peers

ROLLS = Rolls(3.5, 0.4)
ALL = {2: ROLLS, 5: ROLLS, 9: ROLLS}


def moving(robot: int, at: int) -> HandState:
    """Robot `robot` drives along x, stamped at the tick `at`."""
    said = message(robot, at, T0 + at * PERIOD, velocity=(1.0, 0.0))
    return said._replace(obeys=((0.0, 1.0, 0.0),))


def lost(robot: int, at: int, doubt: float = 1.7) -> HandState:
    """Its agent says that it does not know where its body is."""
    return message(robot, at, T0 + at * PERIOD, follows=False)._replace(doubt=doubt)


def last_heard(**ticks: int) -> Peers:
    """Robots 2, 5 and 9, each heard at every tick until this one."""
    known = peers(rolls_on=ALL)
    for at in range(max(ticks.values()) + 1):
        for name, last in ticks.items():
            if at <= last:
                heard(known, moving(int(name[1:]), at), now_ns=T0 + (at + 1) * PERIOD)
    return known


def rolling(known: Peers, tick: int) -> set[int]:
    return {peer.robot for peer in known.known if known.lost.may_roll(peer, T0 + tick * PERIOD)}


def sure(known: Peers, tick: int) -> set[int]:
    return {peer.robot for peer in known.known if known.lost.is_sure(peer, T0 + tick * PERIOD)}


def test_while_others_are_heard_who_is_not_is_lost():
    known = last_heard(r2=20, r5=60, r9=60)
    assert rolling(known, 61) == sure(known, 61) == {2}


def test_of_those_that_fall_silent_at_once_any_may_be_lost():
    known = last_heard(r2=20, r5=20, r9=20)
    assert rolling(known, 61) == {2, 5, 9}
    assert sure(known, 61) == set()


def test_whoever_hears_nobody_knows_who_was_lost_before():
    known = last_heard(r2=20, r5=40, r9=40)
    assert rolling(known, 81) == sure(known, 81) == {2}


def test_one_that_has_said_that_nothing_commands_it_is_lost():
    known = last_heard(r2=20, r5=20, r9=20)
    heard(known, lost(2, 25), now_ns=T0 + 26 * PERIOD)
    assert rolling(known, 61) == sure(known, 61) == {2}
    hand = known.lost.hand(known.get(2), T0 + 61 * PERIOD)
    assert hand is not None
    assert hand.x == pytest.approx((61 - 20) * PERIOD / S), (
        "from where it was measured last, not from a circle"
    )


def test_once_that_one_stands_the_others_may_be_lost_again():
    known = last_heard(r2=20, r5=180, r9=180)
    assert sure(known, 20 + 174) == {2}
    assert sure(known, 20 + 176) == set()
    assert rolling(known, 20 + 176) == {5, 9}


def test_one_that_stands_and_is_measured_does_not_roll():
    known = last_heard(r2=20, r5=20, r9=20)
    heard(known, lost(2, 25, doubt=0.0), now_ns=T0 + 26 * PERIOD)
    assert rolling(known, 61) == {5, 9}


def test_one_whose_body_has_been_carried_off_does_not_roll():
    known = last_heard(r2=20, r5=60, r9=60)
    known.get(2).gone_ns = T0 + 30 * PERIOD
    assert rolling(known, 61) == sure(known, 61) == set()


def test_nobody_rolls_whose_body_stops_by_itself():
    known = peers(rolls_on={5: ROLLS, 9: ROLLS})
    heard(known, moving(2, 0))
    assert rolling(known, 61) == set()


def told_lost(at: int, since: int) -> HandState:
    """Robot 2's agent says at the tick `at` that its body was measured last at the tick `since`, in (3, 1):
    from there it rolls along x."""
    way = arc(3.0, 1.0, (0.0, 1.0, 0.0), ROLLS)
    lost_ms = (at - since) * PERIOD // (S // 1000)
    place = (*middle(way), 0.0, 0.0)
    return HandState.placed(2, at, T0 + at * PERIOD, False, 0, place, 2.0, ((0.0, 1.0, 0.0),), lost_ms)


def test_of_one_whose_agent_says_that_its_plant_is_lost_it_is_known_where_it_is() -> None:
    """Though the others, and itself, are heard; and though nobody here had heard how it went before."""
    known = last_heard(r5=60, r9=60)
    assert rolling(known, 60) == set()
    heard(known, told_lost(60, 40), now_ns=T0 + 61 * PERIOD)
    assert rolling(known, 61) == sure(known, 61) == {2}
    peer = known.get(2)
    there = known.lost.hand(peer, T0 + 61 * PERIOD)
    gone_s = 21 * PERIOD / S
    assert there is not None
    assert there == pytest.approx((3.0 + gone_s, 1.0, 1.0, 0.0), abs=2e-3)
    way = known.lost.way(peer, T0 + 61 * PERIOD)
    assert way[0] == pytest.approx(there[:2])
    assert way[10] == pytest.approx((4.0 + gone_s, 1.0), abs=2e-3)
    assert way[-1] == pytest.approx((3.0 + ROLLS.for_s, 1.0))
    rests_ns = T0 + 40 * PERIOD + round(ROLLS.for_s * S)
    assert known.lost.way(peer, rests_ns + PERIOD) == []
    assert 2 not in rolling(known, 40 + round(ROLLS.for_s * S) // PERIOD + 2)


def test_it_is_told_to_those_who_did_not_hear_it() -> None:
    known = last_heard(r5=60, r9=60)
    heard(known, told_lost(60, 40), now_ns=T0 + 61 * PERIOD)
    row = Silent(2, T0 + 60 * PERIOD, False, 4.75, 1.0, 0.0, 0.0, 4.75, 1.0, 2.0)
    assert list(known.rolling([row])) == [(2, 0.0, 1.0, 0.0)]
    assert list(known.lost_of([row])) == [(2, 20 * PERIOD // (S // 1000))]
    assert list(known.lost_of([row._replace(robot=5)])) == []
