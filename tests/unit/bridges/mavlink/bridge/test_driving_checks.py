"""The checks of a vehicle's link and of where it is: what is said, and what keeps it from driving."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants, frames
from handfast.bridges.mavlink.bridge.backend import JUDGED_NS
from handfast.bridges.mavlink.bridge.driving_checks import REPORTED_NS
from handfast.bridges.mavlink.transport.port_diagnosis import TO_DO
from handfast.plant.backend import Check
from tests.rover_scene import Scene
from tests.unit.bridges.mavlink.looked import Looked


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
    for lasting in ("/dev/serial/by-id/usb-ArduPilot", "/dev/ttyAMA0"):
        looked.section = replace(looked.section, connection=lasting)
        assert looked.line("link").level == "ok"


def test_what_is_wrong_with_a_port_and_what_to_do_stand_apart() -> None:
    looked = Looked()
    port = "/dev/ttyAMA0"
    looked.section = replace(looked.section, connection=port)
    denied = (
        f"cannot open {port}: permission denied: it is of group dialout{TO_DO}sudo usermod -aG dialout ann"
    )
    line = looked.lines(trouble=denied)[0]
    assert line.found == f"cannot open {port}: permission denied: it is of group dialout"
    assert line.advice == "sudo usermod -aG dialout ann"
    old = looked.line("link", note=f"it speaks MAVLink 1{TO_DO}SERIALx_PROTOCOL = 2")
    assert (old.level, old.found) == ("warning", f"system 1 on {port}; it speaks MAVLink 1")
    assert old.advice == "SERIALx_PROTOCOL = 2"
    late_ns = looked.found.now_ns + 10 * NS_PER_S
    silent = looked.lines(now_ns=late_ns)[0]
    assert "TX wired to RX" in silent.advice
    console = looked.lines(now_ns=late_ns, note=f"a Linux console is on it{TO_DO}raspi-config")[0]
    assert console.level == "blocking"
    assert console.found.endswith(f"on {port}; a Linux console is on it")
    assert console.advice == "raspi-config"


def cut(scene: Scene) -> None:
    """From now on nothing reaches the vehicle."""
    scene.world.to_rover = deque(maxlen=0)


def test_a_link_that_carries_one_way_only_is_told_as_that() -> None:
    scene = Scene()
    cut(scene)
    scene.run(7.0)
    assert scene.bridge.blocking == {"link": "system 1 is heard on simulator, but answers nothing"}
    advice = scene.bridge.check("link").advice
    assert advice == (
        "nothing of ours reaches it: TX of this side is not wired, or a router or firewall sends nothing "
        "back to it"
    )
    assert "SYSID_ENFORCE" not in advice, "the bridge is of the vehicle's own system"


def test_a_vehicle_of_another_id_is_told_with_what_helps() -> None:
    scene = Scene("robot_defaults.mavlink.system=2", system=1)
    scene.run(3.0)
    line = scene.bridge.check("link")
    assert line.found == (
        "waiting for it: no vehicle with system id 2 here, but with 1 (ground rover) on simulator"
    )
    assert line.advice == (
        "mavlink.system = 1, or give the vehicle SYSID_THISMAV (newer firmware: MAV_SYSID) = 2, or swap "
        "connections"
    )


def test_rates() -> None:
    looked = Looked()
    stream = looked.link.streams(looked.found.now_ns)[0]
    assert stream.name == "ATTITUDE"
    other = stream._replace(name="LOCAL_POSITION_NED")

    def with_stream(**changed: Any) -> Check:
        looked.link.streams = lambda _: [stream._replace(**changed), other]  # type: ignore[method-assign]
        return looked.line("ATTITUDE")

    assert with_stream().level == "ok"
    assert with_stream(measured_hz=15.0).level == "warning"
    assert with_stream(measured_hz=3.0).level == "blocking"
    assert with_stream(measured_hz=0.0).found == "waiting for it"
    assert with_stream(answer="waiting", granted_hz=None).level == "blocking"
    refused = with_stream(asked_hz=50.0)
    assert (refused.level, refused.found) == ("warning", "25.0 Hz of 50 Hz")
    assert "state_rate_hz = 25" in refused.advice


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
        (0.79, 0.79, 0.1, "warning"),
        (0.81, 0.1, 0.1, "blocking"),  # that of the velocity counts twice in Rover's own check
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
    line = looked.line("place", place=None)
    assert (line.level, line.found) == ("blocking", "waiting for its position")


@pytest.mark.parametrize(
    ("report", "found", "name"),
    [(constants.MESSAGE_EKF_STATUS_REPORT, "ekf", "EKF"), (constants.MESSAGE_GPS_RAW_INT, "gps", "GPS")],
)
def test_a_report_that_comes_no_more_stops_it(report: int, found: str, name: str) -> None:
    scene = Scene()
    scene.drive(0.3)
    scene.run(2.0)
    link = scene.bridge.link
    link._handlers[report] = lambda _arrival_ns, _message: None
    silent_ns = getattr(link, found).arrival_ns
    scene.run((silent_ns + REPORTED_NS - scene.now_ns) / NS_PER_S - 0.1)
    assert scene.bridge.reading.healthy
    scene.run(0.1 + JUDGED_NS / NS_PER_S + 0.1)
    assert not scene.bridge.reading.healthy
    assert scene.bridge.reading.note == f"waiting for its {name}: silent for 5 s"
    scene.run(3.0)
    assert scene.bridge.setpoints()[-1][1] == 0.0
    assert abs(scene.rover.speed) < 0.05


def test_a_report_that_is_bad_counts_at_once() -> None:
    scene = Scene()
    scene.drive(0.3)
    link = scene.bridge.link
    assert link.ekf is not None
    link.ekf = link.ekf._replace(flags=constants.EKF_UNINITIALIZED)
    scene.tick()
    assert scene.bridge.reading.note == "waiting for its EKF to start"
