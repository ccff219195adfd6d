"""Whole drives in virtual time and what the verdict makes of them."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep import run
from handfast.deploy.verdict.run_result import RunResult

DEAD = """
[[faults.rule]]
name = "plant"
robot = 4
kill = "plant"
at = "10s"
[[faults.rule]]
name = "agent"
robot = 4
kill = "agent"
at = "10s"
"""
REPLACED = """
[[order]]
at = "12s"
kind = "replace"
robot = 4
by = 7
"""


def driven(more: str) -> RunResult:
    text = (FLEETS / "reserve.toml").read_text() + more
    short = ["fleet.duration_s=35", "fleet.rate_hz=20"]
    return RunResult(run.drive(resolved(parse_fleet(text, source="reserve", overrides=short))))


def test_a_dead_robot_that_was_replaced_is_no_missing_pose() -> None:
    result = driven(DEAD + REPLACED)
    assert result.reasons == []
    assert any("(rule 'plant' stopped its plant)" in each for each in result.warnings)


@pytest.mark.slow
def test_a_dead_robot_that_nobody_replaced_is_missed() -> None:
    """Killed on purpose: the verdict says what the formation lacks, and does not take the data as bad."""
    result = driven(DEAD)
    assert result.reasons == []
    assert "The agent of robot 4 was killed at 10.0 s for good." in result.warnings
    (plant, _) = DEAD.split("[[faults.rule]]")[1:]
    alone = driven(f"[[faults.rule]]{plant}")
    assert any("Robot 4 sent no pose from " in each for each in alone.reasons)


def test_a_course_that_is_faster_than_robots_may_drive_fails() -> None:
    fast = ["trajectory.kind=line", "trajectory.velocity_mps=[3.0, 0.0]", "fleet.duration_s=12"]
    result = RunResult(run.drive(resolved(load_fleet(FLEETS / "pair.toml", fast))))
    (reason,) = [each for each in result.reasons if "from their places at the end" in each]
    assert reason.endswith("places move at 3.00 m/s and the limit is control.max_speed_mps = 1.5.")


def test_who_fell_behind_a_fast_course_has_the_time_that_it_takes_to_catch_up() -> None:
    """0.15 m/s are left for the 6 m by which it is behind when it drives again, long after its fault."""
    behind = 'faults.rule=[{name = "stands", robot = 1, kill = "plant", at = 8.0, for = 3.5}]'
    fast = ["trajectory.kind=line", "trajectory.velocity_mps=[1.35, 0.0]", behind, "fleet.duration_s=70"]
    result = RunResult(run.drive(resolved(load_fleet(FLEETS / "pair.toml", fast))))
    assert result.reasons == []
    assert result.analysis.settling_s is not None
    assert result.analysis.settling_s > 55.0
