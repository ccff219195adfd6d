"""Who has a rover, and what becomes of it when something fails: bridge and simulated vehicle in virtual time.

tests/process/test_rovers.py has some of this with real processes, sockets and kills.
"""

from __future__ import annotations

from itertools import pairwise
from math import hypot, inf, nan, pi
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.common.time import NS_PER_S
from agent.supervision.state_machine import at_rest
from bridges.mavlink.ardupilot import constants, frames
from bridges.mavlink.ardupilot.frames import datum_of
from bridges.mavlink.bridge.backend import NO_MISSION
from bridges.mavlink.session.signing import Signing, Timestamps
from bridges.mavlink.simulator.rover import Rover
from plant.backend import Command
from tests.rover_scene import MASS, START_NS, Bridge, Scene, heartbeat, set_mode

ONE_CYCLE_S = 0.05
ARRIVES_S = 0.03
"""From the switch of a mode to the heartbeat that tells it being in the bridge's hands."""
STOPS_S = 0.8
"""What a rover needs from 0.5 m/s to a stand."""
GO = Command(MASS * 0.3, 0.0)
OWN_ID = "another program speaks as system 1, component 191, which is this bridge's own identity"


def take(rover: Rover, how: str) -> None:
    if how == "disarmed":
        rover.disarm()
    else:
        assert rover.set_mode(how)


def stands(scene: Scene) -> bool:
    return at_rest(scene.rover.speed, scene.rover.yaw_rate)


# ---------------------------------------------------------------------- the operator


@pytest.mark.parametrize("how", ["MANUAL", "HOLD", "RTL", "LOITER", "disarmed"])
def test_the_operator_takes_over_within_one_cycle(how: str) -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.command = GO
    scene.run(0.2)
    taken_ns = scene.now_ns
    take(scene.rover, how)
    scene.until(lambda: not scene.bridge.reading.obeying)
    assert scene.now_ns - taken_ns <= (ONE_CYCLE_S + ARRIVES_S) * NS_PER_S
    assert scene.bridge.reading.healthy
    assert scene.bridge.reading.note.startswith("its operator has it: ")
    assert how.lower() in scene.bridge.reading.note.lower()
    released_ns = scene.now_ns
    scene.run(10.0)
    sent = scene.bridge.setpoints(released_ns)
    if how == "disarmed":  # in GUIDED still: armed anew within 3 s it would take up what it was told last
        assert all((speed, rate) == (0.0, 0.0) for _, speed, rate in sent)
        sent = scene.bridge.setpoints(released_ns + 4 * NS_PER_S)
    assert sent == [], "the tick that hears of it sends nothing, nor any after"


def test_a_mode_that_is_heard_is_looked_at_before_anything_is_sent() -> None:
    """The heartbeat with the new mode and the next setpoint never pass each other within a tick."""
    scene = Scene()
    scene.drive()
    bridge = scene.bridge
    scene.rover.set_mode("MANUAL")
    while bridge.link.mode == constants.MODE_GUIDED:
        before_ns = scene.now_ns
        scene.tick()
    assert bridge.setpoints(before_ns + 1) == []


def test_given_back_it_stays_released_until_the_fleet_is_told_to_resume() -> None:
    scene = Scene()
    scene.drive()
    bridge = scene.bridge
    scene.rover.set_mode("MANUAL")
    scene.run(1.0)
    bridge.clear_to_drive()  # too early: its operator still has it
    scene.run(1.0)
    back_ns = scene.now_ns
    assert scene.rover.set_mode("GUIDED")
    bridge.command = GO
    scene.run(5.0)
    assert "has given it back" in bridge.reading.note
    assert bridge.reading.note.endswith("waiting to be told to resume")
    assert not bridge.reading.obeying
    assert bridge.setpoints(back_ns) == []
    bridge.clear_to_drive()
    scene.until(lambda: bridge.reading.obeying, 0.1)
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


def test_a_rover_that_was_never_handed_over_is_not_commanded() -> None:
    scene = Scene(hand_over=False)
    bridge = scene.bridge
    bridge.command = GO
    scene.run(5.0)
    assert bridge.reading.note == "mode MANUAL, not GUIDED"
    assert scene.rover.set_mode("GUIDED")
    scene.run(2.0)
    assert bridge.reading.note == "disarmed"
    assert not scene.rover.armed
    assert bridge.setpoints() == []
    assert [
        m for _, m in bridge.port.messages("COMMAND_LONG") if m.command == constants.CMD_DO_SET_MODE
    ] == []
    assert scene.rover.arm()
    scene.run(2.0)
    assert bridge.setpoints() == [], "the fleet was not told to drive"
    bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


