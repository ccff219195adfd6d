"""What neighbours expect of a robot that sends at events is never off by more than the bound, and what one
tick can add: while nothing is lost, whatever drives it."""

from __future__ import annotations

from math import hypot

from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control.event_trigger import EventTrigger
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.formation.reference import Instant
from handfast.agent.messages.types import HandState

C1, C2, DECAY = 0.4, 0.6, 0.9
S = 1_000_000_000
T0 = 1000 * S
ACCELERATION = 3.0

_pushes = st.tuples(
    st.integers(1, 30),  # ticks
    st.floats(-ACCELERATION, ACCELERATION),
    st.floats(-ACCELERATION, ACCELERATION),
)


def onward(time_ns: int) -> Instant:
    t = (time_ns - T0) / S
    return Instant((0.3 * t, 0.0, 0.3, 0.0, 0.0, 0.0), {1: (0.0, 0.0)})


@given(
    st.lists(_pushes, min_size=1, max_size=6),
    st.sampled_from((10, 20, 50)),
    st.sampled_from((0.001, 0.005, 0.02)),
    st.integers(1, 40),
)
def test_neighbours_expect_it_within_the_bound_where_it_is(
    pushes: list[tuple[int, float, float]], rate_hz: int, bound_m: float, most: int
) -> None:
    period_ns = S // rate_hz
    dt = period_ns / S
    forecast = Forecast(C1, C2, onward, DECAY, None)
    rule = EventTrigger(forecast, period_ns, bound_m, most * period_ns, predicts=True, slopes=dict)
    x = y = vx = vy = 0.0
    last: HandState | None = None
    since = 0
    tick = 0
    for count, ax, ay in pushes:
        for _ in range(count):
            now_ns = T0 + tick * period_ns
            if last is not None:  # before this tick's message has come
                expected = forecast.following(last, now_ns)
                assert expected is not None
                off = hypot(expected.position[0] - x, expected.position[1] - y)
                # One tick of another velocity and acceleration than those that were within the bound.
                assert off <= bound_m * (1.0 + 2.0 * dt) + 2.0 * ACCELERATION * dt * dt * 1.5
            place = onward(now_ns).motion(1)
            nx = -C1 * (x - place[0]) - C2 * (vx - place[2])
            ny = -C1 * (y - place[1]) - C2 * (vy - place[3])
            forces = (nx, ny, ax - nx, ay - ny, 0.0, 0.0)
            message = HandState(1, tick, now_ns, True, 1, x, y, vx, vy, *forces, 0.0, (), ())
            if rule.next_ms(message, tick * period_ns) is not None:
                last, since = message, tick
            assert tick - since < most
            x, y = x + dt * vx + 0.5 * dt * dt * ax, y + dt * vy + 0.5 * dt * dt * ay
            vx, vy = vx + dt * ax, vy + dt * ay
            tick += 1
