"""Connection strings: what pymavlink takes is taken, anything else is said clearly."""

from __future__ import annotations

import re

import pytest

from handfast.bridges.mavlink.transport.connection_string import Connection, parse_connection


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udpin:0.0.0.0:14550", Connection("udpin", "0.0.0.0", 14550)),
        ("udp:127.0.0.1:14550", Connection("udpin", "127.0.0.1", 14550)),
        ("udpout:10.0.0.7:14550", Connection("udpout", "10.0.0.7", 14550)),
        ("tcp:rover-3.local:5760", Connection("tcp", "rover-3.local", 5760)),
        ("tcp:[::1]:5760", Connection("tcp", "::1", 5760)),
        ("/dev/ttyACM0", Connection("serial", device="/dev/ttyACM0")),
    ],
)
def test_what_pymavlink_takes(text: str, expected: Connection) -> None:
    assert parse_connection(text) == expected
    assert parse_connection(expected.text) == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not a connection"),
        ("simulator", "is not a connection"),
        ("/dev/ttyACM0\0", "is not a connection"),
        ("tcp:rover\0:5760", "is not a connection"),
        ("serial:/dev/ttyACM0", "is not a connection"),
        ("tcpin:0.0.0.0:5760", "tcpin connections are not supported"),
        ("tcp:127.0.0.1", "names no host and port"),
        ("tcp::5760", "names no host and port"),
        ("tcp:a host:5760", "names no host and port"),
        ("tcp:::1:5760", "in brackets"),
        ("udpin:0.0.0.0:0", "from 1 to 65535, not '0'"),
        ("udpin:0.0.0.0:65536", "from 1 to 65535"),
        ("udpin:0.0.0.0:+14550", "from 1 to 65535"),
        ("udpin:0.0.0.0:١٤", "from 1 to 65535"),
    ],
)
def test_anything_else(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        parse_connection(text)


def test_a_device_by_id_keeps_its_name() -> None:
    assert parse_connection("/dev/serial/by-id/usb-ArduPilot_Pixhawk-if00").by_id
    assert not parse_connection("/dev/ttyUSB0").by_id
    assert not parse_connection("/dev/ttyACM1").by_id
    assert parse_connection("/dev/serial0").by_id, "a computer's own UART has no better name"
    assert parse_connection("tcp:127.0.0.1:5760").by_id
