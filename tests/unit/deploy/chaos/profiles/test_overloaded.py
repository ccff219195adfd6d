"""The overloaded profile: processes that stand now and then, amid others that go on."""

from __future__ import annotations

import pytest

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.chaos.profiles.overloaded import (
    BUSY_MS,
    BUSY_SHARES,
    PATIENT_PERIODS,
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
TIMEOUT_MAX_S = 0.3
"""Of those that are not drawn patient: 3 periods."""


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
        if fleet.control.wrench_timeout_s > TIMEOUT_MAX_S:
            continue  # below
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
        if fleet.control.wrench_timeout_s > TIMEOUT_MAX_S:
            continue
        assert rule.at == 0.0
        assert rule.duration is not None
        assert STALLS_S[0] <= rule.duration <= STALLS_S[1]
        left.add(round(fleet.fleet.duration_s - rule.duration, 1))
    assert left == {0.0, RECOVERED_S}


def test_some_plants_wait_long_and_some_of_those_machines_are_late_all_the_time() -> None:
    patient = busy = 0
    for seed in SEEDS:
        fleet = parse_fleet(scenario_text(draw_overloaded(seed)), source=f"seed {seed}")
        control, rule = fleet.control, fleet.faults.rules[0]
        if control.wrench_timeout_s <= TIMEOUT_MAX_S:
            continue
        patient += 1
        assert control.plant_timeout_s == control.wrench_timeout_s
        assert control.wrench_timeout_s == pytest.approx(PATIENT_PERIODS / fleet.fleet.rate_hz, rel=0.02)
        assert rule.tick_jitter is not None
        assert rule.tick_jitter_share is not None
        assert rule.duration is not None
        if rule.duration < STALLS_S[0]:
            busy += 1
            assert BUSY_SHARES[0] <= 100.0 * rule.tick_jitter_share <= BUSY_SHARES[1]
            assert BUSY_MS[0] <= 1e3 * rule.tick_jitter <= BUSY_MS[1]
    assert 0.2 * len(SEEDS) < patient < 0.6 * len(SEEDS)
    assert 0.2 * patient < busy < 0.8 * patient


@pytest.mark.parametrize("seed", range(20))
def test_check_finds_nothing_wrong_with_them(seed: int) -> None:
    fleet = parse_fleet(scenario_text(draw_overloaded(seed)), source=f"seed {seed}")
    assert [finding for finding in check(resolved(fleet)) if finding.level == "error"] == []
