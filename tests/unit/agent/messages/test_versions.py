"""Which versions of orders are believed."""

from __future__ import annotations

from agent.messages.versions import AHEAD_US_MAX, can_be

NOW_NS = 1_790_000_000 * 10**9


def test_clocks_of_operators_differ_by_less_than_a_day() -> None:
    now_us = NOW_NS // 1_000
    assert can_be(0, NOW_NS)
    assert can_be(now_us + AHEAD_US_MAX, NOW_NS)
    assert not can_be(now_us + AHEAD_US_MAX + 1, NOW_NS)