def test_a_mission_while_the_operator_drives_does_not_take_the_rover_from_him() -> None:
    scene = Scene(hand_over=False)
    scene.run(4.0)
    scene.bridge.clear_to_drive()
    scene.bridge.command = GO
    scene.rover.set_mode("GUIDED")
    scene.rover.arm()
    scene.run(3.0)
    assert scene.bridge.setpoints() == []
    assert not scene.bridge.reading.obeying


def test_a_wrench_before_any_mission_is_not_obeyed() -> None:
    """Of one that started again in mid-drive the vehicle stands until the mission is said again."""
    scene = Scene()
    scene.until(lambda: scene.bridge.reading.obeying)
    scene.bridge.command = GO
    scene.run(3.0)
    assert scene.bridge.setpoints() == []
    assert scene.bridge.reading.healthy
    assert not scene.bridge.reading.obeying
    assert scene.bridge.reading.note == NO_MISSION
    scene.bridge.command = None  # what its agent does about it
    scene.tick()
    assert not scene.bridge.reading.obeying, "else it would ask it to drive again"
    scene.bridge.clear_to_drive()
    scene.bridge.command = GO
    scene.until(lambda: scene.rover.speed > 0.3)
    assert scene.bridge.reading.obeying


def test_taken_and_given_back_while_its_estimate_is_bad_it_is_released_all_the_same() -> None:
    scene = Scene()
    scene.drive()
    bridge = scene.bridge
    scene.rover.set_parameter("SIM_GPS1_JAM", 1.0)
    scene.until(lambda: not bridge.reading.healthy)
    scene.rover.set_mode("MANUAL")
    scene.run(0.5)
    scene.rover.set_mode("GUIDED")
    scene.run(0.5)
    assert scene.rover.mode == "GUIDED"
    scene.rover.set_parameter("SIM_GPS1_JAM", 0.0)
    back_ns = scene.now_ns
    bridge.command = GO
    scene.until(lambda: bridge.reading.healthy)
    scene.run(3.0)
    assert bridge.setpoints(back_ns) == []
    assert "waiting to be told to resume" in bridge.reading.note


def test_a_ground_station_is_let_be_and_its_mode_wins() -> None:
    scene = Scene(ports=2)
    scene.say(heartbeat())
    scene.drive()
    bridge = scene.bridge

    def beat() -> None:
        if round(scene.time * 20) % 20 == 0:
            # QGroundControl's, and one that says of itself what an autopilot would.
            scene.say(heartbeat())
            scene.say(heartbeat(mavlink.MAV_TYPE_GCS, constants.AUTOPILOT_ARDUPILOT), system=1, component=190)

    scene.run(3.0, beat)
    assert bridge.reading.obeying
    assert bridge.link.type == constants.TYPE_GROUND_ROVER
    assert bridge.link.mode == constants.MODE_GUIDED
    assert bridge.check("ground station").level == "ok"
    assert "255" in bridge.check("ground station").found
    scene.say(set_mode(constants.MODE_HOLD))
    scene.until(lambda: not bridge.reading.obeying, 0.2)
    released_ns = scene.now_ns
    scene.run(2.0, beat)
    assert bridge.setpoints(released_ns) == []
    assert "HOLD" in bridge.reading.note


# ---------------------------------------------------------------------- arm = true

ARM = "robot_defaults.mavlink.arm=true"


def test_told_to_arm_it_claims_the_rover_once_and_never_from_its_operator() -> None:
    scene = Scene(ARM, hand_over=False, boot="cold", boot_s=10.0)
    scene.run(9.0)
    assert not scene.rover.armed, "not before its EKF is ready"
    assert not scene.rover.crashed
    scene.drive()
    assert scene.rover.armed
    scene.rover.set_mode("MANUAL")
    scene.run(8.0)
    assert scene.rover.mode == "MANUAL"
    scene.rover.disarm()
    scene.run(8.0)
    assert (scene.rover.mode, scene.rover.armed) == ("MANUAL", False)


def test_told_to_arm_it_arms_once_though_no_mission_came_yet() -> None:
    scene = Scene(ARM, hand_over=False)
    scene.until(lambda: scene.bridge.reading.obeying)
    scene.rover.disarm()
    scene.run(10.0)
    assert (scene.rover.mode, scene.rover.armed) == ("GUIDED", False)
    assert scene.bridge.reading.note == "disarmed"


def test_told_to_arm_it_leaves_a_rover_alone_that_somebody_drives() -> None:
    scene = Scene(ARM, hand_over=False)
    scene.rover.arm()
    scene.run(10.0)
    assert (scene.rover.mode, scene.rover.armed) == ("MANUAL", True)


