"""Parameters, signing and others on the ports of the simulated rover; its settings."""

from __future__ import annotations

from math import nan, pi

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.simulator.settings import Settings, SettingsError, parse_home, parse_parameter
from tests.unit.bridges.mavlink.rover_bench import ACCEPTED, START_NS, Bench, ready

# Parameters


def test_its_system_id_is_a_parameter_that_a_reboot_makes_true() -> None:
    bench = Bench(boot="warm", boot_s=4.0, system=9)
    bench.run(0.1)
    assert bench.last("HEARTBEAT").get_srcSystem() == 9
    bench.set_parameter("SYSID_THISMAV", 12.0)
    bench.run(1.5)
    assert bench.last("HEARTBEAT").get_srcSystem() == 9
    bench.rover.reboot()
    bench.run(2.0)
    assert bench.last("HEARTBEAT").get_srcSystem() == 12


def test_parameters_are_read_by_name_and_by_number_and_set() -> None:
    bench = Bench(boot="warm", ports=2)
    bench.run(0.1)
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"FS_GCS_TIMEOUT", -1))
    bench.run(0.05)
    answer = bench.last("PARAM_VALUE")
    assert (answer.param_id, answer.param_value) == ("FS_GCS_TIMEOUT", 5.0)
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", answer.param_index))
    bench.run(0.05)
    assert [m.param_id for m in bench.of("PARAM_VALUE")] == ["FS_GCS_TIMEOUT"] * 2
    bench.set_parameter("WP_SPEED", 1.5)
    bench.run(0.05)
    assert [m.param_value for m in bench.of("PARAM_VALUE", port=1)] == [1.5], "all ports are told of a change"


def test_parameters_that_it_lacks_are_not_answered() -> None:
    bench = Bench(boot="warm")
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1))
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", 999))
    bench.set_parameter("NO_SUCH", 1.0)
    bench.run(0.5)
    assert bench.of("PARAM_VALUE") == []


def test_a_value_that_cannot_be_is_answered_with_the_one_that_is() -> None:
    bench = Bench(boot="warm")
    for value in (nan, 0.0):
        bench.set_parameter("SCHED_LOOP_RATE", value)
    bench.run(0.1)
    assert [m.param_value for m in bench.of("PARAM_VALUE")] == [50.0, 50.0]


def test_the_list_of_parameters_is_whole_and_slows_the_streams() -> None:
    bench = Bench(boot="warm")
    assert bench.interval(constants.MESSAGE_ATTITUDE, 25.0) == ACCEPTED
    bench.run(0.2)
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1))
    since = bench.time
    bench.until(
        lambda: (
            len(bench.of("PARAM_VALUE")) == bench.of("PARAM_VALUE")[0].param_count
            if bench.of("PARAM_VALUE")
            else False
        )
    )
    took = bench.time - since
    assert len({m.param_index for m in bench.of("PARAM_VALUE")}) == bench.last("PARAM_VALUE").param_count
    assert len(bench.of("ATTITUDE", since)) <= 2 + took / 0.16


# Signing

KEY = bytes(range(32))


def sign(bench: Bench, key: bytes, *, port: int, system: int = 255) -> None:
    codec = bench.sender(system, 190, port)
    codec.signing.secret_key = key
    codec.signing.sign_outgoing = True
    codec.signing.link_id = port + 10
    codec.signing.timestamp = (bench.now_ns - 1_420_070_400 * NS_PER_S) // 10_000


def test_with_a_key_only_the_first_port_takes_what_is_not_signed() -> None:
    bench = Bench(boot="warm", ports=2)
    bench.run(0.1)
    key = list(KEY)
    bench.send(mavlink.MAVLink_setup_signing_message(1, 1, key, 1))
    bench.run(0.1)
    since = bench.time
    ask = mavlink.MAVLink_param_request_read_message(1, 1, b"WP_SPEED", -1)
    bench.send(ask, port=0)
    bench.send(ask, port=1)
    bench.run(0.1)
    assert {p for t, p, m in bench.heard if m.get_type() == "PARAM_VALUE" and t > since} == {0}
    sign(bench, bytes(32)[:-1] + b"x", port=1, system=254)
    bench.send(ask, port=1, system=254)
    bench.run(0.1)
    assert bench.of("PARAM_VALUE", since, port=1) == []
    sign(bench, KEY, port=1)
    bench.send(ask, port=1)
    bench.run(0.1)
    assert len(bench.of("PARAM_VALUE", since, port=1)) == 1
    signed = [m for t, p, m in bench.heard if t > since + 0.05]
    assert signed
    assert all(m.get_header().incompat_flags & mavlink.MAVLINK_IFLAG_SIGNED for m in signed)


