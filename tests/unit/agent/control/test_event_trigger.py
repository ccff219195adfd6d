"""handfast.agent.control.event_trigger: what a robot's neighbours have to be told, and when again."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.control.event_trigger import HEARD_OFF_US, LOOKAHEAD_S, EventTrigger
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.rolling import Rolls
from handfast.agent.formation.reference import Instant
from handfast.agent.messages.types import HEARD_ROUNDS, HandState

PERIOD = 20_000_000
S = 1_000_000_000
T0 = 1000 * S
MOST = 12
BOUND = 0.005
SLOPE = 1.3


def standing(_time_ns: int) -> Instant:
    return Instant((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), {1: (0.0, 0.0)})


def trigger(**options: Any) -> EventTrigger:
    forecast = Forecast(0.4, 0.6, standing, 0.9, None)
    given = {"predicts": True, "slopes": lambda: {2: SLOPE}} | options
    return EventTrigger(forecast, PERIOD, BOUND, MOST * PERIOD, **given)


def state(rounds: int, **fields: Any) -> HandState:
    """At its place, at rest, with nothing that acts on it."""
    at = HandState.placed(1, rounds, T0 + rounds * PERIOD, True, 1, (0.0, 0.0, 0.0, 0.0))
    return at._replace(**{"multipliers": ((2, 0.5),)} | fields)


def sent(rule: EventTrigger, rounds: range, **fields: Any) -> list[tuple[int, int]]:
    """(round, promise in periods) of those that are sent."""
    found = []
    for k in rounds:
        next_ms = rule.next_ms(state(k, **fields), k * PERIOD)
        if next_ms is not None:
            found.append((k, next_ms // 20))
    return found


def test_one_that_says_nothing_new_is_repeated_after_intervals_that_double_up_to_the_longest():
    rule = trigger()
    assert sent(rule, range(60)) == [
        (0, 1), (1, 2), (3, 4), (7, 8), (15, 12), (27, 12), (39, 12), (51, 12),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("heading", "is_news"), [(0.0, False), (0.05, False), (0.2, True), (-0.2, True), (None, True)]
)
def test_where_its_body_would_roll_to_is_news_once_it_is_elsewhere(
    heading: float | None, is_news: bool
) -> None:
    """A vehicle that turns away from where nobody expects it to turn away."""
    speed, rolls = 0.5, Rolls(3.5, 0.4)
    rule = EventTrigger(
        Forecast(0.4, 0.6, standing, 0.9, None, rolls_on={1: rolls}),
        PERIOD,
        BOUND,
        MOST * PERIOD,
        predicts=False,
        slopes=lambda: {2: SLOPE},
    )

    def said(rounds: int, heading: float | None) -> int | None:
        obeys = () if heading is None else ((heading, speed, 0.0),)
        return rule.next_ms(state(rounds, x=0.0, obeys=obeys), rounds * PERIOD)

    for rounds in range(28):
        said(rounds, 0.0)
    assert (said(28, heading) is not None) == is_news


def settled() -> EventTrigger:
    rule = trigger()
    assert sent(rule, range(28))[-1] == (27, 12)
    return rule


@pytest.mark.parametrize(
    "news",
    [
        {"following": False},
        {"degree": 2},
        {"doubt": 0.1},
        {"own": (1.0,)},
        {"x": 1.1 * BOUND},
        {"vy": 1.1 * BOUND / LOOKAHEAD_S},
        {"constraint_x": 2.2 * BOUND / LOOKAHEAD_S**2},
        {"correction_y": 2.2 * BOUND / LOOKAHEAD_S**2},
        {"multipliers": ((2, 0.5 + 2.2 * BOUND / LOOKAHEAD_S**2 / SLOPE),)},
        {"multipliers": ()},
        {"multipliers": ((2, 0.5), (3, 0.0))},
    ],
    ids=str,
)
def test_what_neighbours_cannot_know_is_said_at_once_and_again(news: dict[str, Any]):
    assert [k for k, _ in sent(settled(), range(30, 46), **news)] == [30, 31, 33, 37, 45]


@pytest.mark.parametrize(
    "little",
    [
        {"x": 0.9 * BOUND},
        {"vy": 0.9 * BOUND / LOOKAHEAD_S},
        {"constraint_x": 1.8 * BOUND / LOOKAHEAD_S**2},
        {"multipliers": ((2, 0.5 + 1.8 * BOUND / LOOKAHEAD_S**2 / SLOPE),)},
        {"heard": ((2, 5),)},
        {"navigation_x": 0.9 * BOUND},
    ],
    ids=str,
)
def test_what_is_off_by_less_than_the_bound_waits(little: dict[str, Any]):
    assert sent(settled(), range(30, 39), **little) == []


def test_small_errors_of_place_velocity_and_force_count_together():
    part = 0.4 * BOUND
    three = {"x": part, "vx": part / LOOKAHEAD_S, "constraint_x": 2.0 * part / LOOKAHEAD_S**2}
    assert [k for k, _ in sent(settled(), range(30, 31), **three)] == [30]


def test_a_robot_that_goes_as_predicted_says_nothing_though_it_moves():
    forecast = Forecast(0.4, 0.6, standing, 0.9, None)
    rule, said = trigger(), []
    begun = state(0, x=1.0, constraint_x=0.3)
    for k in range(60):
        found = forecast.following(begun, T0 + k * PERIOD)
        assert found is not None
        (x, y), (vx, vy) = found.position, found.velocity
        now = state(k, x=x, y=y, vx=vx, vy=vy, constraint_x=found.constraint[0])
        now = now._replace(navigation_x=found.navigation[0], navigation_y=found.navigation[1])
        if rule.next_ms(now, k * PERIOD) is not None:
            said.append(k)
    assert said == [0, 1, 3, 7, 15, 27, 39, 51]


def test_without_prediction_it_sends_whenever_it_has_moved():
    moving = [state(k, x=0.3 * k * PERIOD / S, vx=0.3) for k in range(40)]
    rule = trigger(predicts=False)
    said = [k for k, now in enumerate(moving) if rule.next_ms(now, k * PERIOD) is not None]
    assert len(said) >= 39  # 6 mm a tick


def test_one_that_brakes_is_expected_to_come_to_rest():
    rule = trigger()
    sent(rule, range(28), following=False)
    assert sent(rule, range(30, 39), following=False, constraint_x=1.0) == []
    assert sent(rule, range(39, 40), following=False, vx=0.1) != []


def test_whoever_may_have_missed_the_last_one_is_told_in_the_next_tick():
    rule = settled()
    rule.missed()
    assert [k for k, _ in sent(rule, range(30, 34))] == [30, 31, 33]


def test_a_promise_is_kept_by_rounds_so_that_late_ticks_break_none():
    rule = trigger()
    found = []
    for k in range(40):
        late = state(k)._replace(time_ns=T0 + k * PERIOD + (k * 7 % 5) * PERIOD // 6)
        if rule.next_ms(late, k * PERIOD) is not None:
            found.append(k)
    assert found == [0, 1, 3, 7, 15, 27, 39]


def test_echoes_go_with_what_is_sent_anyway_and_new_ones_at_once():
    rule = settled()
    heard = ((2, 300),)
    rule.hears(heard)
    assert [k for k, _ in sent(rule, range(30, 31))] == [30]
    assert rule.echo(heard, 30 * PERIOD) == heard
    assert rule.echo(heard, (29 + HEARD_ROUNDS) * PERIOD) == ()
    sent(rule, range(31, 46))
    rule.hears(((2, 300 - HEARD_OFF_US),))
    assert sent(rule, range(46, 50)) == []
    rule.hears(((2, 299 - HEARD_OFF_US),))
    assert [k for k, _ in sent(rule, range(50, 51))] == [50]
    assert rule.echo(heard, 50 * PERIOD) == heard


def test_where_links_lose_messages_and_nothing_else_shows_that_it_is_there_it_is_repeated_oftener():
    lost = [0.0]
    rule = trigger(missed=lambda: lost[0])
    assert sent(rule, range(28))[-2:] == [(15, 12), (27, 12)]
    lost[0] = 3.0
    assert sent(rule, range(28, 60)) == [(39, 3), *((k, 3) for k in range(42, 60, 3))]
    lost[0] = 100.0
    assert sent(rule, range(60, 66))[-3:] == [(63, 1), (64, 1), (65, 1)]
