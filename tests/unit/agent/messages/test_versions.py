"""Which versions of orders are believed."""

from __future__ import annotations

from handfast.agent.messages.codec import AHEAD_US_MAX, as_believed, can_be
from handfast.agent.messages.types import Mission, Resume, Stop

NOW_NS = 1_790_000_000 * 10**9


def test_clocks_of_operators_differ_by_less_than_a_day() -> None:
    now_us = NOW_NS // 1_000
    assert can_be(0, NOW_NS)
    assert can_be(now_us + AHEAD_US_MAX, NOW_NS)
    assert not can_be(now_us + AHEAD_US_MAX + 1, NOW_NS)


def test_of_orders_that_cannot_have_been_given_yet_only_a_stop_is_taken() -> None:
    now_us = NOW_NS // 1_000
    stop, resume, mission = Stop(1, 2, "why"), Resume(1, 2, ()), Mission(1, 2, 3, 4, "digest")
    for order in (stop, resume, mission):
        assert as_believed(order, NOW_NS) is order
    far = now_us + AHEAD_US_MAX + 1
    assert as_believed(stop._replace(version=far), NOW_NS) == stop._replace(version=now_us)
    assert as_believed(resume._replace(version=far), NOW_NS) is None
    assert as_believed(mission._replace(version=far), NOW_NS) is None
