"""What a run is judged by, taken from its recording."""

from __future__ import annotations

from handfast.deploy.verdict.evidence import Evidence
from tests.unit.deploy.judged_run import PAIR, recorded, status, with_statuses


def test_ages_and_ticks_are_all_that_agents_said() -> None:
    sent = with_statuses(status(1, 1.0, ages_us=(1000, 2000), tick_us=(100,)), status(2, 1.0, tick_us=(300,)))
    result = Evidence(recorded(PAIR, sent))
    assert result.ages_ms.tolist() == [1.0, 2.0]
    assert result.ticks_us.tolist() == [100, 300]
    assert not len(Evidence(recorded(PAIR, sent, mode="simulate")).ticks_us)
