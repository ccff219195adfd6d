"""The lines of preflight: each at each of its levels, from what a simulated rover tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.common.time import NS_PER_S
from agent.fleet.mavlink_section import MavlinkSection
from bridges.mavlink.ardupilot import constants, frames
from bridges.mavlink.bridge import preflight_checks
from bridges.mavlink.bridge.preflight_checks import BridgeState
from plant.backend import Check
from tests.rover_scene import Scene, heartbeat

SAFE = {"FS_GCS_ENABLE": 1.0, "FS_CRASH_CHECK": 1.0, "BATT_FS_LOW_ACT": 2.0}
"""What differs from ArduPilot's defaults where all is on that can be."""


class Looked:
    """A rover that has told all about itself; `line` reads the table with some of it otherwise."""

    def __init__(self, *overrides: str, seconds: float = 7.0, **settings: Any) -> None:
        self.scene = Scene(*overrides, **settings)
        self.scene.run(seconds)
        self.link = self.scene.bridge.link
        self.section = self.scene.fleet.robot(1).section(MavlinkSection) or MavlinkSection()
        self.found = BridgeState(
            self.scene.now_ns, "", "", 0.02, "", self.scene.bridge.reading.pose, (-3.0, 4.2), ""
        )

    def lines(self, **found: Any) -> Sequence[Check]:
        return preflight_checks.checks(
            self.link, self.found._replace(**found), self.section, frames.datum_of(self.scene.fleet)
        )

    def line(self, name: str, **found: Any) -> Check:
        lines = self.lines(**found)
        named = [line for line in lines if line.name == name]
        assert len(named) == 1, lines
        return named[0]

    def names(self) -> list[str]:
        return [line.name for line in self.lines()]


def test_a_good_rover_has_every_line_once_and_none_is_worse_than_a_warning() -> None:
    looked = Looked(parameters=SAFE)
    assert looked.names() == [
        *("link", "type", "firmware", "mode", "arming", "EKF", "GPS", "origin", "place"),
        *("ATTITUDE", "LOCAL_POSITION_NED", "round trip", "parameters", "battery", "signing"),
    ]
    worse = {line.name: line.level for line in looked.lines() if line.level != "ok"}
    assert worse == {"signing": "warning"}
    for line in looked.lines():
        assert line.found
        assert line.level == "ok" or line.advice


def test_the_link() -> None:
    looked = Looked()
    assert looked.line("link").found == "system 1 on simulator"
    trouble = looked.lines(trouble="cannot open tcp:1.2.3.4:5760: connection refused")
    assert [line.name for line in trouble] == ["link"]
    assert trouble[0].level == "blocking"
    silent = looked.lines(now_ns=looked.found.now_ns + 4 * NS_PER_S)
    assert [(line.name, line.level) for line in silent] == [("link", "blocking")]
    assert silent[0].found.startswith("waiting for it: no heartbeat of the vehicle for 4.")
    odd = looked.line("link", note="10.0.0.7:14550 sends here too: ignored")
    assert (odd.level, odd.advice) == ("warning", "10.0.0.7:14550 sends here too: ignored")
    looked.section = replace(looked.section, connection="/dev/ttyUSB0")
    assert looked.line("link").level == "warning"
    assert "/dev/serial/by-id/" in looked.line("link").advice
    looked.section = replace(looked.section, connection="/dev/serial/by-id/usb-ArduPilot")
    assert looked.line("link").level == "ok"


def test_nothing_more_is_said_of_a_vehicle_of_another_kind() -> None:
    looked = Looked(vehicle_type=constants.TYPE_QUADROTOR)
    assert looked.names() == ["link", "type"]
    assert looked.line("type").level == "blocking"
    assert looked.line("type").found == "is a quadrotor (MAV_TYPE 2), not a rover"
    assert Looked(vehicle_type=constants.TYPE_SURFACE_BOAT).line("type").level == "ok"


@pytest.mark.parametrize(
    ("firmware", "level"),
    [((4, 2, 3), "warning"), ((4, 3, 0), "ok"), ((4, 10, 0), "ok"), ((3, 9, 9), "warning")],
)
def test_old_firmware_is_told(firmware: tuple[int, int, int], level: str) -> None:
    assert Looked(firmware=firmware, seconds=3.0).line("firmware").level == level


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


