"""Bytes on a serial line: as fast as its speed, whole messages or none, garbage at another speed."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.simulator.uart import HANDED_ON_NS, Wire, misread

NOW_NS = 1_800_000_000 * NS_PER_S


def test_ten_bits_a_byte() -> None:
    wire = Wire(57_600, 10_000)
    message = bytes(range(256)) * 36
    wire.put(message, NOW_NS)
    assert wire.take(NOW_NS) == b""
    assert len(wire.take(NOW_NS + NS_PER_S // 2)) == 2880
    assert len(wire.take(NOW_NS + NS_PER_S)) == 2880
    assert wire.take(NOW_NS + 10 * NS_PER_S) == message[5760:]
    assert wire.due_ns is None


def test_time_at_rest_is_not_saved_up() -> None:
    wire = Wire(57_600, 512)
    wire.put(b"x", NOW_NS)
    assert wire.take(NOW_NS + NS_PER_S) == b"x"
    wire.put(bytes(500), NOW_NS + 2 * NS_PER_S)
    assert wire.take(NOW_NS + 2 * NS_PER_S) == b""
    assert len(wire.take(NOW_NS + 2 * NS_PER_S + NS_PER_S // 100)) == 57


def test_looked_at_whenever_something_is_due_it_carries_no_less() -> None:
    wire = Wire(921_600, 4096)
    wire.put(bytes(4096), NOW_NS)
    pieces = []
    while (due_ns := wire.due_ns) is not None:
        pieces.append(len(wire.take(due_ns)))
        last_ns = due_ns
    assert sum(pieces) == 4096
    assert pieces[0] == 921_600 * HANDED_ON_NS // (10 * NS_PER_S)
    assert 0 <= last_ns - NOW_NS - 4096 * 10 * NS_PER_S // 921_600 <= 1


def test_what_does_not_fit_is_lost_as_a_whole() -> None:
    wire = Wire(57_600, 100)
    wire.put(b"a" * 60, NOW_NS)
    wire.put(b"b" * 60, NOW_NS)
    wire.put(b"c" * 40, NOW_NS)
    assert wire.lost == 1
    assert wire.take(NOW_NS + NS_PER_S) == b"a" * 60 + b"c" * 40


def test_a_restart_loses_what_waits() -> None:
    wire = Wire(57_600, 100)
    wire.put(b"a" * 60, NOW_NS)
    wire.clear()
    assert wire.due_ns is None
    wire.put(b"b", NOW_NS + NS_PER_S)
    assert wire.take(NOW_NS + 2 * NS_PER_S) == b"b"


def test_at_another_speed_it_is_garbage_and_always_the_same() -> None:
    data = bytes(range(256))
    assert misread(data, 57_600, 57_600) == data
    for read in (9_600, 38_400, 115_200, 921_600):
        found = misread(data, 57_600, read)
        assert found == misread(data, 57_600, read)
        assert found
        assert data[:16] not in found
    # Half a per cent, as two crystals differ, is no other speed.
    assert misread(data, 57_600, 57_900) == data
    assert misread(b"\x55", 115_200, 57_600) == b"\xff", "the receiver sees every other bit"
    assert misread(b"\x00", 57_600, 115_200) == b"\x00"