def test_told_to_arm_it_gives_up_when_the_operator_leaves_guided_before_it_is_armed() -> None:
    scene = Scene(ARM, hand_over=False)
    scene.until(lambda: scene.rover.mode == "GUIDED")
    scene.rover.set_mode("HOLD")
    scene.run(10.0)
    assert (scene.rover.mode, scene.rover.armed) == ("HOLD", False)
    assert any("asked no more" in line for line in scene.bridge.log)


def test_told_to_arm_it_sees_the_operator_leave_guided_while_there_is_trouble() -> None:
    scene = Scene(ARM, hand_over=False)
    scene.until(lambda: any("asking for GUIDED" in line for line in scene.bridge.log))
    scene.bridge.port.trouble = "cannot be opened"
    scene.run(0.3)
    assert scene.rover.mode == "GUIDED"
    scene.rover.set_mode("HOLD")
    scene.run(0.3)
    scene.bridge.port.trouble = ""
    scene.run(10.0)
    assert (scene.rover.mode, scene.rover.armed) == ("HOLD", False)


def test_what_its_operator_armed_anew_it_does_not_disarm_at_its_end() -> None:
    scene = Scene(ARM, hand_over=False)
    scene.drive()
    scene.rover.disarm()
    scene.run(4.0)  # the vehicle goes on with a setpoint of the last 3 s
    scene.rover.arm()
    scene.run(1.0)
    assert stands(scene)
    scene.bridge.plant.close()
    scene.bridge.dead = True
    scene.run(0.2)
    assert scene.rover.armed


@pytest.mark.parametrize("armed_here", [True, False])
def test_what_it_armed_it_disarms_at_its_end_and_nothing_else(armed_here: bool) -> None:
    scene = Scene(*([ARM] if armed_here else []), hand_over=not armed_here)
    scene.drive()
    scene.bridge.command = None
    scene.until(lambda: abs(scene.bridge.reading.pose.speed) < 0.06)
    scene.bridge.plant.close()
    scene.bridge.dead = True
    scene.run(0.2)
    assert scene.rover.armed is not armed_here


# ---------------------------------------------------------------------- wrenches


def test_without_a_wrench_it_brakes_until_it_stands_and_is_silent_then() -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.command = None
    since_ns = scene.now_ns
    took = scene.until(lambda: stands(scene), 3.0)
    assert took < STOPS_S + 0.3
    scene.run(5.0)
    sent = scene.bridge.setpoints(since_ns + 1)
    assert {(speed, yaw_rate) for _, speed, yaw_rate in sent} == {(0.0, 0.0)}
    assert sent[-1][0] - since_ns < 3.2 * NS_PER_S
    assert scene.bridge.reading.obeying, "it stands, and goes on when it is told to"
    scene.bridge.command = GO
    scene.until(lambda: scene.rover.speed > 0.2, 3.0)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("which", ["force", "torque"])
def test_what_is_no_number_never_reaches_the_wire_and_brakes(bad: float, which: str) -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.command = Command(bad, 0.0) if which == "force" else Command(0.0, bad)
    since_ns = scene.now_ns
    scene.run(2.0)
    assert not scene.rover.crashed
    assert {(speed, yaw_rate) for _, speed, yaw_rate in scene.bridge.setpoints(since_ns + 1)} == {(0.0, 0.0)}
    assert stands(scene)
    assert any("not a number" in line for line in scene.bridge.log)
    scene.bridge.command = GO
    scene.until(lambda: scene.rover.speed > 0.2, 3.0)


def test_enormous_wrenches_stay_within_the_limits_of_the_fleet_file() -> None:
    scene = Scene("robot_defaults.mavlink.max_speed_mps=0.7", "robot_defaults.mavlink.max_yaw_rate_radps=0.5")
    scene.drive(0.3)
    scene.bridge.command = Command(1e300, -1e300)
    since_ns = scene.now_ns
    scene.run(4.0)
    sent = scene.bridge.setpoints(since_ns)
    assert max(speed for _, speed, _ in sent) == pytest.approx(0.7)
    assert min(rate for _, _, rate in sent) == pytest.approx(-0.5)
    steps = [b[1] - a[1] for a, b in pairwise(sent)]
    # The lead of 0.15 s comes on top, once.
    assert max(steps[3:]) <= 0.8 * 0.05 + 1e-6


