"""What comes in on a serial line, told apart: MAVLink 1 and 2, another speed, consoles, GPS."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport.port_diagnosis import LineContents, first_message
from tests.rover_serial import misread

BAUD = 57_600
BEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GROUND_ROVER, 3, 81, 4, 4, 3)
RADIO = mavlink.MAVLink_radio_status_message(100, 100, 90, 20, 20, 0, 0)


def packed(message: Any, version: int = 2, key: bytes | None = None) -> bytes:
    codec = mavlink.MAVLink(None, 1, 1)
    if key is not None:
        codec.signing.secret_key, codec.signing.sign_outgoing = key, True
    data: bytes = message.pack(codec, force_mavlink1=version == 1)
    return data


class Line:
    """A line at which something comes ten times a second."""

    def __init__(self, now_s: float = 100.0) -> None:
        self.contents = LineContents(BAUD)
        self.now_ns = round(now_s * NS_PER_S)

    def hear(self, data: bytes, seconds: float, period_s: float = 0.1) -> str:
        for _ in range(round(seconds / period_s)):
            self.now_ns += round(period_s * NS_PER_S)
            self.contents.take(self.now_ns, data)
        return self.contents.trouble


@pytest.mark.parametrize("version", [1, 2])
def test_a_message_is_known_by_its_checksum(version: int) -> None:
    data = packed(BEAT, version)
    assert first_message(b"\xfd\xfe\xfd" + data) == (version, 0)
    assert first_message(data[:-1]) is None
    assert first_message(data[:-1] + bytes([data[-1] ^ 1])) is None
    assert first_message(b"") is None


def test_a_signed_message_is_one() -> None:
    assert first_message(packed(BEAT, key=bytes(range(32)))) == (2, 0)


def test_mavlink_in_pieces_is_no_trouble() -> None:
    line = Line()
    data = packed(BEAT)
    for _ in range(20):
        for k in range(0, len(data), 5):
            assert line.hear(data[k : k + 5], 0.1) == ""
    assert line.contents.note == ""


@pytest.mark.parametrize("read", [9_600, 38_400, 115_200, 921_600])
def test_another_speed_is_told_after_three_seconds_and_ends(read: int) -> None:
    line = Line()
    garbage = misread(packed(BEAT) * 4, BAUD, read)
    assert line.hear(garbage, 2.9) == ""
    assert line.hear(garbage, 0.3).startswith(
        f"bytes come at {BAUD} baud, but no MAVLink: another speed?; to"
    )
    assert "SERIALx_BAUD" in line.contents.trouble
    assert "57600, 115200 and 921600 are usual" in line.contents.trouble
    assert line.hear(packed(BEAT), 0.1) == ""


def test_a_speed_that_changes_in_mid_drive_is_told() -> None:
    line = Line()
    line.hear(packed(BEAT), 30.0)
    assert line.hear(misread(packed(BEAT), 115_200, BAUD), 4.3) != ""


def test_noise_now_and_then_and_silence_say_nothing() -> None:
    line = Line()
    assert line.hear(b"\x00", 60.0, period_s=2.5) == ""
    assert line.hear(b"\x13" * 40, 4.0) != ""
    line.contents.look(line.now_ns + 3 * NS_PER_S)
    assert line.contents.trouble == "", "nothing comes any more: the vehicle is off"


def test_mavlink_1_is_told_but_no_trouble() -> None:
    line = Line()
    assert line.hear(packed(BEAT, 1), 2.0) == ""
    assert line.contents.note == "", "an autopilot begins so, and changes when it hears version 2"
    line.hear(packed(BEAT, 1), 3.0)
    assert line.contents.note.startswith("it speaks MAVLink 1; to do: SERIALx_PROTOCOL = 2")
    line.hear(packed(BEAT), 2.0)
    assert line.contents.note == ""


def test_a_radio_whose_vehicle_is_off_is_neither() -> None:
    line = Line()
    assert line.hear(packed(RADIO, 1), 10.0) == ""
    assert line.contents.note == ""


def test_a_console_is_told_by_its_prompt() -> None:
    line = Line()
    found = line.hear(b"\r\nraspberrypi login: ", 4.0)
    assert found.startswith("a Linux console is on it: it says 'raspberrypi login:'; to do: ")
    assert "raspi-config" in found


def test_other_text_is_told_with_what_it_says() -> None:
    assert Line().hear(b"$GPGGA,123519,4807.038,N\r\n", 4.0).startswith("a GPS is on it: it says '$GPGGA,12")
    said = Line().hear(b"Init ArduRover V4.7.0\r\n", 4.0)
    assert said.startswith("text comes, no MAVLink: 'Init ArduRover V4.7.0'; to do: SERIALx_PROTOCOL = 2")
