"""Which vehicles roll on of those that robot 1 does not hear."""

from __future__ import annotations

import pytest

from agent.control.peers.peers import Peers
from agent.control.peers.rolling import Rolls
from agent.messages.types import HandState
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