def test_reverse_and_turning_on_the_spot() -> None:
    scene = Scene()
    scene.drive(-0.4)
    begun = scene.pose
    scene.run(2.0)
    pose = scene.pose
    assert pose.x - begun.x == pytest.approx(-0.8, abs=0.1), "it points east"
    assert scene.bridge.reading.pose.speed < -0.35
    assert scene.bridge.reading.pose.x == pytest.approx(pose.x, abs=0.05)
    scene.bridge.command = None
    scene.until(lambda: stands(scene))
    scene.bridge.command = Command(0.0, 1.2 * 0.3)
    heading = scene.pose.heading
    scene.run(1.0)
    scene.bridge.command = Command(0.0, 0.0)
    scene.run(1.0)
    assert scene.rover.speed == pytest.approx(0.0, abs=0.05)
    assert scene.pose.heading - heading > 0.3, "a torque above 0 turns counter-clockwise"
    assert scene.bridge.reading.pose.yaw_rate == pytest.approx(0.3, abs=0.06)


@pytest.mark.parametrize(
    ("yaw", "direction"), [(0.0, (0.0, 1.0)), (pi / 2, (1.0, 0.0)), (pi, (0.0, -1.0)), (-pi / 2, (-1.0, 0.0))]
)
def test_the_world_is_east_and_north(yaw: float, direction: tuple[float, float]) -> None:
    """A rover that points north at yaw 0 drives to +y, one that points east to +x."""
    scene = Scene(yaw=yaw)
    scene.drive()
    first = scene.bridge.reading.pose
    scene.run(2.0)
    last = scene.bridge.reading.pose
    way = last.x - first.x, last.y - first.y
    assert hypot(*way) > 0.8
    assert way[0] == pytest.approx(direction[0] * hypot(*way), abs=0.06)
    assert way[1] == pytest.approx(direction[1] * hypot(*way), abs=0.06)
    assert (scene.pose.x, scene.pose.y) == pytest.approx((last.x, last.y), abs=0.06)


def test_a_rover_that_is_stuck_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    scene.drive(0.4)
    truth = scene.rover._vehicle.truth
    step = truth.step

    def blocked(*arguments: Any, **named: Any) -> None:
        place = truth.north, truth.east, truth.yaw
        step(*arguments, **named)
        truth.north, truth.east, truth.yaw = place
        truth.speed = truth.yaw_rate = 0.0

    monkeypatch.setattr(truth, "step", blocked)
    scene.bridge.command = GO
    scene.until(lambda: not scene.bridge.reading.obeying, 5.0)
    assert "does not follow its commands: asked for " in scene.bridge.reading.note
    scene.run(4.0)
    since_ns = scene.now_ns
    scene.run(2.0)
    assert scene.bridge.setpoints(since_ns) == [], "zeros at first, then nothing"
    monkeypatch.undo()
    scene.bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


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
    scene.bridge.clear_to_drive()  # the operator says the mission again to a process that lacks it
    took = scene.until(lambda: scene.rover.speed > 0.2, 10.0)
    assert took < 5.0
    assert scene.bridge.reading.obeying


@pytest.mark.parametrize("frozen_s", [1.0, 6.0])
def test_a_bridge_that_was_frozen_drives_on(frozen_s: float) -> None:
    """The vehicle goes on for 3 s meanwhile, and then stands: that is no disobedience."""
    scene = Scene()
    scene.drive()
    scene.bridge.dead = True
    scene.run(frozen_s)
    scene.bridge.dead = False
    scene.bridge.command = None  # the last wrench is old when it wakes
    scene.run(0.1)
    scene.bridge.command = GO
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


def test_two_bridges_that_start_at_once_both_keep_off() -> None:
    scene = Scene(ports=2)
    scene.bridges.append(Bridge(scene.world, 1, scene.fleet))
    for bridge in scene.bridges:
        bridge.command = GO
    scene.run(8.0)
    for bridge in scene.bridges:
        assert bridge.setpoints() == []
        assert bridge.reading.note == OWN_ID


def test_a_bridge_with_an_identity_of_its_own_is_found_too() -> None:
    scene = Scene(ports=2)
    scene.drive()
    fleet = Scene("robot_defaults.mavlink.own_component=192").fleet
    scene.bridges.append(Bridge(scene.world, 1, fleet))
    scene.bridges[1].command = Command(-MASS, 0.0)
    scene.run(6.0)
    assert scene.bridges[1].setpoints() == []
    assert "another onboard controller" in scene.bridges[1].reading.note
    assert scene.bridge.reading.obeying


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


