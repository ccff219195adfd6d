"""The lines of the link, its rates, its round trip, its signing and who else is on it."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

from handfast.agent.common.time import NS_PER_S
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
