"""Messages are numbered by the round they belong to."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.trickle_timer import FIRST_ROUND, SequenceNumbers

T0 = 1000 * NS_PER_S
PERIOD = 20_000_000
MS = 1_000_000


@pytest.mark.parametrize("phase_ns", [0, PERIOD // 2])
def test_a_late_tick_has_the_number_of_its_round(phase_ns: int):
    numbers = SequenceNumbers(PERIOD, phase_ns)
    assert [numbers.next(T0 + k) for k in range(3)] == [0, 1, 2]
    numbers.begin(T0)
    stamps = [T0 + phase_ns + k * PERIOD + (13 * MS if k % 2 else 0) for k in range(-3, 4)]
    assert [numbers.next(stamp) for stamp in stamps] == [FIRST_ROUND + k for k in range(-3, 4)]
