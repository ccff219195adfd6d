"""Where the own hand is while its plant says so, and for how long after that."""

from __future__ import annotations

from math import cos, hypot, inf, sin

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.control.own_hand import LAST_PLACE_NS, OwnHand
from handfast.agent.control.peers.prediction import BRAKING_TIME_S
from handfast.agent.control.peers.rolling import (
    ROLL_ERROR,
    SPEED_LAGS,
    SPEED_LEADS_S,
    TURN_LEADS_S,
    TURN_SHARE,
    Rolls,
)
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import PlantState
from tests.unit.agent.agent_bench import START, fleet

SPEED = 1.0
REACH = 0.1
ROLLS_S = 3.5


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


def rolling() -> OwnHand:
    made = fleet()
    return OwnHand(Controller(made, resolve(made), 1), Rolls(ROLLS_S, REACH))


def test_of_a_body_that_rolls_on_all_of_its_way_is_told_at_once_for_as_long_as_it_may_roll():
    """A vehicle obeys its last setpoint for some seconds: nobody can brake it."""
    own = rolling()
    own.measured(START, plant())
    assert own.obeys == ((0.0, SPEED, 0.0),)
    told = []
    rolls_ns = round(ROLLS_S * NS_PER_S)
    for later_ns in (NS_PER_S // 5, NS_PER_S, rolls_ns, rolls_ns + LAST_PLACE_NS):
        own.lost(START + later_ns)
        assert own.shown is not None
        assert own.shown.x - own.doubt == pytest.approx(REACH - ROLL_ERROR)
        assert own.shown.x + own.doubt == pytest.approx(REACH + SPEED * ROLLS_S + ROLL_ERROR)
        assert (own.shown.vx, own.shown.vy) == (0.0, 0.0)
        assert own.obeys == ((0.0, SPEED, 0.0),), "so others know which way it is that this circle is round"
        assert own.lost_ms == later_ns // 1_000_000, "and where on it the body is by now"
        told.append((own.shown, own.doubt))
    assert told == told[:1] * 4
    own.lost(START + rolls_ns + LAST_PLACE_NS + 1)
    assert own.shown is None
    assert own.obeys == ()
    assert own.lost_ms == 0
    own.lost(START + NS_PER_S)
    own.measured(START + NS_PER_S, plant())
    assert own.lost_ms == 0


def test_it_goes_by_what_its_plant_says_that_it_was_asked_for():
    """Not by how it goes: it may have been told to stop, or to go on, a moment before."""
    own = rolling()
    own.measured(START, plant()._replace(asked=((0.0, 0.4),)))
    assert own.obeys == ((0.0, pytest.approx(SPEED_LAGS * SPEED), pytest.approx(TURN_SHARE * 0.4)),)


def test_a_body_that_stands_does_not_roll():
    own = rolling()
    own.measured(START, plant(speed=0.02))
    assert own.obeys == ()
    own.lost(START + NS_PER_S // 5)
    assert own.doubt < 0.01
    own.lost(START + LAST_PLACE_NS + 1)
    assert own.shown is None


@pytest.mark.parametrize("yaw_rate", [-0.8, 0.0, 0.5])
def test_it_rolls_on_the_arc_that_its_last_setpoint_leads_to(yaw_rate: float) -> None:
    """It obeys the speed and yaw rate that what acted on it had begun to give it."""
    own, made = rolling(), fleet()
    body = made.robot(1)
    force, torque = 0.8 * body.mass_kg, 1.0 * body.inertia_kgm2
    own.measured(START, plant()._replace(yaw_rate=yaw_rate, force=force, torque=torque))
    own.lost(START + NS_PER_S // 5)
    assert own.shown is not None
    speed, turning = SPEED + SPEED_LEADS_S * 0.8, yaw_rate + TURN_LEADS_S * 1.0
    radius, turned = speed / turning, turning * ROLLS_S
    x = radius * sin(turned) + REACH * cos(turned)
    y = radius * (1.0 - cos(turned)) + REACH * sin(turned)
    assert hypot(x - own.shown.x, y - own.shown.y) <= own.doubt - ROLL_ERROR + 1e-6


def test_an_ordinary_body_says_nothing_of_rolling():
    own = own_hand()
    own.measured(START, plant())
    assert own.obeys == ()
