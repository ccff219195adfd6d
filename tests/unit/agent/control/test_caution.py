"""How fast a robot goes among others that it knows by late messages alone."""

from __future__ import annotations

from math import inf

import pytest

from handfast.agent.control.caution import PACE, Caution
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peers import Peers
from handfast.agent.formation.reference import Instant
from handfast.agent.messages.types import HandState

pytestmark = pytest.mark.patches

S = 1_000_000_000
T0 = 1000 * S
C1, C2, MOST = 0.4, 1.2, 1.0


class Places:
    """Where two robots are to be: each at the other's start, or at its own."""

    def __init__(self, one: tuple[float, float], other: tuple[float, float]) -> None:
        self.places = {1: one, 2: other}

    def instant(self, _time_ns: int) -> Instant:
        return Instant((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), self.places)


def look(
    places: Places,
    late_s: float,
    at: tuple[float, float] = (3.0, 0.0),
    turned: float = 0.0,
    most: float = 2.0 * MOST,
) -> Caution:
    """Robot 1 at (-3, 0) hears robot 2 there, late by so much as usual."""
    peers = Peers(1, C1, C2, S // 50, places.instant, most=MOST)
    peers.forecast.epoch_ns = T0
    now = T0 + 10 * S
    message = HandState.placed(2, 5, now - round(late_s * S), True, 1, (*at, 0.0, 0.0))
    assert peers.accept(message._replace(correction_y=turned), now) is None
    lateness = peers.get(2).lateness
    lateness.forgiven_ns = max(0, round(late_s * S) - UNSURE_NS // 2)
    lateness.usual_ns = round(late_s * S) if lateness.forgiven_ns else 0
    caution = Caution(1, 0.27, peers, places, most)  # type: ignore[arg-type]
    caution.look(now, Hand(-3.0, 0.0, 0.0, 0.0), [peers.get(2)])
    return caution


APART, THROUGH = Places((-3.0, 0.0), (3.0, 0.0)), Places((3.0, 0.0), (-3.0, 0.0))


def test_two_whose_ways_meet_go_slowly_where_messages_are_late() -> None:
    for late_s in (1.0, 1.5):
        caution = look(THROUGH, late_s, (-1.0, 0.0))
        assert caution.speed == pytest.approx(PACE / late_s**2)
        peer = next(iter(caution._peers.known))
        assert (peer.slowly, peer.slowly_until_ns > T0 + 10 * S) == (caution.speed, True)


def test_it_is_not_even_looked_for_where_it_would_leave_them_as_fast_as_they_are() -> None:
    """At 5 Hz all that is known of others is half a second old, though no link is late."""
    late_s = 1.0
    slow, fast = look(THROUGH, late_s, (-1.0, 0.0), most=0.9 * PACE), look(THROUGH, late_s, (-1.0, 0.0))
    assert (slow.speed, fast.speed) == (inf, pytest.approx(PACE))
    assert next(iter(slow._peers.known)).slowly == inf


def test_where_messages_come_in_time_nobody_does() -> None:
    caution = look(THROUGH, 0.02, (-1.0, 0.0))
    assert caution.speed == inf
    assert next(iter(caution._peers.known)).slowly == inf


def test_nor_where_ways_do_not_meet_or_not_soon() -> None:
    assert look(APART, 1.0).speed == inf
    assert look(THROUGH, 1.0, (30.0, 0.0)).speed == inf


def test_places_that_are_near_each_other_are_no_meeting() -> None:
    assert look(Places((-3.0, 0.0), (-2.7, 0.0)), 1.0, (-2.7, 0.0)).speed == inf


def test_who_makes_way_for_others_is_expected_to_be_slow() -> None:
    caution = look(APART, 1.0, turned=0.5)
    assert caution.speed == inf
    assert next(iter(caution._peers.known)).slowly < inf


def test_it_ends_when_ways_have_not_met_for_as_long_as_messages_take() -> None:
    caution = look(THROUGH, 1.0, (-1.0, 0.0))
    now, here = T0 + 10 * S, Hand(-3.0, 0.0, 0.0, 0.0)
    caution.look(now + S // 2, here, [])
    assert caution.speed < inf
    caution.look(now + 2 * S, here, [])
    assert caution.speed == inf


def test_slow_robots_are_predicted_no_further_than_they_may_go() -> None:
    peers = look(THROUGH, 1.5, (-1.0, 0.0))._peers
    now, peer = T0 + 10 * S, peers.get(2)
    found = peers.carry(peer, now)
    assert -1.0 - PACE / 1.5 <= found.position[0] < -1.15
    assert abs(found.velocity[0]) < 1.01 * peer.slowly
    peer.slowly_until_ns = 0  # as fast as the law says
    free = peers.carry(peer, now)
    assert free.position[0] < found.position[0]
