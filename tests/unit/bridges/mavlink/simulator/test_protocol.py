"""Parameters, signing and others on the ports of the simulated rover; its settings."""

from __future__ import annotations

from math import nan

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.settings import Settings, SettingsError
from tests.unit.bridges.mavlink.rover_bench import START_NS, Bench, ready

# Parameters


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


# Others on its ports


def test_what_is_for_another_vehicle_or_a_companion_is_not_taken() -> None:
    bench = ready()
    for system, component in ((2, 1), (1, 191)):
        bench.send(mavlink.MAVLink_command_long_message(system, component, 400, 0, 0, 0, 0, 0, 0, 0, 0))
    bench.run(0.1)
    assert bench.rover.armed
    assert bench.of("COMMAND_ACK") == []


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


def test_the_mask_of_what_a_bridge_sends_is_that_of_its_bits() -> None:
    ignored = (
        constants.IGNORE_POSITION
        | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
        | constants.IGNORE_ACCELERATION
        | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
        | constants.IGNORE_YAW
    )
    assert ignored == constants.MASK_SPEED_AND_YAW_RATE == 1479
