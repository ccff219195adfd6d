"""The overloaded profile: processes that stand now and then, amid others that go on."""

from __future__ import annotations

import pytest

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.chaos.profiles.overloaded import (
    RECOVERED_S,
    ROBOTS,
    STALL_MS,
    STALLS_HZ,
    STALLS_S,
    draw_overloaded,
)
from deploy.chaos.run import scenario_text
from deploy.check.check import check

SEEDS = range(60)


def test_each_process_stands_seldom_enough_for_others_to_go_on_and_long_enough_to_brake() -> None:
    sizes, most, stalls_hz, late = set(), [], [], 0
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_overloaded(seed)), source=f"seed {seed}")
        rule, *links = fleet.faults.rules
        late += len(links)
        for each in links:
            assert each.delay is not None
            assert each.loss is not None
        assert rule.robots is None  # all of them
        assert rule.tick_jitter is not None
        assert rule.tick_jitter_share is not None
        sizes.add(len(fleet.ids))
        most.append(rule.tick_jitter)
        assert rule.tick_jitter > fleet.control.wrench_timeout_s
        stalls_hz.append(rule.tick_jitter_share * fleet.fleet.rate_hz)
        assert fleet.trajectory.kind in ("circle", "line")
    assert 0.2 * len(SEEDS) < late < 0.6 * len(SEEDS)
    assert sizes == set(range(ROBOTS[0], ROBOTS[1] + 1))
    assert STALL_MS[0] / 1e3 <= min(most) < 0.7
    assert 1.4 < max(most) <= STALL_MS[1] / 1e3
    assert 0.95 * STALLS_HZ[0] < min(stalls_hz) < max(stalls_hz) < 1.05 * STALLS_HZ[1]


def test_they_stand_to_the_end_or_there_is_time_to_come_back() -> None:
    left = set()
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_overloaded(seed)), source=f"seed {seed}")
        rule = fleet.faults.rules[0]
        assert rule.at == 0.0
        assert rule.duration is not None
        assert STALLS_S[0] <= rule.duration <= STALLS_S[1]
        left.add(round(fleet.fleet.duration_s - rule.duration, 1))
    assert left == {0.0, RECOVERED_S}


@pytest.mark.parametrize("seed", range(20))
def test_check_finds_nothing_wrong_with_them(seed: int) -> None:
    fleet = parse_fleet(scenario_text(draw_overloaded(seed)), source=f"seed {seed}")
    assert [finding for finding in check(resolved(fleet)) if finding.level == "error"] == []
