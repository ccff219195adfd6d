"""How far what was heard of one robot is to be trusted."""

from __future__ import annotations

import pytest

from handfast.agent.control.peers.beliefs import DOUBT_AFTER_S, DOUBT_MAX, DOUBT_RATE
from handfast.agent.control.peers.rolling import Rolls
from tests.unit.agent.control.peers.neighbours import (
    PERIOD,
    T0,
    S,
    beacon,
    heard,
    message,
    peers,
)


def test_doubt_grows_with_silence_and_has_an_end():
    known = heard(peers(), message(2, 0, T0))
    peer = known.get(2)
    assert [peer.doubt(T0 + at) for at in (0, PERIOD, round(DOUBT_AFTER_S * S))] == [0.0] * 3
    assert peer.doubt(T0 + S) == pytest.approx(DOUBT_RATE * (1.0 - DOUBT_AFTER_S))
    assert peer.doubt(T0 + 100 * S) == DOUBT_MAX
    assert known.accept_beacon(beacon(2, T0 + S), T0 + S + PERIOD) is None  # a beacon ends it, too
    assert peer.doubt(T0 + S + PERIOD) == 0.0


ROLLS = Rolls(3.5, 0.4)


@pytest.mark.parametrize(
    ("rolls_on", "follows", "doubt"),
    [({2: ROLLS}, False, 1.5), ({2: ROLLS}, True, DOUBT_MAX), ({5: ROLLS}, False, DOUBT_MAX)],
)
def test_more_doubt_than_usual_is_believed_of_one_whose_body_rolls_on_as_nothing_commands_it(
    rolls_on: dict[int, Rolls], follows: bool, doubt: float
) -> None:
    known = peers(rolls_on=rolls_on)
    heard(known, message(2, 0, T0, follows=follows)._replace(doubt=1.5))
    assert known.get(2).doubt(T0) == doubt
    belief = known.whereabouts.belief(known.get(2))
    assert belief is not None
    assert belief.doubt == doubt


def test_one_rolls_on_that_is_not_heard_until_its_watchdog_has_stopped_it():
    known = peers(rolls_on={2: ROLLS})
    heard(known, message(2, 0, T0, velocity=(1.0, 0.0))._replace(obeys=((0.0, 1.0, 0.1),)))
    peer = known.get(2)
    assert [known.lost.may_roll(peer, T0 + round(at * S)) for at in (0.1, 1.0, 3.4, 3.6)] == [
        False,
        True,
        True,
        False,
    ]
    heard(known, message(2, 1, T0 + PERIOD, velocity=(1.0, 0.0)), now_ns=T0 + 2 * PERIOD)
    assert not known.lost.may_roll(peer, T0 + S), "one that does not say what it obeys"


def test_how_far_it_may_be_off_meanwhile_is_doubt():
    known = peers(bound_m=0.005)
    heard(known, message(2, 0, T0)._replace(next_ms=50))
    assert known.get(2).doubt(T0) == 0.005
    heard(known, message(2, 1, T0 + PERIOD), now_ns=T0 + 2 * PERIOD)
    assert known.get(2).doubt(T0 + PERIOD) == 0.0