def test_ekf_and_gps() -> None:
    looked = Looked()
    link, now_ns = looked.link, looked.found.now_ns
    assert link.ekf is not None
    assert link.gps is not None
    good_ekf, good_gps = link.ekf, link.gps
    for flags, text in (
        (good_ekf.flags | constants.EKF_GPS_GLITCHING, "glitching"),
        (good_ekf.flags | constants.EKF_CONST_POS_MODE, "to have a position"),
        (good_ekf.flags & ~constants.EKF_POS_HORIZ_ABS, "position on the earth"),
        (good_ekf.flags & ~constants.EKF_VELOCITY_HORIZ, "velocity"),
        (constants.EKF_UNINITIALIZED, "to start"),
    ):
        link.ekf = good_ekf._replace(flags=flags)
        assert looked.line("EKF").level == "blocking"
        assert text in looked.line("EKF").found
    inf = float("inf")
    for velocity, position, compass, level in (
        (0.1, 0.1, 0.4, "ok"),
        (0.1, 0.1, 0.6, "warning"),
        (0.1, 0.1, inf, "warning"),  # the current of its motors: no reason to stop
        (0.1, 0.81, 0.1, "warning"),
        (0.81, 0.1, 0.1, "warning"),
        (1.61, 0.1, 0.1, "blocking"),
        (0.1, 0.81, 0.81, "blocking"),
        (0.81, 0.1, 0.81, "blocking"),
        (float("nan"), 0.1, 0.1, "blocking"),
    ):
        link.ekf = good_ekf._replace(
            velocity_variance=velocity, position_variance=position, compass_variance=compass
        )
        assert looked.line("EKF").level == level, (velocity, position, compass)
    link.ekf = good_ekf._replace(arrival_ns=now_ns - 6 * NS_PER_S)
    assert (looked.line("EKF").level, looked.line("EKF").found) == (
        "blocking",
        "waiting for its EKF: silent for 6 s",
    )
    link.ekf = good_ekf
    for changed, level in (
        ({"fix": constants.GPS_3D_FIX - 1}, "blocking"),
        ({"satellites": 5}, "warning"),
        ({"hdop": 2.5}, "warning"),
        ({"hdop": None}, "ok"),
        ({"arrival_ns": now_ns - 6 * NS_PER_S}, "blocking"),
    ):
        link.gps = good_gps._replace(**changed)
        assert looked.line("GPS").level == level, changed
    link.gps = None
    assert looked.line("GPS").found == "waiting for its GPS"


@pytest.mark.parametrize(("metres", "level"), [(40.0, "ok"), (1_500.0, "warning"), (15_000.0, "blocking")])
def test_how_far_its_origin_may_be_from_the_datum(metres: float, level: str) -> None:
    looked = Looked()
    looked.link.origin = frames.world_to_geodetic(frames.datum_of(looked.scene.fleet), metres, 0.0)
    line = looked.line("origin")
    assert line.level == level
    assert line.found.startswith(
        f"{metres:.2f} m" if level != "blocking" else "the origin of its EKF is 15 km"
    )
    assert bool(line.advice) is (level != "ok")
    looked.link.origin = None
    assert looked.line("origin").found == "waiting for the origin of its EKF"


def test_a_rover_elsewhere_than_its_start_is_warned_of() -> None:
    looked = Looked()
    assert looked.line("place").level == "ok"
    assert looked.line("place", start=(3.0, 4.2)).level == "warning"
    assert "6.0 m from its start" in looked.line("place", start=(3.0, 4.2)).found
    assert "place" not in [line.name for line in looked.lines(place=None)]


def test_rates() -> None:
    looked = Looked()
    stream = looked.link.streams(looked.found.now_ns)[0]
    assert stream.name == "ATTITUDE"

    def with_stream(**changed: Any) -> Check:
        looked.link.streams = lambda _: [stream._replace(**changed)]  # type: ignore[method-assign]
        return looked.line("ATTITUDE")

    assert with_stream().level == "ok"
    assert with_stream(measured_hz=15.0).level == "warning"
    assert with_stream(measured_hz=3.0).level == "blocking"
    assert with_stream(measured_hz=0.0).found == "waiting for it"
    assert with_stream(answer="waiting", granted_hz=None).level == "blocking"
    refused = with_stream(asked_hz=50.0)
    assert (refused.level, refused.found) == ("warning", "25.0 Hz of 50 Hz")
    assert "state_rate_hz = 25" in refused.advice


def test_round_trip() -> None:
    looked = Looked()
    assert looked.line("round trip").found == "20 ms"
    assert looked.line("round trip", round_trip_s=0.2).level == "warning"
    assert looked.line("round trip", round_trip_s=0.6).level == "blocking"
    assert looked.line("round trip", round_trip_s=None).level == "warning"
    slow = looked.line("round trip", clock="its clock runs at 0.50 of ours")
    assert slow.level == "warning"
    assert "0.50" in slow.found


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
    assert "parameters" not in looked.names()


def test_a_vehicle_that_obeys_its_station_only() -> None:
    looked = Looked(parameters={"SYSID_ENFORCE": 1.0})
    assert "SYSID_ENFORCE" not in looked.names(), "the bridge is of the vehicle's own system"
    looked.section = replace(looked.section, own_system=7)
    assert looked.line("SYSID_ENFORCE").level == "blocking"
    looked = Looked(parameters={"SYSID_MYGCS": 7.0})
    looked.section = replace(looked.section, own_system=7)
    assert looked.line("own_system").level == "warning"


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


def test_who_else_is_there() -> None:
    scene_lines = Looked(ports=2)
    scene = scene_lines.scene
    scene.say(heartbeat())
    scene.say(heartbeat(mavlink.MAV_TYPE_GROUND_ROVER, constants.AUTOPILOT_ARDUPILOT), system=5, component=1)
    scene.say(heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER), system=1, component=192)
    scene.run(0.5)
    scene_lines.found = scene_lines.found._replace(now_ns=scene.now_ns)
    assert scene_lines.line("ground station") == Check("ground station", "ok", "system 255")
    assert scene_lines.line("other vehicles").level == "warning"
    assert "5" in scene_lines.line("other vehicles").found
    assert scene_lines.line("other bridges").level == "blocking"
    assert "component 192" in scene_lines.line("other bridges").found


def test_failsafes_that_it_does_not_tell_of_are_named() -> None:
    looked = Looked(parameters=SAFE)
    assert looked.line("parameters").level == "ok"
    looked.link._parameters.values["FS_EKF_ACTION"] = None
    line = looked.line("parameters")
    assert (line.level, line.found) == ("warning", "FS_EKF_ACTION not told")
