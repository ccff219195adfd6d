"""The codec: what is sent comes back, and what is not exactly a message is refused by its reason."""

from __future__ import annotations

import time
import tracemalloc
from math import inf, nan

import msgpack
import pytest

from handfast.agent.messages import codec
from handfast.agent.messages.codec import VERSION, decode, encode, newer
from handfast.agent.messages.types import (
    AUTHOR_MAX,
    BYTES_MAX,
    CHECK_TEXT_MIN,
    CHECKS_MAX,
    DEGREE_MAX,
    EVENTS,
    EVERY_AUTHOR,
    FLOAT_MAX,
    LEVELS,
    NEIGHBOURS_MAX,
    OWN_MAX,
    ROBOT_MAX,
    SILENT_MAX,
    TEXT_MAX,
    TIME_NS_MAX,
    TOPICS,
    TRACE_MAX,
    WHAT_MAX,
    Ask,
    Beacon,
    Checks,
    Event,
    Faults,
    HandState,
    Heartbeat,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    StatusText,
    Stop,
    Wrench,
    clipped,
)
from handfast.agent.messages.validation import REASONS, Malformed
from tests.wire import opened, sealed

HAND = HandState(
    3, 7, 10**18, True, 5, 1.5, -2.0, 0.25, 0.0, 0.1, 0.2, -0.3, 0.4, 0.5, -0.6, 0.25,
    ((1, 0.5), (2, -1.25), (9999, 0.0)), ((1, 20_000), (2, -150)),
)  # fmt: skip
V = bytes([VERSION])
PLANT = PlantState(3, 8, 10**18, 1.0, 2.0, -0.5, 0.3, 0.01, 12.0, -0.5, True, True, False, "mode MANUAL")
WRENCH = Wrench(3, 9, 10**18, 4.5, -0.125, False)
MISSION = Mission(
    2, 10**18, 10**18 + 5, 30 * 10**9, "0123456789abcdef",
    from_ns=10**18 + 7, blend_ns=2 * 10**9, note="robot 3 has joined", trajectory_ns=10**18 + 6,
    trajectory=(("kind", "waypoints"), ("waypoints_m", ((0.0, 1.0), (2.5, -1))), ("loop", True)),
    robots=((1, 0.0, -1.5), (3, 2.0, 0.25)), edges=((1, 3, 2.5),), removed=((6, 10**18 - 9),),
)  # fmt: skip
STOP = Stop(2, 10**18, "by the operator")
STATUS = Status(
    3,
    10,
    10**18,
    "running",
    "epoch",
    "",
    2,
    6,
    ((1, 20_000, 500, 3, -80, 12), (2, -1, 0, 0, 0, -1)),
    (150, 160),
    (20_000, 40_000),
    (("sent", 5), ("rejected.future", 1)),
)
FAULTS = Faults(4, 10**18, "bench (Ada)", 10**18 - 5, 3 * 10**9, '[[rule]]\nlink = "1->2"\nloss = "30%"\n')
ENTRY = (2, 0, 2**20 + 7, 10**18, 16, 80_000)
TRACE = LinkTrace(3, 11, 10**18, (ENTRY, (3, 1, 9, 10**18, 33, -1), (3, 2, 9, 10**18, 0, 0)))
EVENT = Event(3, 12, 10**18, "plant", EVENTS[2], "pause at noon")
RESUME = Resume(5, 10**18, (3, 9999, 1))
LINE = ("gps", "warning", "fix 3D, 7 satellites", "wait for more")
SILENT = (
    (4, 10**18 - 5, True, 1.5, -2.5, 0.0, 0.25, 2.5, -2.5, 0.5),
    (5, 10**17, False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
)
BEACON = Beacon(3, 14, 10**18, True, 1.5, -2.0, 0.25, -0.125, 0.5, 2, 7, 6, -1, SILENT, (4, 5, 9999))
HEARTBEAT = Heartbeat(10**18, "Ada@bench")
ASK = Ask(10**18, "Ada@bench")
TEXT = StatusText(3, 15, 10**18, "critical", "EKF failsafe")
CHECKS = Checks(3, 13, 10**18, (LINE, ("mode", "blocking", "MANUAL", "set GUIDED"), ("link", "ok", "", "")))
MESSAGES = [
    HAND, PLANT, WRENCH, MISSION, STOP, STATUS, FAULTS, TRACE, EVENT, RESUME, CHECKS, BEACON, HEARTBEAT, ASK,
    TEXT,
]  # fmt: skip
LEFT_OUT = {HandState: 5, PlantState: 1, Wrench: 2, Status: 1, Beacon: 5}
NUMBER = {type(message): number for number, message in enumerate(MESSAGES)}


def packed(*parts: object) -> bytes:
    """A payload of these parts, its checksum right."""
    return sealed(msgpack.packb(parts))


def changed(message: Message, **fields: object) -> bytes:
    """The message's bytes with other values, whatever their types."""
    values = message._asdict() | fields
    return packed(VERSION, NUMBER[type(message)], *values.values())


def reason(payload: bytes) -> str:
    with pytest.raises(Malformed) as caught:
        decode(payload)
    assert caught.value.reason in REASONS
    assert str(caught.value).startswith(caught.value.reason + ": ")
    return caught.value.reason


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_round_trip(message: Message):
    again = decode(encode(message))
    assert again == message
    assert type(again) is type(message)
    assert encode(again) == encode(message)
    hash(again)  # tuples all the way down


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_wire_is_version_type_and_fields_in_order(message: Message):
    version, number, *fields = msgpack.unpackb(opened(encode(message)), use_list=False)
    assert version == VERSION
    assert number == NUMBER[type(message)]
    left_out = LEFT_OUT.get(type(message), 0)  # its last fields are empty
    assert tuple(fields) == tuple(message)[: len(message) - left_out]


def test_of_fields_that_may_be_left_out_those_go_before_one_that_is_not():
    for told in (
        HAND._replace(next_ms=400),
        HAND._replace(own=(1.5,)),
        HAND._replace(own=(1.5,), next_ms=60_000),
        HAND._replace(stood_ms=1500),
        BEACON._replace(stood_ms=60_000),
        HAND._replace(obeys=((0.5, -0.25, 1.5),)),
        BEACON._replace(rolling=((3, 0.5, 0.25, -1.0), (9999, 6.0, -0.5, 0.0))),
        HAND._replace(obeys=((0.5, -0.25, 1.5),), lost_ms=60_000),
        BEACON._replace(rolling=((3, 0.5, 0.25, -1.0),), lost=((3, 520), (9999, 60_000))),
        PLANT._replace(asked=((-0.25, 1.5),)),
    ):
        assert decode(encode(told)) == told
    sent = [len(encode(message)) for message in (HAND, HAND._replace(own=(1.5,)), HAND._replace(next_ms=1))]
    assert sent == [sent[0], sent[0] + 10, sent[0] + 2]
    assert reason(encode(HAND._replace(next_ms=60_001))) == "range"
    assert reason(encode(BEACON._replace(next_ms=-1))) == "range"


def test_numbers_of_a_law_s_own_are_sent_where_there_are_some():
    numbers = HAND._replace(own=(0.5, -2.0))
    assert decode(encode(numbers)) == numbers
    assert len(encode(numbers)) == len(encode(HAND)) + 1 + 2 * 9 + 0
    assert reason(changed(HAND, own=[0.5] * (OWN_MAX + 1))) == "range"
    assert reason(changed(HAND, own=[nan])) == "not_finite"
    assert reason(changed(HAND, own=["x"])) == "malformed"


def test_floats_keep_every_bit():
    values = (0.1, -0.0, 5e-324, FLOAT_MAX, 1 / 3, -1e-17, -FLOAT_MAX, 3.0)
    again = decode(encode(HAND._replace(**dict(zip(HAND._fields[5:13], values, strict=True)))))
    assert [x.hex() for x in again[5:13]] == [x.hex() for x in values]


# ---------------------------------------------------------------------- refused, and why


@pytest.mark.parametrize(
    "payload",
    [
        sealed(b""),
        sealed(b"\xc0"),
        sealed(b"\x01"),
        sealed(b"\x90"),
        packed(),
        packed(VERSION),
        packed(VERSION, 0),
        sealed(b"hello"),
        sealed(b"\xc1"),  # never used in MessagePack
        sealed(msgpack.packb({"version": 1})),
        sealed(msgpack.packb("text")),
        sealed(opened(encode(WRENCH))[:-1]),
        sealed(opened(encode(WRENCH)) + b"\x00"),
        sealed(encode(WRENCH)),  # the checksum twice
        sealed(opened(encode(WRENCH)) * 2),
        packed(VERSION, 2, 3, 9, 10**18, 4.5, -0.125, b"\x00"),
        packed(VERSION, 4, 2, 0, msgpack.ExtType(5, b"")),
        packed(VERSION, 4, 2, 0, msgpack.ExtType(5, b"x")),
        packed(VERSION, 4, 2, 0, msgpack.Timestamp(1, 2)),
        packed(VERSION, 4, 2, 0, {}),
        packed(VERSION, 4, 2, 0, {"a": 1}),
        packed(VERSION, 4, 2, 0, None),
        sealed(b"\x95" + V + b"\x04\x02\x00\xa2\xff\xfe"),  # text that is not UTF-8
        sealed(b"\x95" + V + b"\x04\x02\x00\xa3\xed\xa0\x80"),  # half of a surrogate pair
    ],
)
def test_malformed(payload: bytes):
    assert reason(payload) == "malformed"


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_any_one_flipped_bit_is_found_by_the_checksum(message: Message):
    payload = encode(message)
    for bit in range(8 * len(payload)):
        broken = bytearray(payload)
        broken[bit // 8] ^= 1 << bit % 8
        assert reason(bytes(broken)) == "checksum", bit


def test_a_program_of_version_6_is_named_as_such():
    """Its beacons did not say from whom they hear nothing, nor where the silent may be since."""
    with pytest.raises(Malformed, match="version 6, this program speaks 7") as caught:
        decode(packed(6, 11, *BEACON[:-2], [row[:-3] for row in BEACON.silent]))
    assert caught.value.reason == "version"


def test_a_program_of_version_1_is_named_as_such():
    """It sent the array alone."""
    with pytest.raises(Malformed, match="version 1, this program speaks 7") as caught:
        decode(msgpack.packb([1, 0, *HAND[:-1]]))
    assert caught.value.reason == "version"
    assert reason(msgpack.packb([1, 4, 2, 10**18, "by the operator"])) == "version"
    assert reason(msgpack.packb([True, 4, 2, 10**18, "by the operator"])) == "checksum"
    assert reason(msgpack.packb([1, 4, 2]) + b"\x00") == "checksum"


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_wrong_number_of_fields(message: Message):
    number, left_out = NUMBER[type(message)], LEFT_OUT.get(type(message), 0)
    fewest = message[: len(message) - left_out]
    assert reason(packed(VERSION, number, *fewest[:-1])) == "malformed"
    assert reason(packed(VERSION, number, *message, 0)) == "malformed"
    assert reason(packed(VERSION, number, *message, *message)) == "malformed"  # every field twice


def test_integers_are_taken_for_floats():
    """Other languages' encoders write 1.0 as the integer 1."""
    message = decode(changed(WRENCH, force=3, torque=-2))
    assert message == WRENCH._replace(force=3.0, torque=-2.0)
    assert type(message.force) is float
    everywhere = decode(changed(HAND, **dict.fromkeys(HAND._fields[5:13], 2)))
    assert all(type(value) is float for value in everywhere[5:13])
    assert decode(changed(PLANT, x=int(FLOAT_MAX), y=-int(FLOAT_MAX)))[3:5] == (FLOAT_MAX, -FLOAT_MAX)
    assert reason(changed(PLANT, x=2**53 + 1)) == "malformed"  # no float is equal to it
    assert reason(changed(PLANT, x=2**64 - 1)) == "malformed"


@pytest.mark.parametrize("version", [0, 1, 2, 3, 4, 5, 6, 8, -1, 255, 2**63, 2.0, "2", None, [2]])
def test_other_versions(version: object):
    assert reason(packed(version, 0, *HAND)) == "version"


@pytest.mark.parametrize("number", [len(MESSAGES), -1, 255, 2**64 - 1, 0.0, "0", None, [0]])
def test_unknown_types(number: object):
    assert reason(packed(VERSION, number, *HAND)) == "type"


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("message", [HAND, PLANT, WRENCH, BEACON], ids=lambda m: type(m).__name__)
def test_not_finite_anywhere(message: Message, value: float):
    for name, known in message._asdict().items():
        if isinstance(known, float):
            assert reason(changed(message, **{name: value})) == "not_finite", name
    if message is HAND:
        assert reason(changed(HAND, multipliers=[[1, value], [2, 0.0]])) == "not_finite"


@pytest.mark.parametrize("message", [HAND, PLANT, WRENCH, BEACON], ids=lambda m: type(m).__name__)
def test_absurd_numbers_are_out_of_range(message: Message):
    for name, known in message._asdict().items():
        if isinstance(known, float):
            for value in (FLOAT_MAX * 1.001, -FLOAT_MAX * 1.001, 1e300, -1.7e308, 2**53):
                assert reason(changed(message, **{name: value})) == "range", (name, value)
    if message is HAND:
        for value in (FLOAT_MAX * 1.001, -1e300, 2**53):
            assert reason(changed(HAND, multipliers=[[1, 0.0], [2, value]])) == "range"


@pytest.mark.parametrize(
    "payload",
    [
        changed(HAND, robot=0),
        changed(HAND, robot=-1),
        changed(HAND, robot=10_000),
        changed(HAND, sequence=-1),
        changed(HAND, sequence=TIME_NS_MAX),
        changed(HAND, time_ns=-1),
        changed(HAND, time_ns=TIME_NS_MAX),
        changed(HAND, multipliers=[[k + 1, 0.5] for k in range(NEIGHBOURS_MAX + 1)]),
        changed(HAND, heard=[[k + 1, 5] for k in range(NEIGHBOURS_MAX + 1)]),
        changed(HAND, degree=-1, x=1),  # an integer for a float takes the slower way
        changed(HAND, degree=DEGREE_MAX + 1, x=1),
        changed(HAND, degree=-1),
        changed(HAND, degree=DEGREE_MAX + 1),
        changed(HAND, heard=[[1, TIME_NS_MAX]]),
        changed(HAND, heard=[[1, -TIME_NS_MAX]]),
        changed(PLANT, robot=0),
        changed(WRENCH, time_ns=2**63 - 1),
        changed(WRENCH, sequence=2**64 - 1),
        changed(MISSION, version=-1),
        changed(MISSION, time_ns=-5),
        changed(MISSION, epoch_ns=-1),
        changed(MISSION, epoch_ns=TIME_NS_MAX),
        changed(MISSION, duration_ns=0),
        changed(MISSION, duration_ns=-1),
        changed(MISSION, duration_ns=TIME_NS_MAX),
        changed(MISSION, from_ns=-1),
        changed(MISSION, blend_ns=TIME_NS_MAX),
        changed(MISSION, trajectory_ns=-1),
        changed(MISSION, robots=[[0, 1.0, 2.0]]),
        changed(MISSION, robots=[[1, FLOAT_MAX * 1.001, 2.0]]),
        changed(MISSION, edges=[[1, 10_000, 2.0]]),
        changed(MISSION, edges=[[1, 2, -1e300]]),
        changed(MISSION, trajectory=[["speed_mps", 1e300]]),
        changed(BEACON, robot=0),
        changed(BEACON, time_ns=-1),
        changed(BEACON, mission_version=-2),
        changed(BEACON, stop_version=TIME_NS_MAX),
        changed(BEACON, silent=((0, 1, True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),)),
        changed(BEACON, silent=((2, -1, True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),)),
        changed(BEACON, silent=((2, 1, True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),) * (SILENT_MAX + 1)),
        changed(BEACON, silent=((2, 1, True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1),)),
        changed(BEACON, unheard=(0,)),
        changed(BEACON, unheard=(ROBOT_MAX + 1,)),
        changed(HEARTBEAT, time_ns=-1),
        changed(ASK, time_ns=TIME_NS_MAX),
        changed(STOP, version=-1),
        changed(STOP, time_ns=-1),
        changed(STATUS, robot=0),
        changed(STATUS, sequence=-1),
        changed(FAULTS, version=-1),
        changed(FAULTS, time_ns=-1),
        changed(FAULTS, origin_ns=-1),
        changed(FAULTS, origin_ns=TIME_NS_MAX),
        changed(FAULTS, lease_ns=-1),
        changed(FAULTS, lease_ns=TIME_NS_MAX),
        changed(FAULTS, author=""),
        changed(FAULTS, author="x" * (AUTHOR_MAX + 1)),
        changed(FAULTS, author="two\nlines"),
        changed(FAULTS, author=EVERY_AUTHOR),  # clears, and has rules nevertheless
        changed(EVENT, robot=0),
        changed(EVENT, time_ns=-1),
        changed(EVENT, role="agents"),
        changed(EVENT, what="burn"),
        changed(TRACE, robot=0),
        changed(TRACE, sequence=-1),
        changed(TRACE, time_ns=TIME_NS_MAX),
        changed(TRACE, entries=[ENTRY] * (TRACE_MAX + 1)),
        changed(TRACE, entries=[ENTRY, (0, *ENTRY[1:])]),
        changed(TRACE, entries=[(10_000, *ENTRY[1:])]),
        changed(TRACE, entries=[(1, -1, *ENTRY[2:])]),
        changed(TRACE, entries=[(1, len(TOPICS), *ENTRY[2:])]),
        changed(TRACE, entries=[(1, 0, -1, *ENTRY[3:])]),
        changed(TRACE, entries=[(1, 0, 1, -1, *ENTRY[4:])]),
        changed(TRACE, entries=[(1, 0, 1, TIME_NS_MAX, *ENTRY[4:])]),
        changed(TRACE, entries=[(*ENTRY[:4], -1, 5)]),
        changed(TRACE, entries=[(*ENTRY[:4], WHAT_MAX + 1, 5)]),
        changed(TRACE, entries=[(*ENTRY[:5], -2)]),
        changed(TRACE, entries=[(*ENTRY[:5], TIME_NS_MAX)]),
        changed(RESUME, version=-1),
        changed(RESUME, version=TIME_NS_MAX),
        changed(RESUME, time_ns=-1),
        changed(RESUME, time_ns=TIME_NS_MAX),
        changed(RESUME, robots=[0]),
        changed(RESUME, robots=[3, -1]),
        changed(RESUME, robots=[10_000]),
        changed(CHECKS, robot=0),
        changed(CHECKS, sequence=-1),
        changed(CHECKS, time_ns=TIME_NS_MAX),
        changed(CHECKS, lines=[LINE] * (CHECKS_MAX + 1)),
        changed(CHECKS, lines=[LINE, ("gps", "", "", "")]),
        changed(CHECKS, lines=[("gps", "bad", "", "")]),
        changed(CHECKS, lines=[("gps", "OK", "", "")]),
    ],
)
def test_out_of_range(payload: bytes):
    assert reason(payload) == "range"


@pytest.mark.parametrize(
    "payload",
    [
        changed(HAND, multipliers=[1]),
        changed(HAND, multipliers=[[1]]),
        changed(HAND, multipliers=[[1, 0.5, 2]]),
        changed(HAND, multipliers=[[1.0, 0.5]]),
        changed(HAND, multipliers=[["1", 0.5]]),
        changed(HAND, multipliers=[[1, "0.5"]]),
        changed(HAND, multipliers=[[1, None]]),
        changed(HAND, multipliers=[[1, [0.5]]]),
        changed(HAND, multipliers=[[]]),
        changed(HAND, heard=[1]),
        changed(HAND, heard=[[1]]),
        changed(HAND, heard=[[1, 2, 3]]),
        changed(HAND, heard=[[1, 2.0]]),
        changed(HAND, heard=[["1", 2]]),
        changed(HAND, heard=["12"]),
        changed(HAND, heard=[[]]),
        changed(MISSION, robots=[[1, 2.0]]),
        changed(MISSION, robots=[[1.0, 2.0, 3.0]]),
        changed(MISSION, robots=[1]),
        changed(MISSION, edges=[[1, 2]]),
        changed(MISSION, edges=[[1, 2, None]]),
        changed(MISSION, edges=["1-2"]),
        changed(MISSION, trajectory=["kind"]),
        changed(MISSION, trajectory=[["kind"]]),
        changed(MISSION, trajectory=[[1, "kind"]]),
        changed(MISSION, trajectory=[["kind", None]]),
        changed(MISSION, trajectory=[["kind", b"hold"]]),
        changed(MISSION, trajectory=[["waypoints_m", [[[1.0]]]]]),
        changed(STATUS, neighbours=[[1]]),
        changed(STATUS, neighbours=[[1, 20_000]]),
        changed(STATUS, neighbours=[[1, 20_000, 5, 0, 0, 0.5]]),
        changed(STATUS, neighbours=[1, 2]),
        changed(STATUS, counters=[[1, 1]]),
        changed(STATUS, counters=[["sent", 1.5]]),
        changed(STATUS, counters=["sent"]),
        changed(STATUS, tick_us=[1.5]),
        changed(STATUS, tick_us=[None]),
        changed(STATUS, ages_us=["1"]),
        changed(STATUS, ages_us=[[1]]),
        changed(TRACE, entries=[1]),
        changed(TRACE, entries=[[]]),
        changed(TRACE, entries=[ENTRY[:-1]]),
        changed(TRACE, entries=[(*ENTRY, 0)]),
        changed(TRACE, entries=[(*ENTRY[:5], 5.0)]),
        changed(TRACE, entries=["123456"]),
        changed(RESUME, robots=["3"]),
        changed(RESUME, robots=[3.0]),
        changed(RESUME, robots=[None]),
        changed(RESUME, robots=[[3]]),
        changed(RESUME, robots=[1] * 2049),  # more than an array may hold
        changed(CHECKS, lines=["gps"]),
        changed(CHECKS, lines=["four"]),
        changed(CHECKS, lines=[[]]),
        changed(CHECKS, lines=[LINE[:3]]),
        changed(CHECKS, lines=[(*LINE, "")]),
        changed(CHECKS, lines=[("gps", 0, "", "")]),
        changed(CHECKS, lines=[("gps", "ok", "", None)]),
        changed(CHECKS, lines=[(["gps"], "ok", "", "")]),
        changed(CHECKS, lines=[(b"gps", "ok", "", "")]),
    ],
)
def test_malformed_parts(payload: bytes):
    assert reason(payload) == "malformed"


def test_size_has_a_limit():
    room = BYTES_MAX - len(encode(STATUS._replace(ages_us=()))) - 2  # the array's head grows by 2
    largest = encode(STATUS._replace(ages_us=(100,) * room))
    assert len(largest) == BYTES_MAX
    # That many values are more than an array may hold; with five bytes a value it fits.
    assert reason(largest) == "malformed"
    assert decode(encode(STATUS._replace(ages_us=(100_000,) * (room // 5)))).ages_us[-1] == 100_000
    assert 8 * BYTES_MAX <= 91_607, "the checksum would no longer find any three flipped bits"
    assert reason(largest + b"\x00") == "oversized"
    assert reason(b"\x00" * (BYTES_MAX + 1)) == "oversized"
    assert reason(b"\xff" * 10_000_000) == "oversized"


def test_as_many_multipliers_as_neighbours_fit():
    ids = range(9000, 9000 + NEIGHBOURS_MAX)
    most = HAND._replace(
        multipliers=tuple((k, 0.1) for k in ids), heard=tuple((k, 1 - TIME_NS_MAX) for k in ids)
    )
    assert decode(encode(most)) == most


def test_of_two_missions_the_greater_version_holds_and_of_equal_ones_the_greater_content():
    other = MISSION._replace(note="robot 4 has joined")
    assert newer(MISSION, None)
    assert newer(MISSION._replace(version=3, epoch_ns=0), other)
    assert not newer(other, MISSION._replace(version=3))
    assert newer(other, MISSION) is not newer(MISSION, other)
    assert not newer(MISSION, MISSION)
    assert not newer(MISSION._replace(time_ns=MISSION.time_ns + 1), MISSION)  # said again


@pytest.mark.parametrize("level", LEVELS)
def test_as_many_checks_as_one_message_may_have_fit_in_it(level: str):
    longest = "é" * (CHECK_TEXT_MIN // 2)
    most = Checks(9999, TIME_NS_MAX - 1, TIME_NS_MAX - 1, ((longest, level, longest, longest),) * CHECKS_MAX)
    assert decode(encode(most)) == most
    assert decode(encode(CHECKS._replace(lines=()))).lines == ()


def test_a_text_is_cut_at_a_whole_character():
    assert clipped("x" * TEXT_MAX) == "x" * TEXT_MAX
    assert clipped("x" * (TEXT_MAX + 1)) == "x" * (TEXT_MAX - 3) + "..."
    assert clipped("é" * 5, 10) == "é" * 5
    assert clipped("é" * 6, 10) == "é" * 3 + "..."


# ---------------------------------------------------------------------- hostile


ROOM = BYTES_MAX - 5  # for the checksum
HOSTILE = {
    "array of 2^32": b"\xdd\xff\xff\xff\xff",
    "array of 2^16": b"\xdc\xff\xff",
    "text of 2^32": b"\x95" + V + b"\x04\x02\x00\xdb\xff\xff\xff\xff",
    "bytes of 2^32": b"\x95" + V + b"\x04\x02\x00\xc6\xff\xff\xff\xff",
    "map of 2^32": b"\xdf\xff\xff\xff\xff",
    "extension of 2^32": b"\x95" + V + b"\x04\x02\x00\xc9\xff\xff\xff\xff\x05",
    "arrays in arrays": b"\x91" * ROOM,
    "arrays in arrays, closed": b"\x91" * (ROOM - 1) + b"\x90",
    "long arrays in arrays": b"\xdc\x08\x00" * (ROOM // 3),
    "huge arrays in arrays": b"\xdd\x00\x00\x08\x00" * (ROOM // 5),
    "maps in maps": b"\x81\x01" * (ROOM // 2),
    "empty arrays": b"\xdc\x08\x00" + b"\x90" * 2048,
}


@pytest.mark.parametrize("payload", HOSTILE.values(), ids=HOSTILE)
def test_hostile_payloads_are_refused_fast_and_small(payload: bytes):
    decode(encode(WRENCH))
    tracemalloc.start()
    try:
        start = time.process_time()
        assert reason(sealed(payload)) in ("malformed", "version")
        reason(payload)
        took = time.process_time() - start
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 40_000_000
    assert took < 1.0  # under tracemalloc; a stall would be far beyond it


def test_all_that_decoding_makes_can_be_made_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process that others are forked from: else each of them takes 15 ms in one of its first ticks."""
    monkeypatch.setattr(codec, "_takers", {})
    codec.be_ready()
    made: list[object] = []
    monkeypatch.setattr(codec, "taker", lambda cls: made.append(cls))
    for message in MESSAGES:
        assert decode(encode(message)) == message
    assert made == []
