"""Where the own hand is while its plant says so, and for how long after that."""

from __future__ import annotations

from math import inf

import pytest

from agent.common.time import NS_PER_S
from agent.control.controller import Controller
from agent.control.own_hand import LAST_PLACE_NS, OwnHand
from agent.control.peers.prediction import BRAKING_TIME_S
from agent.formation.geometry import resolve
from agent.messages.types import PlantState
from tests.unit.agent.agent_bench import START, fleet

SPEED = 1.0
REACH = 0.1


def own_hand() -> OwnHand:
    made = fleet()
    return OwnHand(Controller(made, resolve(made), 1))


def plant(speed: float = SPEED, x: float = 0.0) -> PlantState:
    return PlantState(1, 0, START, x, 0.0, 0.0, speed, 0.0, 0.0, 0.0, True, True, True, "")


def test_nothing_is_known_before_the_plant_has_said_something():
    own = own_hand()
    own.lost(START)
    assert (own.here, own.shown) == (None, None)


def test_it_is_where_the_plant_says_carried_forward_to_the_tick():
    own = own_hand()
    assert own.measured(START + NS_PER_S // 10, plant())
    assert own.here == own.shown
    assert own.here is not None
    assert own.here.x == pytest.approx(REACH + 0.1 * SPEED)
    assert own.doubt == 0.0


def test_a_place_that_no_message_can_hold_is_none():
    own = own_hand()
    assert not own.measured(START, plant(x=inf))
    assert not own.measured(START, plant(x=1e300))


def test_once_it_is_lost_the_doubt_covers_who_stopped_at_once_and_who_drove_on_and_braked():
    own = own_hand()
    own.measured(START + NS_PER_S // 10, plant())
    for later_ns in range(START + NS_PER_S // 5, START + NS_PER_S, NS_PER_S // 10):
        own.lost(later_ns)
        assert own.here is None
        assert own.shown is not None
        assert own.shown.x - own.doubt == pytest.approx(REACH)
        assert own.shown.x + own.doubt <= REACH + SPEED * (0.1 + BRAKING_TIME_S)
    assert own.shown.vx == pytest.approx(0.0, abs=0.02)
    own.lost(START + NS_PER_S // 10 + LAST_PLACE_NS + 1)
    assert own.shown is None
