"""What is read the short way is what pymavlink reads, to the bit, and anything else is left to it."""

from __future__ import annotations

from math import isnan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.bridges.mavlink.session.codec import Codec, WholeFrames
from handfast.bridges.mavlink.session.identity import SessionSettings
from handfast.bridges.mavlink.session.receiver import Receiver

WANTED = tuple(Receiver(SessionSettings())._handlers)
UNWANTED = dialect.MAVLINK_MSG_ID_VFR_HUD
PLAIN = [number for number in WANTED if not any(dialect.mavlink_map[number].array_lengths)]

RANGES = {"b": (-(2**7), 2**7 - 1), "B": (0, 2**8 - 1), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1)}
RANGES |= {"i": (-(2**31), 2**31 - 1), "I": (0, 2**32 - 1), "q": (-(2**63), 2**63 - 1), "Q": (0, 2**64 - 1)}


def of(code: str) -> st.SearchStrategy[Any]:
    if code == "f":
        return st.floats(width=32)
    low, high = RANGES[code]
    return st.just(0) | st.integers(low, high)


@st.composite
def frames(draw: st.DrawFn) -> bytes:
    """One frame of any type, of either version."""
    number = draw(st.sampled_from([*WANTED, UNWANTED]))
    found = dialect.mavlink_map[number]
    values = []
    for name in found.fieldnames:
        at = found.ordered_fieldnames.index(name)
        kind, length = found.fieldtypes[found.fieldnames.index(name)], found.array_lengths[at]
        if kind == "char":
            values.append(draw(st.binary(max_size=length)))
            continue
        code = {"float": "f", "uint64_t": "Q", "int64_t": "q", "uint32_t": "I", "int32_t": "i"}.get(
            kind, {"uint16_t": "H", "int16_t": "h", "uint8_t": "B", "int8_t": "b"}.get(kind, "B")
        )
        one = of(code)
        values.append([draw(one) for _ in range(length)] if length else draw(one))
    sender = dialect.MAVLink(None, draw(st.integers(0, 255)), draw(st.integers(0, 255)))
    sender.seq = draw(st.integers(0, 255))
    packed = found(*values).pack(sender, force_mavlink1=number < 256 and draw(st.integers(0, 9)) == 0)
    return bytes(packed)


def fields(message: Any) -> tuple[Any, ...]:
    header = message.get_header()
    values = [getattr(message, name) for name in dialect.mavlink_map[message.get_msgId()].fieldnames]
    texts = [str(value) if isinstance(value, float) and isnan(value) else value for value in values]
    return message.get_msgId(), header.srcSystem, header.srcComponent, header.incompat_flags, *texts


def seen(codec: Codec, pieces: list[bytes]) -> list[Any]:
    found = []
    for piece in pieces:
        for message in codec.parse(piece):
            if message.get_msgId() in WANTED:
                found.append(fields(message))
            elif message.get_msgId() == dialect.MAVLINK_MSG_ID_BAD_DATA:
                found.append("bad")
    return found


class Slow(WholeFrames):
    def take(self, data: bytes) -> tuple[list[Any], int]:
        return [], 0


@given(
    st.lists(st.one_of(frames(), st.binary(max_size=12)), max_size=6),
    st.lists(st.integers(0, 400), max_size=4),
    st.lists(st.tuples(st.integers(0, 400), st.integers(1, 255)), max_size=2),
)
def test_all_that_comes_is_read_as_pymavlink_reads_it(
    parts: list[bytes], cuts: list[int], errors: list[tuple[int, int]]
) -> None:
    """However it is cut into pieces, and whatever happened to it on the way."""
    stream = bytearray(b"".join(parts))
    for at, flipped in errors:
        if at < len(stream):
            stream[at] ^= flipped
    ends = sorted({min(cut, len(stream)) for cut in cuts} | {len(stream)})
    pieces = [bytes(stream[start:end]) for start, end in zip([0, *ends[:-1]], ends, strict=True)]
    quick, slow = Codec(WANTED, None), Codec(WANTED, None)
    slow._whole = Slow(WANTED)
    assert seen(quick, pieces) == seen(slow, pieces)


@pytest.mark.parametrize("number", PLAIN)
def test_the_short_way_is_taken_for_whole_frames(number: int) -> None:
    found = dialect.mavlink_map[number]
    message = found(*[1] * len(found.fieldnames))
    packed = bytes(message.pack(dialect.MAVLink(None, 7, 1)))
    messages, taken = WholeFrames(WANTED).take(packed * 3)
    assert taken == 3 * len(packed)
    assert [each.get_header()[:3] for each in messages] == [(number, 7, 1)] * 3


def test_what_is_not_wanted_is_skipped_and_what_is_cut_off_is_left() -> None:
    sender = dialect.MAVLink(None, 7, 1)
    other = bytes(dialect.MAVLink_vfr_hud_message(1.0, 1.0, 1, 1, 1.0, 1.0).pack(sender))
    beat = bytes(dialect.MAVLink_heartbeat_message(10, 3, 1, 4, 3, 3).pack(sender))
    messages, taken = WholeFrames(WANTED).take(other + beat + beat[:-1])
    assert [each.get_msgId() for each in messages] == [0]
    assert taken == len(other) + len(beat)


@pytest.mark.parametrize("number", [dialect.MAVLINK_MSG_ID_HEARTBEAT, UNWANTED])
def test_a_signed_frame_is_left_to_pymavlink(number: int) -> None:
    sender = dialect.MAVLink(None, 7, 1)
    sender.signing.secret_key, sender.signing.sign_outgoing = bytes(32), True
    found = dialect.mavlink_map[number]
    packed = bytes(found(*[1] * len(found.fieldnames)).pack(sender))
    assert WholeFrames(WANTED).take(packed) == ([], 0)
