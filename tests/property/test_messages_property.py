"""The codec against anything: valid messages come back, and nothing else gets through or breaks it."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from math import inf, isfinite, nan
from typing import Any
from unittest.mock import patch

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.messages import validation
from handfast.agent.messages.codec import VERSION, decode, encode, newer
from handfast.agent.messages.fast_path import HEAD, taker
from handfast.agent.messages.types import (
    BYTES_MAX,
    CLASSES,
    FLOAT_MAX,
    LEVELS,
    Checks,
    HandState,
    LinkTrace,
    Message,
    Mission,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.messages.validation import REASONS, Malformed, examined
from tests.declared_messages import messages_of
from tests.wire import opened, sealed

HANDS, STATUSES, TRACES, RESUMES, CHECKS, MISSIONS, STOPS, WRENCHES = map(
    messages_of, (HandState, Status, LinkTrace, Resume, Checks, Mission, Stop, Wrench)
)
MESSAGES = st.one_of(*map(messages_of, CLASSES))


def floats_of(value: Any) -> list[float]:
    if isinstance(value, float):
        return [value]
    return [number for part in value for number in floats_of(part)] if isinstance(value, tuple) else []


def survives(payload: bytes) -> Message | None:
    """Decodes; whatever comes of it must be a refusal by a known reason or a valid message."""
    message: Message | None = None
    refused: Malformed | None = None
    gc.disable()  # the garbage of Hypothesis is not part of it: collecting that has taken a second
    start = time.thread_time()
    try:
        message = decode(payload)
    except Malformed as error:
        refused = error
    finally:
        took_s = time.thread_time() - start
        gc.enable()
    assert took_s < 1.0
    if refused is not None:
        assert refused.reason in REASONS
        assert len(str(refused)) < 300
        return None
    assert isinstance(message, Message)
    assert all(isfinite(value) and abs(value) <= FLOAT_MAX for value in floats_of(message))
    if isinstance(message, HandState):
        assert all((type(robot), type(value)) == (int, float) for robot, value in message.multipliers)
        assert all((type(robot), type(delay)) == (int, int) for robot, delay in message.heard)
    elif isinstance(message, Status):
        assert all(type(value) is int for value in (*message.tick_us, *message.ages_us))
        assert all(tuple(map(type, entry)) == (int,) * 6 for entry in message.neighbours)
        assert all((type(name), type(count)) == (str, int) for name, count in message.counters)
    elif isinstance(message, LinkTrace):
        assert all(tuple(map(type, entry)) == (int,) * 6 for entry in message.entries)
    elif isinstance(message, Resume):
        assert all(type(robot) is int and 0 < robot <= 9999 for robot in message.robots)
    elif isinstance(message, Checks):
        assert all(tuple(map(type, line)) == (str,) * 4 and line[1] in LEVELS for line in message.lines)
    assert decode(encode(message)) == message
    hash(message)
    return message


@given(MESSAGES)
@settings(max_examples=300)
def test_round_trip(message: Message):
    payload = encode(message)
    if len(payload) > BYTES_MAX:
        with pytest.raises(Malformed, match="oversized"):
            decode(payload)
        return
    assert decode(payload) == message
    assert type(decode(payload)) is type(message)


@given(MISSIONS | STOPS | RESUMES)
def test_an_order_that_is_said_again_has_the_bytes_that_came(message: Message):
    """Whoever vouches for an order vouches for its bytes, and robots pass it on."""
    payload = encode(message)
    if len(payload) <= BYTES_MAX:
        assert encode(decode(payload)) == payload


@pytest.mark.slow
@given(
    st.lists(MISSIONS.map(lambda mission: mission._replace(version=mission.version % 3)), max_size=8),
    st.data(),
)
def test_the_mission_that_holds_does_not_depend_on_the_order_in_which_they_come(
    missions: list[Mission], data: st.DataObject
):
    def last(order: list[Mission]) -> Mission | None:
        known: Mission | None = None
        for mission in order:
            if newer(mission, known):
                known = mission._replace(time_ns=0)  # when it was said is no part of it
        return known

    assert last(missions) == last(data.draw(st.permutations(missions * 2), label="order"))


@given(st.binary(max_size=200), st.integers(0, 15), st.integers(2, 15))
@settings(max_examples=300)
def test_random_bytes_after_a_good_head(payload: bytes, number: int, fields: int):
    survives(sealed(bytes([0x90 | fields, VERSION, number]) + payload))


def flipped(payload: bytes, bits: set[int]) -> bytes:
    changed = bytearray(payload)
    for bit in bits:
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.mark.slow
@given(MESSAGES, st.data())
@settings(max_examples=1000)
def test_one_two_or_three_flipped_bits_are_always_found(message: Message, data: st.DataObject):
    payload = encode(message)
    bits = st.sets(st.integers(0, 8 * len(payload) - 1), min_size=1, max_size=3)
    with pytest.raises(Malformed) as caught:
        decode(flipped(payload, data.draw(bits, label="bits")))
    # Three bits may make the checksum one more field and the version another: then it is named as that.
    assert caught.value.reason in ("checksum", "version", "oversized")


@given(MESSAGES, st.data())
@settings(max_examples=300)
def test_truncated_lengthened_and_spliced(message: Message, data: st.DataObject):
    payload = encode(message)
    cut = data.draw(st.integers(0, len(payload) - 1), label="cut")
    assert survives(payload[:cut]) is None
    assert survives(payload + b"\x00") is None
    put_in = data.draw(st.binary(max_size=16), label="put in")
    other = encode(data.draw(MESSAGES, label="other"))
    survives(payload[:cut] + put_in + payload[cut:])
    survives(payload[:cut] + other[min(cut, len(other)) :])
    packed, others = payload[:-5], other[:-5]
    if cut < len(packed):
        assert survives(sealed(packed[:cut])) is None
    assert survives(sealed(packed + b"\x00")) is None
    survives(sealed(packed[:cut] + put_in + packed[cut:]))
    survives(sealed(packed[:cut] + others[min(cut, len(others)) :]))


# What MessagePack can hold at all, and what a field must never be.
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from([0, -1, 2**53 + 1, 2**62, 2**63 - 1, 2**64 - 1, -(2**63)]),
    st.floats(),
    st.sampled_from([nan, inf, -inf, 1.7976931348623157e308]),
    st.text(max_size=300),
    st.binary(max_size=20),
    st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20)),
    st.builds(msgpack.Timestamp, st.integers(0, 2**40), st.integers(0, 999_999_999)),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=20,
)


HASHABLE = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=5).map(tuple), max_leaves=20)


@given(VALUES)
@settings(max_examples=300)
def test_any_messagepack(value: Any):
    survives(msgpack.packb(value))
    survives(sealed(msgpack.packb(value)))


@pytest.mark.slow
@given(MESSAGES, st.data())
@settings(max_examples=500)
def test_a_field_replaced_by_anything(message: Message, data: st.DataObject):
    fields = list(msgpack.unpackb(opened(encode(message)), use_list=True))
    place = data.draw(st.integers(0, len(fields) - 1), label="place")
    fields[place] = data.draw(VALUES, label="value")
    survives(sealed(msgpack.packb(fields)))


def outcome(way: Callable[[], Message]) -> Any:
    """What it makes, or why it refuses to."""
    try:
        return way()
    except Malformed as error:
        return error.reason


@pytest.mark.slow
@given(MESSAGES, st.data())
@settings(max_examples=500)
def test_the_short_way_lets_through_what_the_long_way_does_and_nothing_else(
    message: Message, data: st.DataObject
):
    cls = type(message)
    array = list(msgpack.unpackb(opened(encode(message)), use_list=False, strict_map_key=False))
    place = data.draw(st.integers(HEAD, len(array) - 1), label="place")
    array[place] = data.draw(HASHABLE | st.just(array[place]), label="value")

    short = outcome(lambda: taker(cls)(tuple(array), examined))
    with patch.object(validation, "rows_of_numbers", lambda _: None):
        long = outcome(lambda: examined(cls, tuple(array[HEAD:])))
    assert short == long
    assert type(short) is type(long)


@given(MESSAGES, st.data())
@settings(max_examples=200)
def test_fields_repeated_left_out_or_swapped(message: Message, data: st.DataObject):
    fields = list(msgpack.unpackb(opened(encode(message))))
    order = data.draw(st.lists(st.sampled_from(range(len(fields))), max_size=2 * len(fields)), label="order")
    survives(sealed(msgpack.packb([fields[k] for k in order])))


@given(HANDS, st.integers(0, 74), st.sampled_from([nan, inf, -inf]))
def test_a_number_that_is_not_finite_never_gets_through(message: HandState, place: int, value: float):
    place %= 11 + len(message.multipliers)
    if place < 11:
        message = message._replace(**{HandState._fields[5 + place]: value})
    else:
        multipliers = list(message.multipliers)
        multipliers[place - 11] = (multipliers[place - 11][0], value)
        message = message._replace(multipliers=tuple(multipliers))
    with pytest.raises(Malformed, match="not_finite"):
        decode(encode(message))
