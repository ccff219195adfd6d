"""What the verdict makes of rovers whose telemetry fails for a while, and of one that stops following."""

from __future__ import annotations

import re

import pytest

from handfast.deploy.verdict.run_result import RunResult
from tests.rover_fleet import Drive, Hold


@pytest.mark.slow
def test_a_link_that_is_cut_for_two_seconds_is_said_and_fails_nothing() -> None:
    drive = Drive(40.0)
    drive.until(12.0)
    drive.body().transport.cut = True
    drive.until(14.0)
    drive.body().transport.cut = False
    result = RunResult(drive.recording())
    assert result.reasons == []
    (gap,) = [each for each in result.warnings if "sent no pose" in each]
    assert gap.startswith("Robot 2 sent no pose from 12.")
    assert gap.endswith(", in which nothing can have happened.")
    (hidden,) = result.analysis.gaps
    assert 1.5 < hidden.lasts_s < 4.5


def test_a_rover_that_stops_following_for_good_fails() -> None:
    drive = Drive(25.0)
    drive.until(10.0)
    Hold(drive.rover)
    result = RunResult(drive.recording())
    (reason,) = result.reasons
    assert reason.startswith("Robot 2 followed no more from 1")
    assert "and its operator had not taken it: does not follow its commands: asked for " in reason


def test_a_rover_that_its_operator_takes_for_good_fails_nothing() -> None:
    drive = Drive(25.0)
    drive.until(10.0)
    drive.rover.set_mode("HOLD")
    result = RunResult(drive.recording())
    assert result.reasons == []
    assert any("Robot 2 was released to its operator from 10." in each for each in result.warnings)


@pytest.mark.slow
def test_a_rover_whose_gps_was_jammed_until_its_own_failsafe_took_it_fails() -> None:
    """Its vehicle is in HOLD, as if its operator had set it; but it says why itself."""
    drive = Drive(45.0)
    drive.until(8.0)
    drive.rover.set_parameter("SIM_GPS1_JAM", 1.0)
    drive.until(25.0)
    assert drive.rover.mode == "HOLD"
    drive.rover.set_parameter("SIM_GPS1_JAM", 0.0)
    result = RunResult(drive.recording())
    lost = r"Robot 2 followed no more from .* to the end, and its operator had not taken it: its own failsafe"
    assert any(re.match(lost, reason) for reason in result.reasons), result.reasons
