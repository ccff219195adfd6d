"""Who has a rover, and what its bridge makes of wrenches, fences and steering, in virtual time.

tests/process/test_rovers.py has some of this with real processes, sockets and kills.
"""

from __future__ import annotations

from itertools import pairwise
from math import hypot, inf, nan, pi

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE
from handfast.plant.backend import Command
from tests.rover_fleet import Hold
from tests.rover_scene import GO, STOPS_S, Scene, heartbeat, set_mode, stands, take

ONE_CYCLE_S = 0.05
ARRIVES_S = 0.03
"""From the switch of a mode to the heartbeat that tells it being in the bridge's hands."""


# ---------------------------------------------------------------------- the operator


@pytest.mark.parametrize("after_s", [0.2, 0.25, 0.3, 0.35])
@pytest.mark.parametrize("how", ["MANUAL", "HOLD", "RTL", "LOITER", "disarmed"])
def test_the_operator_takes_over_within_one_cycle(how: str, after_s: float) -> None:
    scene = Scene()
    scene.drive()
    scene.bridge.command = GO
    scene.run(after_s)
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


@pytest.mark.parametrize("after_s", [0.05, 0.1, 0.15, 0.25])
def test_disarmed_and_armed_again_at_once_it_is_its_operators(after_s: float) -> None:
    """Between two heartbeats: its own words tell."""
    scene = Scene()
    scene.drive()
    scene.bridge.command = GO
    scene.run(1.0 + after_s)
    scene.rover.disarm()
    scene.run(0.02)
    scene.rover.arm()
    scene.run(3.0)
    assert not scene.bridge.reading.obeying
    assert "its operator has given it back (it was: disarmed)" in scene.bridge.reading.note
    scene.bridge.clear_to_drive()
    scene.run(0.2)
    assert scene.bridge.reading.obeying


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


def test_a_wrench_before_it_was_cleared_to_drive_is_not_obeyed() -> None:
    """Of one that started again in mid-drive the vehicle stands until somebody says resume."""
    scene = Scene()
    scene.until(lambda: scene.bridge.reading.obeying)
    scene.bridge.command = GO
    scene.run(3.0)
    assert scene.bridge.setpoints() == []
    assert scene.bridge.reading.healthy
    assert not scene.bridge.reading.obeying
    assert scene.bridge.reading.note == BEGUN_LATE
    scene.bridge.command = None  # what its agent does about it
    scene.tick()
    assert not scene.bridge.reading.obeying, "else it would ask it to drive again"
    scene.bridge.clear_to_drive()
    scene.bridge.command = GO
    scene.until(lambda: scene.rover.speed > 0.3)
    assert scene.bridge.reading.obeying


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


def test_a_rover_that_is_stuck_is_let_go() -> None:
    scene = Scene()
    scene.drive(0.4)
    held = Hold(scene.rover)
    scene.bridge.command = GO
    scene.until(lambda: not scene.bridge.reading.obeying, 5.0)
    assert "does not follow its commands: asked for " in scene.bridge.reading.note
    scene.run(4.0)
    since_ns = scene.now_ns
    scene.run(2.0)
    assert scene.bridge.setpoints(since_ns) == [], "zeros at first, then nothing"
    held.free()
    scene.bridge.clear_to_drive()
    scene.until(lambda: scene.rover.speed > 0.2, 5.0)


def fenced(**parameters: float) -> Scene:
    """A rover with a fence of its own 12 m around where it stands, that drives at it."""
    scene = Scene(parameters={"FENCE_ENABLE": 1.0, "FENCE_RADIUS": 12.0, "FENCE_ACTION": 2.0, **parameters})
    scene.until(lambda: scene.bridge.link.parameters_done)
    scene.drive(0.5)
    scene.bridge.command = GO
    scene.until(lambda: not scene.bridge.reading.obeying, 60.0)
    return scene


def test_a_rover_that_stands_before_its_own_fence_is_told_as_that() -> None:
    scene = fenced()
    assert (scene.rover.mode, scene.rover.armed) == ("GUIDED", True)
    assert hypot(scene.rover.north, scene.rover.east) == pytest.approx(10.0, abs=0.6)
    note = scene.bridge.reading.note
    assert note.startswith("stands before its own fence (AVOID_ENABLE): asked for ")
    assert "does not follow" not in note
    line = scene.bridge.check("AVOID_ENABLE")
    assert (line.level, line.found) == ("warning", "3: before its own fence it stops and stays in GUIDED")
