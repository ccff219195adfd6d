"""The offset of a neighbour's clock over all clocks, drifts and links."""

from __future__ import annotations

from random import Random

from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.control.peers.lateness import DRIFT_MAX, LEAK_NS, ClockOffset
from tests.two_clocks import MS, PERIOD, Delay, S, Side, exchange

OFFSETS = st.integers(-3 * S, 3 * S) | st.integers(-2 * PERIOD, 2 * PERIOD)
LINKS = st.tuples(
    st.integers(0, 600 * MS), st.integers(0, 500 * MS), st.floats(0.0, 0.7), st.integers(0, 2**32)
)


def link(least_ns: int, jitter_ns: int, loss: float, seed: int) -> Delay:
    random = Random(seed)
    return lambda _: None if random.random() < loss else least_ns + random.randrange(jitter_ns + 1)


@settings(max_examples=60, deadline=None)
@given(OFFSETS, st.floats(-0.5 * DRIFT_MAX, 0.5 * DRIFT_MAX), LINKS, LINKS)
def test_the_true_offset_is_within_the_error_and_use_never_harms(offset_ns, drift, there, back):
    """Whatever the delays, also of one way only: what is used is no further off than using nothing."""
    one, other = Side(0, drift), Side(offset_ns, -drift)
    slack = LEAK_NS + 2000  # the least delay grows in steps, and is told in us
    for true_ns in exchange(one, other, link(*there), link(*back), 4 * S):
        truth = other.clock(true_ns) - one.clock(true_ns)
        for side, theta in ((one, truth), (other, -truth)):
            estimate = side.estimate
            if estimate.error_us >= 0:
                # The echo is as old as its message: the clocks went on since.
                told = slack + round(DRIFT_MAX * 3 * S)
                assert abs(estimate.offset_us * 1000 - theta) <= estimate.error_us * 1000 + told
                assert abs(estimate.used_ns - theta) <= abs(theta) + 2 * told
            else:
                assert estimate.used_ns == 0


@given(st.integers(-5 * S, 5 * S), st.integers(-5 * 10**6, 5 * 10**6), st.integers(10**6, S))
def test_any_two_delays(least_ns, echo_us, period_ns):
    clock = ClockOffset(period_ns)
    for tick in range(2):
        clock.take(tick * period_ns, tick * period_ns - least_ns, echo_us)
    lower, upper = -least_ns, echo_us * 1000
    if upper - lower < -period_ns:
        assert (clock.used_ns, clock.error_us) == (0, -1)
        return
    middle, error = (lower + upper) / 2, max(upper - lower, period_ns) / 2
    assert abs(clock.offset_us - middle / 1000) <= 1
    assert abs(clock.error_us - error / 1000) <= 1
    if abs(middle) <= error:
        assert clock.used_ns == 0
    else:
        share = min(1.0, abs(middle) / error - 1.0)
        assert abs(clock.used_ns - middle * share) <= 2
        # For every offset that the interval allows, using it is no worse than not.
        for theta in (middle - error, middle + error):
            assert abs(clock.used_ns - theta) <= abs(theta) + 2


@given(st.integers(-5 * S, 5 * S), st.integers(-5 * 10**6, 5 * 10**6))
def test_both_ends_find_the_same(one_us, other_us):
    near, far = ClockOffset(PERIOD), ClockOffset(PERIOD)
    for tick in range(2):
        now = tick * PERIOD
        near.take(now, now - one_us * 1000, other_us)
        far.take(now, now - other_us * 1000, one_us)
    assert near.error_us == far.error_us
    assert abs(near.offset_us + far.offset_us) <= 1
    assert abs(near.used_ns + far.used_ns) <= 1
