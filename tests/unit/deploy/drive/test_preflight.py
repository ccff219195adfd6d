"""The parameter files that preflight writes for ground stations."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pymavlink.mavparm import MAVParmDict

from handfast.deploy.drive.preflight import parameter_file, write_parameters
from handfast.deploy.drive.readiness import Line

CRASH = Line("FS_CRASH_CHECK", "warning", "0: it drives on against an obstacle", "set 1 (HOLD)")
THRESHOLD = Line("FS_EKF_THRESH", "warning", "0: that its EKF fails goes unnoticed", "set 0.8")
STATION = Line("FS_GCS_ENABLE", "warning", "0: the loss goes unnoticed", "set 1 if one is always there")
FENCE = Line("AVOID_ENABLE", "warning", "3: before its own fence it stops", "set 0")
BATTERY = Line("battery", "warning", "20 %", "charge it soon")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_file_has_values_to_set_and_comments_on_lines_of_their_own() -> None:
    assert parameter_file("robot 1 of two", [BATTERY, CRASH, STATION, FENCE, THRESHOLD]).splitlines() == [
        "# Parameters to change, robot 1 of two (handfast preflight)",
        "# FS_CRASH_CHECK: 0: it drives on against an obstacle (set 1 (HOLD))",
        "FS_CRASH_CHECK,1",
        "# FS_EKF_THRESH: 0: that its EKF fails goes unnoticed (set 0.8)",
        "FS_EKF_THRESH,0.8",
        "# These depend on the vehicle and its field. Set them yourself:",
        "# FS_GCS_ENABLE: 0: the loss goes unnoticed (set 1 if one is always there)",
        "# AVOID_ENABLE: 3: before its own fence it stops (set 0)",
    ]


def test_a_vehicle_without_a_value_to_set_has_no_file() -> None:
    assert parameter_file("robot 1 of two", [BATTERY, STATION, CRASH._replace(level="ok")]) == ""


def test_text_of_a_vehicle_cannot_add_a_value() -> None:
    text = parameter_file("robot 1 of two", [CRASH._replace(found="0\nFS_ACTION,0\r\nFS_THR_ENABLE,0")])
    assert [line for line in text.splitlines() if not line.startswith("#")] == ["FS_CRASH_CHECK,1"]


def test_ground_stations_read_the_file() -> None:
    note = write_parameters({1: [CRASH, THRESHOLD, STATION], 2: [BATTERY], 3: [CRASH]}, "three")
    assert note.startswith("Robots 1 and 3: parameters to change are in three-parameters/robot-N.param. Load")
    file = Path("three-parameters/robot-1.param")
    read = MAVParmDict()  # of MAVProxy
    assert read.load(str(file))
    assert read == {"FS_CRASH_CHECK": 1.0, "FS_EKF_THRESH": 0.8}
    for line in file.read_text(encoding="ascii").splitlines():
        # Mission Planner and QGroundControl split at commas, and skip comments from the first column on only.
        assert line.startswith("#") or re.fullmatch(r"[A-Z][A-Z0-9_]{1,15},\d+(\.\d+)?", line)
    assert sorted(path.name for path in file.parent.iterdir()) == ["robot-1.param", "robot-3.param"]


def test_the_file_of_a_vehicle_that_was_put_right_is_removed() -> None:
    write_parameters({1: [CRASH]}, "two")
    assert write_parameters({1: [BATTERY]}, "two") == ""
    assert not Path("two-parameters/robot-1.param").exists()


def test_a_folder_that_cannot_be_made_is_named(here: Path) -> None:
    (here / "two-parameters").write_text("mine")
    note = write_parameters({1: [CRASH]}, "two")
    assert note.startswith("Cannot write parameters to change into two-parameters: ")
