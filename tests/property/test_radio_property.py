"""The queue of a radio, whatever comes: it never carries more than its rate, and nothing waits too long."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from agent.common.time import NS_PER_S
from agent.links.radio import RateQueue

NOW = 1000 * NS_PER_S
LONGEST = NS_PER_S // 2
MOST_BYTES = 2000
coming = st.lists(
    st.tuples(st.integers(0, NS_PER_S // 5), st.floats(0.0, MOST_BYTES), st.booleans() | st.just(False)),
    max_size=120,
)


@given(came=coming, kbit=st.floats(1.0, 1e4), stream=st.integers(0, 2**63))
def test_a_queue_keeps_order_rate_and_longest_wait(
    came: list[tuple[int, float, bool]], kbit: float, stream: int
) -> None:
    queue = RateQueue(1e3 * kbit, LONGEST, stream)
    byte_ns = 8e9 / (1e3 * kbit)
    now_ns = last_ns = NOW
    for after_ns, size, is_order in came:
        now_ns += after_ns
        wait_ns = max(0, last_ns - now_ns)
        left_ns = queue.occupy(now_ns, size) if is_order else queue.leaves_ns(now_ns, size)
        if left_ns is None:
            assert wait_ns > LONGEST / 2, "a queue that is not half full drops nothing"
            continue
        assert is_order or wait_ns < LONGEST
        # All that is carried is carried one after the other, and never sooner than it came.
        assert abs(left_ns - (max(last_ns, now_ns) + size * byte_ns)) <= 1
        last_ns = left_ns
