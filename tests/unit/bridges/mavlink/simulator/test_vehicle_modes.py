"""Modes, arming and failsafes of the simulated rover."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.navigation import Variances
from tests.unit.bridges.mavlink.rover_bench import ACCEPTED, DENIED, FAILED, Bench, ready

# Modes and arming


def test_arming_is_refused_in_words_before_it_is_ready() -> None:
    bench = Bench()
    bench.run(3.0)
    assert bench.command(constants.CMD_COMPONENT_ARM_DISARM, 1) == FAILED
    assert bench.texts()[-1] == "Arm: AHRS: EKF3 not started"
    bench.run(20.0)
    assert bench.command(constants.CMD_COMPONENT_ARM_DISARM, 1) == FAILED
    assert bench.texts()[-1] == "Arm: Need Position Estimate"
    bench.run(12.0)
    assert any(text.startswith("PreArm: ") for text in bench.texts())
    bench.run(10.0)
    assert bench.command(constants.CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert bench.rover.armed
    assert bench.texts()[-1] == "Throttle armed"
    bench.run(1.1)
    assert bench.last("HEARTBEAT").base_mode & constants.FLAG_ARMED
    assert bench.command(constants.CMD_COMPONENT_ARM_DISARM, 0) == ACCEPTED
    assert not bench.rover.armed


def test_modes_by_command_and_by_message() -> None:
    bench = Bench(boot="warm")
    flag = constants.FLAG_CUSTOM_MODE
    assert bench.command(constants.CMD_DO_SET_MODE, flag, constants.MODE_GUIDED) == ACCEPTED
    assert bench.rover.mode == "GUIDED"
    bench.send(mavlink.MAVLink_set_mode_message(1, flag, constants.MODE_HOLD))
    bench.run(0.05)
    assert bench.rover.mode == "HOLD"
    assert bench.last("COMMAND_ACK").command == 11
    assert bench.command(constants.CMD_DO_SET_MODE, flag, 42) == FAILED
    assert bench.command(constants.CMD_DO_SET_MODE, 0, constants.MODE_GUIDED) == DENIED
    assert bench.rover.mode == "HOLD"


def test_the_operator_hands_over_once() -> None:
    bench = Bench(hand_over=True, boot_s=4.0)
    assert bench.until(lambda: bench.rover.armed) == pytest.approx(4.0, abs=0.1)
    assert bench.rover.mode == "GUIDED"
    bench.rover.reboot()
    bench.run(10.0)
    assert bench.rover.ready
    assert (bench.rover.mode, bench.rover.armed) == ("MANUAL", False)


def test_a_reboot_begins_anew_where_it_stands() -> None:
    bench = ready(boot_s=4.0)
    bench.run(6.0, lambda: bench.drive(0.5))
    assert bench.command(constants.CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == FAILED
    bench.set_parameter("WP_SPEED", 0.7)
    before, origin = bench.rover.north, bench.rover.origin
    bench.rover.disarm()
    bench.rover.reboot()
    since = bench.time
    bench.run(0.09)
    assert [t for t, _, _ in bench.heard if t > since] == []
    bench.run(8.0)
    assert bench.rover.boots == 2
    assert not bench.rover.armed
    assert 0.02 < bench.rover.north - before < 0.1
    assert bench.rover.origin is not None
    assert bench.rover.origin != origin
    assert "Throttle disarmed" not in bench.texts()
    assert bench.last("ATTITUDE").time_boot_ms < 8_200


# Failsafes


def test_the_ground_station_failsafe_counts_heartbeats_of_its_own_one() -> None:
    bench = ready(parameters={"FS_GCS_ENABLE": 1})
    bench.run(10.0, lambda: (bench.drive(0.5), bench.heartbeat(system=1, component=191)))
    assert bench.rover.mode == "GUIDED", "it never saw its ground station, so it misses nobody"
    bench.run(5.0, lambda: (bench.drive(0.5), bench.heartbeat()))
    since = bench.time
    bench.run(10.0, lambda: (bench.drive(0.5), bench.heartbeat(system=1, component=191)))
    (fired,) = [
        t
        for t, _, m in bench.heard
        if m.get_type() == "STATUSTEXT" and m.text == "GCS Failsafe" and t > since
    ]
    assert fired - since == pytest.approx(6.5, abs=0.1)
    assert bench.rover.mode == "HOLD"
    assert bench.rover.armed
    assert bench.last("HEARTBEAT").system_status == constants.STATE_CRITICAL
    bench.run(3.0, lambda: (bench.drive(0.5), bench.heartbeat()))
    assert "GCS Failsafe Cleared" in bench.texts(since)
    assert bench.rover.mode == "HOLD", "the operator has to ask for GUIDED again"


@pytest.mark.parametrize(
    ("name", "value", "measured"), [("SIM_GPS1_JAM", 1, 11.4), ("SIM_GPS1_ENABLE", 0, 8.1)]
)
def test_a_jammed_gps_ends_in_hold(name: str, value: float, measured: float) -> None:
    bench = ready()
    bench.run(5.0, lambda: bench.drive(0.3))
    since = bench.time
    bench.set_parameter(name, value)
    bench.run(measured - 1.0, lambda: bench.drive(0.3))
    assert bench.last("GPS_RAW_INT").fix_type < constants.GPS_3D_FIX
    assert bench.rover.mode == "GUIDED"
    fired = bench.until(lambda: bench.rover.mode == "HOLD", 5.0)
    assert fired - since == pytest.approx(measured, abs=0.3)
    bench.run(1.5)
    assert "EKF failsafe" in bench.texts(since)
    assert bench.last("EKF_STATUS_REPORT").flags == 0xA7
    bench.set_parameter(name, 1 - value)
    bench.run(15.0)
    assert "EKF failsafe cleared" in bench.texts(since)
    assert bench.last("EKF_STATUS_REPORT").flags == 0x33F
    assert bench.rover.mode == "HOLD"


@pytest.mark.parametrize(
    ("velocity", "position", "compass", "mode"),
    [
        (0.81, 0.0, 0.0, "HOLD"),
        (0.79, 0.79, 0.79, "GUIDED"),
        (0.0, 0.9, 0.0, "GUIDED"),
        (0.0, 0.0, 0.9, "GUIDED"),
        (0.0, 0.9, 0.9, "HOLD"),
    ],
)
def test_which_variances_of_its_ekf_are_a_failsafe(
    velocity: float, position: float, compass: float, mode: str
) -> None:
    """Rover's own check counts that of the velocity twice, and asks for two."""
    bench = ready()
    bench.rover._vehicle.navigation.variances = Variances(velocity, position, compass)
    bench.run(0.9, lambda: bench.drive(0.3))
    assert bench.rover.mode == "GUIDED", "for a second"
    bench.run(1.5, lambda: bench.drive(0.3))
    assert bench.rover.mode == mode
    assert bench.last("EKF_STATUS_REPORT").velocity_variance == pytest.approx(velocity)