def test_what_kept_it_from_arming_before_a_reboot_is_not_told_of_it_after() -> None:
    scene = Scene(boot_s=10.0)
    scene.until(lambda: scene.bridge.reading.obeying)
    scene.rover._vehicle.say(2, "PreArm: Hardware safety switch")
    scene.run(0.5)
    assert any("Hardware safety switch" in line for line in scene.bridge.log)
    scene.rover.reboot()
    scene.run(1.0)
    scene.until(lambda: "arming" in scene.bridge.blocking, 10.0)
    assert "Hardware" not in scene.bridge.blocking["arming"]


def test_a_cut_link_stops_it_and_back_again_it_drives_on_without_a_jump() -> None:
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
    scene.until(lambda: bridge.reading.obeying, 5.0)
    before = [each for each in bridge.setpoints(cut_ns + NS_PER_S) if each[0] < scene.now_ns]
    assert {speed for _, speed, _ in before} <= {0.0}
    assert hypot(bridge.reading.pose.x - place.x, bridge.reading.pose.y - place.y) < 0.1
    first = bridge.setpoints(scene.now_ns)[0]
    assert abs(first[1]) <= (0.15 + 0.05) * 0.8, "from a standstill, not at the speed of before"
    scene.until(lambda: scene.rover.speed > 0.3, 5.0)
    assert bridge.readings[-1].obeying


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


def test_a_jammed_gps_ends_in_hold_and_a_release() -> None:
    scene = Scene()
    scene.drive(0.2)
    bridge = scene.bridge
    scene.rover.set_parameter("SIM_GPS1_JAM", 1.0)
    told = scene.until(lambda: not bridge.reading.healthy, 20.0)
    assert told < 3.0, "the lost fix is told once a second, and long before the EKF gives up"
    assert "GPS" in bridge.reading.note
    took = scene.until(lambda: scene.rover.mode == "HOLD", 20.0)
    assert told + took == pytest.approx(14.5, abs=1.0)
    scene.run(1.0)
    assert any("EKF failsafe" in line for line in bridge.log)
    assert not bridge.reading.obeying
    scene.rover.set_parameter("SIM_GPS1_JAM", 0.0)
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


def test_bad_flags_of_its_ekf_are_told_at_once() -> None:
    """Its GPS is as good as ever, but its EKF says that it has no position."""
    scene = Scene()
    scene.drive(0.2)
    navigation = scene.rover._vehicle.navigation
    lost = property(lambda _: constants.EKF_ATTITUDE | constants.EKF_CONST_POS_MODE)
    navigation.__class__ = type("Lost", (type(navigation),), {"flags": lost})
    took = scene.until(lambda: not scene.bridge.reading.healthy, 2.0)
    assert took < 0.7
    assert scene.bridge.reading.note == "waiting for its EKF to have a position"
    assert scene.until(lambda: stands(scene), 3.0) < STOPS_S + 0.3, "and it is braked"


def test_a_rate_that_is_refused_is_followed_by_a_lower_one_that_is_said() -> None:
    scene = Scene("robot_defaults.mavlink.state_rate_hz=50")
    scene.drive()
    scene.run(5.0)
    rows = {row.name: row for row in scene.bridge.link.streams(scene.now_ns)}
    for name in ("ATTITUDE", "LOCAL_POSITION_NED"):
        assert rows[name].asked_hz == 50.0
        assert rows[name].granted_hz == 25.0
        assert rows[name].measured_hz == pytest.approx(25.0, abs=1.0)
        line = scene.bridge.check(name)
        assert line.level == "warning"
        assert "50 Hz" in line.found
        assert line.found.startswith(("24", "25"))


def test_the_rate_that_is_granted_comes() -> None:
    scene = Scene()
    scene.drive()
    scene.run(5.0)
    assert scene.bridge.check("ATTITUDE").level == "ok"
    assert scene.bridge.blocking == {}


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


def test_told_not_to_it_gives_no_origin() -> None:
    scene = Scene("robot_defaults.mavlink.set_origin=false", boot="cold", boot_s=10.0)
    scene.until(lambda: scene.bridge.reading.obeying, 20.0)
    assert scene.bridge.port.messages("SET_GPS_GLOBAL_ORIGIN") == []
    assert not scene.bridge.link.origin_ours


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


def test_a_bridge_without_the_key_of_a_signing_port_is_told_so(tmp_path: Path) -> None:
    """Ports but the first refuse what is not signed: nothing of what is asked for comes."""
    scene = Scene(ports=2, signing_key=KEY)
    scene.bridges[:] = [Bridge(scene.world, 1, scene.fleet)]
    scene.bridge.command = GO
    scene.run(8.0)
    assert scene.rover.speed == 0.0
    assert scene.bridge.link.vehicle_signs
    assert scene.bridge.blocking
