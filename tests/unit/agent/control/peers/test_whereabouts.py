"""Where those may be who are not heard."""

from __future__ import annotations

from handfast.agent.control.peers.lateness import UNSURE_NS
from tests.unit.agent.control.peers.neighbours import (
    PERIOD,
    T0,
    S,
    heard,
    message,
    peers,
    standing,
)


def test_who_is_silent_may_be_anywhere_on_its_way_since():
    known = heard(peers(horizon_s=1.0), message(2, 5, T0, position=(1.0, 0.0), velocity=(0.5, 0.0)))
    peer = known.get(2)
    assert peer.is_heard(T0 + UNSURE_NS - PERIOD)
    assert not peer.is_heard(T0 + 2 * UNSURE_NS)
    belief = known.whereabouts.belief(peer)
    for share in (0.0, 0.2, 0.5, 0.75, 1.0):  # a way with a bend
        x, y = known.predict(peer, round(T0 + share * 2 * S)).position
        assert any(each.distance(x, y) <= each.radius_at(share * 2.0) + 0.01 for each in belief.stretches)
    assert known.whereabouts.belief(peer) is belief  # made once
    peer.here = False  # it brakes, or has only been cut off
    assert not peer.is_heard(T0 + PERIOD)
    assert known.whereabouts.belief(peer) is belief


def test_who_stood_and_was_not_following_may_have_begun_to():
    known = heard(peers(standing, horizon_s=1.0), message(2, 5, T0, follows=False))
    belief = known.whereabouts.belief(known.get(2))
    assert len(belief.stretches) > 1
    gone = heard(peers(standing, horizon_s=1.0), message(7, 5, T0, follows=False))  # it has no place
    assert len(gone.whereabouts.belief(gone.get(7)).stretches) == 1


def test_who_was_driven_by_somebody_else_may_have_been_driven_on():
    stood = heard(peers(), message(7, 5, T0, follows=False, position=(1.0, 0.0), velocity=(0.0, 0.0)))
    drove = heard(peers(), message(7, 5, T0, follows=False, position=(1.0, 0.0), velocity=(0.8, 0.0)))
    (there,) = stood.whereabouts.belief(stood.get(7)).stretches
    wide, *_ = drove.whereabouts.belief(drove.get(7)).stretches
    assert wide.radius >= there.radius + 0.8


def test_who_was_never_heard_is_where_it_starts():
    known = peers(starts={2: (1.5, -2.0)})
    (there,) = known.whereabouts.belief(known.get(2)).stretches
    assert there[:5] == (1.5, -2.0, 0.0, 0.0, 0.0)
    assert known.whereabouts.belief(known.get(7)) is None
    heard(known, message(2, 5, T0, position=(9.0, 0.0)))
    assert known.whereabouts.belief(known.get(2)).stretches[0].x > 5.0