def test_its_signatures_are_right() -> None:
    bench = Bench(boot="warm", signing_key=KEY)
    reader = bench.readers[0]
    reader.signing.secret_key = KEY
    reader.signing.timestamp = (START_NS - 1_420_070_400 * NS_PER_S) // 10_000
    bench.run(5.0)
    assert len(bench.of("ATTITUDE")) >= 4
    assert bench.of("BAD_DATA") == []


def test_an_armed_rover_takes_no_key() -> None:
    bench = ready(ports=2)
    bench.send(mavlink.MAVLink_setup_signing_message(1, 1, list(KEY), 1))
    bench.run(0.1)
    since = bench.time
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"WP_SPEED", -1), port=1)
    bench.run(0.1)
    assert len(bench.of("PARAM_VALUE", since, port=1)) == 1


def test_the_key_outlives_a_reboot() -> None:
    bench = Bench(boot="warm", ports=2, boot_s=4.0)
    bench.send(mavlink.MAVLink_setup_signing_message(1, 1, list(KEY), 1))
    bench.run(0.1)
    bench.rover.reboot()
    bench.run(2.0)
    since = bench.time
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"WP_SPEED", -1), port=1)
    bench.run(0.1)
    assert bench.of("PARAM_VALUE", since) == []


# Others on its ports


def test_what_is_for_another_vehicle_or_a_companion_is_not_taken() -> None:
    bench = ready()
    for system, component in ((2, 1), (1, 191)):
        bench.send(mavlink.MAVLink_command_long_message(system, component, 400, 0, 0, 0, 0, 0, 0, 0, 0))
    bench.run(0.1)
    assert bench.rover.armed
    assert bench.of("COMMAND_ACK") == []


def test_nothing_is_said_where_nobody_is() -> None:
    bench = Bench(boot="warm", ports=2)
    bench.rover.set_open(1, False)
    bench.run(3.0, bench.heartbeat)
    assert {p for _, p, _ in bench.heard} == {0}


# Settings


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"system": 0}, "system id"),
        ({"system": 255}, "system id"),
        ({"boot_s": 0.0}, "time to boot"),
        ({"signing_key": b"short"}, "32 bytes"),
        ({"ports": 0}, "port"),
        ({"parameters": {"NO_SUCH": 1.0}}, "NO_SUCH"),
        ({"parameters": {"WP_SPEED": nan}}, "WP_SPEED"),
        ({"parameters": {"SCHED_LOOP_RATE": 5.0}}, "SCHED_LOOP_RATE"),
    ],
)
def test_settings_that_no_rover_can_have(settings: dict[str, object], named: str) -> None:
    with pytest.raises(SettingsError, match=named):
        Settings(**settings)  # type: ignore[arg-type]


def test_texts_of_settings() -> None:
    assert parse_home("-35.5,149,584,90") == (Geodetic(-35.5, 149.0, 584.0), pytest.approx(0.5 * pi))
    assert parse_parameter("WP_SPEED=1.5") == ("WP_SPEED", 1.5)
    for bad in ("1,2,3", "a,b,c,d", "91,0,0,0", "0,0,0,nan"):
        with pytest.raises(SettingsError, match=bad):
            parse_home(bad)
    for bad in ("WP_SPEED", "WP_SPEED=x", "NO_SUCH=1"):
        with pytest.raises(SettingsError):
            parse_parameter(bad)


def test_a_mode_that_there_is_not() -> None:
    with pytest.raises(SettingsError, match="LAND"):
        Bench(boot="warm").rover.set_mode("LAND")


def test_the_mask_of_what_a_bridge_sends_is_that_of_its_bits() -> None:
    ignored = (
        constants.IGNORE_POSITION
        | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
        | constants.IGNORE_ACCELERATION
        | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
        | constants.IGNORE_YAW
    )
    assert ignored == constants.MASK_SPEED_AND_YAW_RATE == 1479
