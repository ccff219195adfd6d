"""What becomes of a rover when bridge, link, vehicle or estimate fail; its origin and its signing: bridge and
simulated vehicle in virtual time."""

from __future__ import annotations

import re
from math import hypot
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants, frames
from handfast.bridges.mavlink.ardupilot.frames import datum_of
from handfast.bridges.mavlink.session.identity import Signing, Timestamps
from handfast.plant.backend import Command
from tests.rover_scene import GO, MASS, START_NS, STOPS_S, Bridge, Scene, stands, take

ARM = "robot_defaults.mavlink.arm=true"
OWN_ID = "another program speaks as system 1, component 191, which is this bridge's own identity"


# ---------------------------------------------------------------------- the bridge


def test_when_the_bridge_dies_the_rover_stands_and_a_new_one_drives_on() -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.dead = True
    silent_s = scene.until(lambda: stands(scene), 10.0)
    # Measured: from 0.5 m/s it stood 3.7 s after the last command.
    assert 3.0 < silent_s < 3.0 + STOPS_S + 0.2
    assert (scene.rover.mode, scene.rover.armed) == ("GUIDED", True)
    scene.world.ports[0].arriving.clear()
    scene.bridges[:] = [Bridge(scene.world, 0, scene.fleet, token=77)]
    scene.bridge.command = GO
    scene.until(lambda: scene.bridge.readings and scene.bridge.reading.healthy, 5.0)
    scene.bridge.clear_to_drive()  # a resume
    took = scene.until(lambda: scene.rover.speed > 0.2, 10.0)
    assert took < 5.0
    assert scene.bridge.reading.obeying


@pytest.mark.parametrize("frozen_s", [1.0, 2.5, 6.0])
def test_a_bridge_that_was_frozen_drives_on(frozen_s: float) -> None:
    """The vehicle goes on for 3 s meanwhile, and then stands: that is no disobedience.

    After so long its operator may have had it: of what it said meanwhile, no buffer keeps all.
    """
    scene = Scene()
    scene.drive()
    scene.bridge.dead = True
    scene.run(frozen_s)
    scene.bridge.dead = False
    scene.bridge.command = None  # the last wrench is old when it wakes
    scene.run(0.1)
    scene.bridge.command = GO
    if frozen_s > 3.0:
        scene.run(3.0)
        assert stands(scene)
        assert re.match(r"nothing was heard of it for 6\.\d s, and its op", scene.bridge.reading.note)
        scene.bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.3, 5.0)
    assert not any("does not follow" in line for line in scene.bridge.log)


@pytest.mark.parametrize("how", ["HOLD", "disarmed"])
def test_taken_and_given_back_while_the_bridge_was_frozen_it_is_released_all_the_same(how: str) -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.dead = True
    scene.run(0.1)
    take(scene.rover, how)
    scene.run(0.3)
    assert scene.rover.set_mode("GUIDED")
    scene.rover.arm()
    scene.run(0.3)
    scene.bridge.dead = False
    woken_ns = scene.now_ns
    scene.bridge.command = GO
    scene.run(3.0)
    # What was only disarmed is in GUIDED: it is told to stand, since it may hold on to the last it was told.
    sent = [asked for _, *asked in scene.bridge.setpoints(woken_ns + 1)]
    assert sent == ([] if how == "HOLD" else [[0.0, 0.0]] * len(sent))
    assert "its operator has given it back" in scene.bridge.reading.note


def test_two_bridges_at_two_ports_the_later_one_keeps_off() -> None:
    scene = Scene(ports=3)
    scene.drive()
    later = Bridge(scene.world, 1, scene.fleet)
    later.command = Command(-MASS * 0.5, 0.0)
    scene.bridges.append(later)
    scene.run(5.0)
    later.clear_to_drive()
    scene.run(5.0)
    assert later.setpoints() == []
    assert later.reading.note == OWN_ID
    assert later.blocking["other bridges"] == OWN_ID
    assert scene.bridge.reading.obeying
    assert scene.rover.speed == pytest.approx(0.5, abs=0.05)
    # The first one ends: the later one has its turn once that has been silent for a while.
    scene.bridge.dead = True
    scene.until(lambda: scene.rover.speed < -0.2, 12.0)


