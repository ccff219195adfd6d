"""The lines of a vehicle's parameters: failsafes, limits, steering, fence, and whom it obeys."""

from __future__ import annotations

import pytest

from tests.rover_scene import heartbeat
from tests.unit.bridges.mavlink.looked import SAFE, Looked


def test_parameters_are_waited_for() -> None:
    looked = Looked(seconds=1.0)
    assert looked.line("parameters").level == "blocking"
    assert looked.line("parameters").found == "waiting for its parameters"


@pytest.mark.parametrize(
    ("parameter", "value", "line"),
    [
        ("FS_ACTION", 0, "FS_ACTION"),
        ("FS_ACTION", 1, "FS_ACTION"),
        ("FS_ACTION", 4, "FS_ACTION"),
        ("FS_THR_ENABLE", 0, "FS_THR_ENABLE"),
        ("FS_GCS_ENABLE", 0, "FS_GCS_ENABLE"),
        ("FS_EKF_ACTION", 0, "FS_EKF_ACTION"),
        ("FS_EKF_ACTION", 2, "FS_EKF_ACTION"),
        ("FS_EKF_THRESH", 0, "FS_EKF_THRESH"),
        ("FS_CRASH_CHECK", 0, "FS_CRASH_CHECK"),
        ("BATT_FS_LOW_ACT", 0, "BATT_FS_LOW_ACT"),
        ("BATT_FS_LOW_ACT", 1, "BATT_FS_LOW_ACT"),
        ("BATT_FS_CRT_ACT", 3, "BATT_FS_CRT_ACT"),
        ("ARMING_CHECK", 0, "arming checks"),
        ("ARMING_CHECK", 14, "arming checks"),
        ("WP_SPEED", 0.5, "WP_SPEED"),
        ("ATC_ACCEL_MAX", 0.5, "ATC_ACCEL_MAX"),
        ("ATC_STR_RAT_MAX", 50, "ATC_STR_RAT_MAX"),
    ],
)
def test_a_failsafe_that_is_off_or_risky_and_a_limit_that_is_low_are_warned_of(
    parameter: str, value: float, line: str
) -> None:
    looked = Looked(parameters={**SAFE, parameter: float(value)})
    assert looked.line(line).level == "warning"
    assert looked.line(line).advice
    assert looked.line("parameters").level == "ok"
    assert "failsafes on" not in looked.line("parameters").found


@pytest.mark.parametrize(("new_names", "name"), [(False, "SYSID_MYGCS"), (True, "MAV_GCS_SYSID")])
def test_the_bridge_must_not_be_the_ground_station_that_its_failsafe_counts(
    new_names: bool, name: str
) -> None:
    looked = Looked(parameters={"SYSID_MYGCS": 1.0}, new_names=new_names)
    line = looked.line(name)
    assert line.level == "warning"
    assert (
        line.found == "1 is the bridge's own system: the ground station failsafe would count its heartbeats"
    )
    assert line.advice == f"set {name} to the system id of its ground station, 255 as a rule"
    looked = Looked(parameters={"SYSID_MYGCS": 7.0}, new_names=new_names)
    assert name not in looked.names()


@pytest.mark.parametrize(("watched", "told"), [(255.0, False), (250.0, True)])
def test_a_failsafe_that_watches_another_station_than_the_one_here_is_told(
    watched: float, told: bool
) -> None:
    looked = Looked(parameters={"SYSID_MYGCS": watched, "FS_GCS_ENABLE": 1.0}, ports=2)
    looked.scene.say(heartbeat())
    looked.scene.run(0.5)
    looked.found = looked.found._replace(now_ns=looked.scene.now_ns)
    assert ("SYSID_MYGCS" in looked.names()) is told
    if told:
        assert "the ground station that is here, system 255" in looked.line("SYSID_MYGCS").found


SKID = {"SERVO1_FUNCTION": 73.0, "SERVO3_FUNCTION": 74.0}
ACKERMANN = {"SERVO1_FUNCTION": 26.0, "SERVO3_FUNCTION": 70.0}


@pytest.mark.parametrize(
    ("outputs", "level", "found", "reads"),
    [
        (SKID, "ok", "turns on the spot", 0),
        (ACKERMANN, "blocking", "it steers by its front wheels (SERVO1_FUNCTION 26)", 1),
        ({**ACKERMANN, "FRAME_TYPE": 2.0}, "ok", "turns on the spot", 1),
        ({**dict.fromkeys(SKID, 0.0), "SERVO2_FUNCTION": 73.0, "SERVO4_FUNCTION": 74.0}, "ok", "", 3),
        ({**dict.fromkeys(SKID, 0.0), "SERVO9_FUNCTION": 73.0, "SERVO12_FUNCTION": 74.0}, "ok", "", 15),
        (dict.fromkeys(SKID, 0.0), "warning", "no output is throttle left, or none right", 15),
    ],
)
def test_how_it_steers(outputs: dict[str, float], level: str, found: str, reads: int) -> None:
    looked = Looked(parameters=outputs, seconds=9.0)
    line = looked.line("steering")
    assert line.level == level
    assert line.found.startswith(found)
    if level == "blocking":
        assert line.advice == "the law asks for turns at a standstill: it needs skid steering (73 and 74)"
    asked = [m.param_id for _, m in looked.scene.bridge.port.messages("PARAM_REQUEST_READ")]
    outputs_asked = [name for name in asked if name.startswith("SERVO") or name == "FRAME_TYPE"]
    assert len(outputs_asked) == 2 + reads, "each read costs the link"


@pytest.mark.parametrize(
    ("fence", "avoid", "told", "asked"),
    [
        (0.0, 3.0, False, 0),
        (1.0, 3.0, True, 1),
        (1.0, 1.0, True, 1),
        (1.0, 2.0, False, 1),
        (1.0, 0.0, False, 1),
    ],
)
def test_a_fence_before_which_it_stays_in_guided_is_told(
    fence: float, avoid: float, told: bool, asked: int
) -> None:
    looked = Looked(parameters={"FENCE_ENABLE": fence, "AVOID_ENABLE": avoid})
    assert ("AVOID_ENABLE" in looked.names()) is told
    if told:
        line = looked.line("AVOID_ENABLE")
        assert (line.level, line.found[:1]) == ("warning", f"{avoid:g}")
        assert "stays in GUIDED" in line.found
        assert line.advice.startswith("set 0, and FENCE_ACTION 2")
    reads = [m.param_id for _, m in looked.scene.bridge.port.messages("PARAM_REQUEST_READ")]
    assert reads.count("AVOID_ENABLE") == asked
