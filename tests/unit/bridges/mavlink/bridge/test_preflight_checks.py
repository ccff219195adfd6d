"""The lines of preflight, those of the vehicle's parameters among them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.bridges.mavlink.bridge.preflight_checks import CHECKS
from handfast.plant.backend import WAITING
from tests.rover_scene import Scene, heartbeat
from tests.unit.bridges.mavlink.looked import SAFE, Looked


def test_a_good_rover_has_every_line_once_and_none_is_worse_than_a_warning() -> None:
    looked = Looked(parameters=SAFE)
    assert looked.names() == [
        *("link", "type", "firmware", "mode", "arming", "EKF", "GPS", "origin", "place"),
        *("ATTITUDE", "LOCAL_POSITION_NED", "round trip", "steering", "parameters", "battery", "signing"),
    ]
    worse = {line.name: line.level for line in looked.lines() if line.level != "ok"}
    assert worse == {"signing": "warning"}
    for line in looked.lines():
        assert line.found
        assert line.level == "ok" or line.advice


@pytest.mark.parametrize("boot", ["cold", "warm"])
def test_nothing_is_well_before_it_was_looked_at(boot: str) -> None:
    """From the first heartbeat on there is a line for each check at every tick; where an answer is still to
    come it waits, and keeps the fleet from starting. Each that waited has then been answered."""
    scene = Scene(boot=boot, boot_s=8.0)
    names = [name for name, _ in CHECKS]
    waited = set()
    clear = 0.0

    def look() -> None:
        nonlocal clear
        lines = scene.bridge.plant.checks(scene.now_ns)
        if lines[0].level == "blocking":
            return
        assert [name for name in names if name not in {line.name for line in lines}] == []
        waited.update(line.name for line in lines if line.found.startswith(WAITING))
        link, reading = scene.bridge.link, scene.bridge.reading
        if not clear and all(line.level != "blocking" for line in lines):
            clear = scene.time
            assert reading.healthy
            assert link.parameters_done
            assert (link.firmware, link.status, link.clock.round_trip_ns) != ("", None, None)
            assert "m from its start" in scene.bridge.check("place").found

    scene.run(20.0, look)
    assert clear > 1.0
    assert {"place", "steering", "parameters", "round trip", "firmware", "battery"} <= waited


@pytest.mark.parametrize(
    ("forget", "name", "later"),
    [
        ({"firmware": ""}, "firmware", "does not tell its version"),
        ({"status": None}, "battery", "not measured"),
        ({"status": None, "armed": False}, "arming", "disarmed"),
    ],
)
def test_what_it_never_tells_is_waited_for_a_while(forget: dict[str, Any], name: str, later: str) -> None:
    looked = Looked()
    for what, value in forget.items():
        setattr(looked.link, what, value)
    assert looked.line(name, heard_s=9.9).found == f"waiting for its {name}"
    told = looked.line(name, heard_s=10.0)
    assert (told.level, told.found) == ("warning", later)


def test_mode_and_arming_are_the_operators_or_the_bridges() -> None:
    looked = Looked(hand_over=False)
    assert (looked.line("mode").level, looked.line("mode").found) == ("warning", "MANUAL")
    assert "operator" in looked.line("mode").advice
    assert looked.line("arming").level == "warning"
    assert looked.line("arming").advice == "its operator arms it"
    looked.section = replace(looked.section, arm=True)
    assert "the bridge will" in looked.line("mode").advice
    assert "the bridge will" in looked.line("arming").advice
    ready = Looked()
    assert (ready.line("mode").found, ready.line("arming").found) == ("GUIDED", "armed")


def test_what_keeps_it_from_arming_blocks() -> None:
    looked = Looked(boot="cold", boot_s=60.0, seconds=35.0)
    line = looked.line("arming", prearm="AHRS: not using configured AHRS type")
    assert line.level == "blocking"
    assert "AHRS: not using" in line.found
    assert looked.scene.bridge.check("arming").found.endswith("Need Position Estimate"), "by its STATUSTEXT"
    assert looked.line("EKF").level == "blocking"


@pytest.mark.parametrize(
    ("voltage", "percent", "level"),
    [
        (12.6, 90, "ok"),
        (12.6, 20, "warning"),
        (12.6, 5, "blocking"),
        (10.0, 90, "blocking"),
        (None, 90, "ok"),
        (12.0, None, "ok"),
        (None, None, "warning"),
    ],
)
def test_battery(voltage: float | None, percent: int | None, level: str) -> None:
    looked = Looked()
    assert looked.link.status is not None
    battery = looked.link.status.battery._replace(voltage=voltage, percent=percent)
    looked.link.status = looked.link.status._replace(battery=battery)
    assert looked.line("battery").level == level


def test_parameters_are_waited_for() -> None:
    looked = Looked(seconds=1.0)
    assert looked.line("parameters").level == "blocking"
    assert looked.line("parameters").found == "waiting for its parameters"


@pytest.mark.parametrize(("value", "level"), [(3.0, ""), (2.0, ""), (10.0, "blocking"), (0.0, "blocking")])
def test_a_vehicle_that_drives_on_for_longer_than_others_expect_is_blocked(value: float, level: str) -> None:
    looked = Looked(parameters={**SAFE, "GUID_TIMEOUT": value})
    found = [line.level for line in looked.lines() if line.name == "GUID_TIMEOUT"]
    assert found == [level] * bool(level)


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