# ---------------------------------------------------------------------- the vehicle


@pytest.mark.parametrize(
    ("kind", "autopilot", "what"),
    [
        (constants.TYPE_QUADROTOR, constants.AUTOPILOT_ARDUPILOT, "quadrotor"),
        (constants.TYPE_FIXED_WING, constants.AUTOPILOT_ARDUPILOT, "fixed wing"),
        (constants.TYPE_SUBMARINE, constants.AUTOPILOT_ARDUPILOT, "submarine"),
        (constants.TYPE_GROUND_ROVER, constants.AUTOPILOT_PX4, "PX4"),
        (constants.TYPE_GROUND_ROVER, mavlink.MAV_AUTOPILOT_GENERIC, "another autopilot"),
    ],
)
def test_a_vehicle_of_another_kind_is_never_commanded(kind: int, autopilot: int, what: str) -> None:
    scene = Scene(ARM, vehicle_type=kind, autopilot=autopilot, hand_over=False)
    scene.rover.set_mode("GUIDED")
    scene.rover.arm()
    bridge = scene.bridge
    bridge.command = GO
    scene.run(3.0)
    bridge.clear_to_drive()
    scene.run(5.0)
    assert bridge.setpoints() == []
    asked = {m.command for _, m in bridge.port.messages("COMMAND_LONG")}
    assert not asked & {constants.CMD_DO_SET_MODE, constants.CMD_COMPONENT_ARM_DISARM}
    assert bridge.port.messages("SET_GPS_GLOBAL_ORIGIN") == []
    assert what in bridge.reading.note
    assert not bridge.reading.healthy
    assert what in bridge.blocking["type"]


def test_a_rover_that_reboots_is_released_and_asked_for_everything_again() -> None:
    scene = Scene(boot_s=10.0)
    scene.drive()
    bridge = scene.bridge
    scene.run(4.0)
    asked = len(bridge.port.messages("PARAM_REQUEST_READ"))
    since_ns = scene.now_ns
    scene.rover.reboot()
    scene.until(lambda: not bridge.reading.obeying, 4.0)
    scene.until(lambda: scene.rover.ready, 20.0)
    scene.until(lambda: bridge.reading.healthy, 20.0)
    assert "mode MANUAL" in bridge.reading.note
    assert bridge.link.origin_ours, "it was offered anew"
    again = [m for _, m in bridge.port.messages("COMMAND_LONG", since_ns)]
    wanted = {m.param1 for m in again if m.command == constants.CMD_SET_MESSAGE_INTERVAL}
    assert {
        constants.MESSAGE_ATTITUDE,
        constants.MESSAGE_LOCAL_POSITION_NED,
        constants.MESSAGE_HEARTBEAT,
    } <= wanted
    scene.run(6.0)
    assert len(bridge.port.messages("PARAM_REQUEST_READ", since_ns)) >= min(10, asked)
    # While it was away the setpoints stopped; none has been sent since.
    assert all(
        at_ns < since_ns + 0.5 * NS_PER_S or speed == 0.0 for at_ns, speed, _ in bridge.setpoints(since_ns)
    )
    back_ns = scene.now_ns
    assert scene.rover.set_mode("GUIDED")
    assert scene.rover.arm()
    bridge.command = GO
    scene.run(2.0)
    assert bridge.setpoints(back_ns) == []
    bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)
    assert (scene.pose.x, scene.pose.y) == pytest.approx(bridge.reading.pose[:2], abs=0.06)


