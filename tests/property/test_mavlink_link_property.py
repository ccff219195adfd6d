"""Whatever comes down a link: nothing raises, nothing non-finite gets in, nothing grows."""

from __future__ import annotations

import struct
from math import inf, isfinite, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.session import Session, SessionSettings

T0 = 1_700_000_000 * NS_PER_S
READ = (
    dialect.MAVLink_heartbeat_message,
    dialect.MAVLink_attitude_message,
    dialect.MAVLink_local_position_ned_message,
    dialect.MAVLink_timesync_message,
    dialect.MAVLink_ekf_status_report_message,
    dialect.MAVLink_gps_raw_int_message,
    dialect.MAVLink_sys_status_message,
    dialect.MAVLink_gps_global_origin_message,
    dialect.MAVLink_statustext_message,
    dialect.MAVLink_command_ack_message,
    dialect.MAVLink_param_value_message,
    dialect.MAVLink_param_error_message,
    dialect.MAVLink_autopilot_version_message,
)


def joined() -> Session:
    link = Session(SessionSettings(datum=Geodetic(47.0, 8.0), parameters=("FS_ACTION",)))
    link.receive(T0, framed(dialect.MAVLink_heartbeat_message, struct.pack("<IBBBBB", 15, 10, 3, 129, 4, 3)))
    assert link.system == 3
    return link


def framed(kind: type, payload: bytes, system: int = 3, component: int = 1) -> bytes:
    """A message of a kind with any payload, its checksum right."""
    header = struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, system, component, kind.id, 0)
    crc = dialect.x25crc(header + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + header + payload + struct.pack("<H", crc)


def looked_at(link: Session, now_ns: int) -> None:
    """All that a bridge does with a session."""
    link.tick(now_ns)
    for position in link.take_positions():
        assert all(map(isfinite, position))
    for attitude in link.take_attitudes():
        assert all(map(isfinite, attitude))
    for text in link.take_texts():
        assert text.text.isprintable()
    assert all(value is None or isfinite(value) for value in link.parameters.values())
    assert link.origin is None or all(map(isfinite, link.origin))
    if link.ekf is not None:
        assert not any(value != value for value in link.ekf)  # inf is bad, NaN would pass as good
    link.streams(now_ns)
    link.absence(now_ns)
    link.another_bridge(now_ns)
    assert len(link._codec.buf) <= 2 * 4096


@given(st.lists(st.binary(max_size=600), max_size=8))
def test_any_bytes(chunks: list[bytes]) -> None:
    link = joined()
    for index, chunk in enumerate(chunks):
        link.receive(T0 + index, chunk)
        looked_at(link, T0 + index)
    link.receive(T0 + 9, bytes(600))  # ends whatever was begun
    alive = framed(dialect.MAVLink_heartbeat_message, struct.pack("<IBBBBB", 4, 10, 3, 1, 4, 3))
    link.receive(T0 + 10, alive)
    assert (link.mode, link.armed) == (4, False) or link.system != 3


@given(
    st.sampled_from(READ),
    st.binary(min_size=1, max_size=255),
    st.sampled_from([(3, 1), (3, 191), (4, 1), (255, 190), (0, 0)]),
)
def test_any_payload_of_a_message_that_is_read(kind: type, payload: bytes, sender: tuple[int, int]) -> None:
    link = joined()
    link.receive(T0 + 1, framed(kind, payload, *sender))
    looked_at(link, T0 + 2)
    link.receive(T0 + 3, framed(kind, payload, *sender))
    looked_at(link, T0 + 4 * NS_PER_S)


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize("wrong", [nan, inf, -inf])
def test_numbers_that_are_not_finite_in_every_field(kind: type, wrong: float) -> None:
    link = joined()
    size = kind.unpacker.size
    for offset in range(0, size - 3, 4):
        payload = bytearray(size)
        payload[offset : offset + 4] = struct.pack("<f", wrong)
        link.receive(T0 + offset, framed(kind, bytes(payload)))
        looked_at(link, T0 + offset)


@given(st.integers(0, 2**31), st.lists(st.integers(0, 400), max_size=20))
def test_any_flipped_bits_in_real_traffic(seed: int, places: list[int]) -> None:
    link = joined()
    traffic = bytearray()
    for kind in READ:
        size = kind.unpacker.size
        traffic += framed(kind, bytes((seed >> (i % 24)) & 0xFF for i in range(size)))
    for place in places:
        traffic[place % len(traffic)] ^= 1 << (place % 8)
    for start in range(0, len(traffic), 17):  # as a serial port gives it
        link.receive(T0 + start, bytes(traffic[start : start + 17]))
        looked_at(link, T0 + start)
