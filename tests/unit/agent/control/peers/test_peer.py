"""How far what was heard of one robot is to be trusted."""

from __future__ import annotations

import pytest

from agent.control.peers.beliefs import DOUBT_AFTER_S, DOUBT_MAX, DOUBT_RATE
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


def test_how_far_it_may_be_off_meanwhile_is_doubt():
    known = peers(bound_m=0.005)
    heard(known, message(2, 0, T0)._replace(next_ms=50))
    assert known.get(2).doubt(T0) == 0.005
    heard(known, message(2, 1, T0 + PERIOD), now_ns=T0 + 2 * PERIOD)
    assert known.get(2).doubt(T0 + PERIOD) == 0.0