def test_a_cut_link_stops_it_and_back_again_and_resumed_it_drives_on_without_a_jump() -> None:
    scene = Scene()
    scene.drive()
    bridge = scene.bridge
    bridge.port.cut = True
    cut_ns = scene.now_ns
    heard = scene.until(lambda: not bridge.reading.healthy, 2.0)
    assert heard < 0.6, "its position is old long before its heartbeat is"
    assert scene.until(lambda: stands(scene), 10.0) + heard < 3.0 + STOPS_S + 0.2
    scene.run(5.0 - (scene.now_ns - cut_ns) / NS_PER_S)
    assert "no heartbeat of the vehicle for" in bridge.reading.note
    place = scene.pose
    bridge.port.cut = False
    bridge.command = GO
    scene.until(lambda: bridge.reading.healthy, 5.0)
    scene.run(3.0)
    assert stands(scene)
    note = r"nothing was heard of it for \d\.\d s, and its operator may have had it: waiting to be told to"
    assert re.match(note, bridge.reading.note)
    bridge.clear_to_drive()
    scene.until(lambda: bridge.reading.obeying, 5.0)
    before = [each for each in bridge.setpoints(cut_ns + NS_PER_S) if each[0] < scene.now_ns]
    assert {speed for _, speed, _ in before} <= {0.0}
    assert hypot(bridge.reading.pose.x - place.x, bridge.reading.pose.y - place.y) < 0.1
    first = bridge.setpoints(scene.now_ns)[0]
    assert abs(first[1]) <= (0.15 + 0.05) * 0.8, "from a standstill, not at the speed of before"
    scene.until(lambda: scene.rover.speed > 0.3, 5.0)
    assert bridge.readings[-1].obeying


@pytest.mark.parametrize("how", ["HOLD", "disarmed"])
def test_taken_and_given_back_while_its_link_was_cut_it_is_released_all_the_same(how: str) -> None:
    """A heartbeat says only which mode it is in now."""
    scene = Scene()
    scene.drive()
    scene.bridge.port.cut = True
    scene.run(1.5)
    take(scene.rover, how)
    scene.run(1.5)
    scene.rover.set_mode("GUIDED")
    scene.rover.arm()
    scene.run(0.5)
    scene.bridge.port.cut = False
    scene.bridge.command = GO
    scene.run(10.0)
    assert stands(scene)
    assert "its operator may have had it: waiting to be told to resume" in scene.bridge.reading.note


def test_a_connection_that_was_opened_again_waits_for_a_fresh_heartbeat() -> None:
    scene = Scene()
    scene.drive()
    bridge = scene.bridge
    bridge.port.arriving.clear()
    bridge.port.epoch += 1
    since_ns = scene.now_ns
    bridge.command = GO
    scene.tick()
    assert not bridge.reading.healthy
    bridge.port.cut = True
    bridge.port.arriving.clear()
    bridge.port.epoch += 1
    scene.run(1.0)
    assert "no heartbeat" in bridge.reading.note
    bridge.port.cut = False
    scene.until(lambda: bridge.reading.obeying, 5.0)
    before = [each for each in bridge.setpoints(since_ns + 1) if each[0] < scene.now_ns]
    assert {speed for _, speed, _ in before} <= {0.0}, "braking, from the first heartbeat on"
    scene.until(lambda: scene.rover.speed > 0.3, 5.0)


@pytest.mark.parametrize(("how", "bad", "measured"), [("JAM", 1.0, 11.4), ("ENABLE", 0.0, 8.1)])
def test_a_jammed_gps_ends_in_hold_and_a_release(how: str, bad: float, measured: float) -> None:
    scene = Scene()
    scene.drive(0.2)
    bridge = scene.bridge
    scene.rover.set_parameter(f"SIM_GPS1_{how}", bad)
    told = scene.until(lambda: not bridge.reading.healthy, 20.0)
    assert told < 3.0, "the lost fix is told once a second, and long before the EKF gives up"
    assert "GPS" in bridge.reading.note
    took = scene.until(lambda: scene.rover.mode == "HOLD", 20.0)
    assert told + took == pytest.approx(measured, abs=1.0)
    scene.run(1.0)
    assert any("EKF failsafe" in line for line in bridge.log)
    assert not bridge.reading.obeying
    scene.rover.set_parameter(f"SIM_GPS1_{how}", 1.0 - bad)
    since_ns = scene.now_ns
    scene.until(lambda: bridge.reading.healthy, 30.0)
    assert "HOLD" in bridge.reading.note
    scene.run(1.0)
    assert scene.rover.set_mode("GUIDED")
    bridge.command = GO
    scene.run(2.0)
    assert bridge.setpoints(since_ns) == []
    bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


def jump(scene: Scene, metres: float) -> None:
    """Its EKF is elsewhere from one moment to the next, and stays there."""
    navigation = scene.rover._vehicle.navigation
    navigation._home = frames.local_to_geodetic(navigation._home, metres, 0.0)


def test_a_position_that_jumps_far_is_not_driven_by_before_somebody_has_looked() -> None:
    """It would drive as far in truth, through whoever is on the way; others keep away from where it was."""
    scene = Scene()
    scene.drive()
    jump(scene, 30.0)
    jumped_ns = scene.now_ns
    scene.run(0.2)
    scene.bridge.command = GO
    scene.run(5.0)
    note = scene.bridge.reading.note
    assert note.startswith("its position jumped by ")
    assert note.endswith(" m: waiting to be told to resume")
    assert not scene.bridge.reading.healthy
    assert not scene.bridge.reading.obeying
    sent = scene.bridge.setpoints(jumped_ns + NS_PER_S // 5)
    assert {(speed, rate) for _, speed, rate in sent} <= {(0.0, 0.0)}
    scene.bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


# ---------------------------------------------------------------------- its origin


def test_an_origin_of_its_own_40_m_away_makes_no_difference() -> None:
    """The rover was switched on 40 m from the datum, and took its origin there; then it was driven here."""
    scene = Scene("robot.1.x_m=-40", "robot.1.y_m=9")
    scene.drive()
    origin = scene.bridge.link.origin
    assert origin is not None
    assert hypot(*frames.geodetic_to_world(datum_of(scene.fleet), origin)) == pytest.approx(41.0, abs=0.2)
    scene.run(2.0)
    assert (scene.bridge.reading.pose.x, scene.bridge.reading.pose.y) == pytest.approx(
        scene.pose[:2], abs=0.06
    )
    assert scene.bridge.check("origin").level == "ok"
    assert "its own" in scene.bridge.check("origin").found


def test_a_cold_rover_takes_the_datum_for_its_origin() -> None:
    scene = Scene(boot="cold", boot_s=10.0)
    scene.until(lambda: scene.bridge.reading.obeying, 20.0)
    assert scene.bridge.link.origin_ours
    assert "ours" in scene.bridge.check("origin").found
    assert (scene.bridge.reading.pose.x, scene.bridge.reading.pose.y) == pytest.approx(
        scene.pose[:2], abs=0.06
    )


def test_a_rover_50_km_from_the_datum_is_not_driven() -> None:
    home = frames.world_to_geodetic(datum_of(Scene().fleet), 50_000.0, 0.0)
    scene = Scene(home=home)
    scene.bridge.command = GO
    scene.run(6.0)
    assert scene.bridge.setpoints() == []
    assert "50 km from the datum" in scene.bridge.reading.note
    assert "50 km" in scene.bridge.blocking["origin"]


# ---------------------------------------------------------------------- signing

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))


def signing(tmp_path: Path, key: bytes = KEY) -> Signing:
    return Signing(key, Timestamps(tmp_path / "state", START_NS))


def test_signed_both_ways_it_drives(tmp_path: Path) -> None:
    scene = Scene(
        f'robot_defaults.mavlink.signing_key="{tmp_path}/key"', signing=signing(tmp_path), signing_key=KEY
    )
    scene.drive()
    assert scene.bridge.check("signing").level == "ok"


@pytest.mark.parametrize("vehicle_key", [b"", OTHER_KEY], ids=["unsigned", "another_key"])
def test_a_vehicle_that_does_not_sign_with_the_key_is_not_there(tmp_path: Path, vehicle_key: bytes) -> None:
    scene = Scene(
        f'robot_defaults.mavlink.signing_key="{tmp_path}/key"',
        signing=signing(tmp_path),
        signing_key=vehicle_key,
    )
    scene.bridge.command = GO
    scene.run(5.0)
    assert scene.bridge.setpoints() == []
    assert "signed" in scene.bridge.reading.note
    assert "signed" in scene.bridge.blocking["link"]
