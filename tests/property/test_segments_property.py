"""A segment may be cut at any byte and damaged anywhere: all blocks that are whole are read."""

from __future__ import annotations

from io import BytesIO

from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.recorder.segments import (
    ABOUT,
    MESSAGES,
    About,
    Received,
    Segment,
    about_block,
    message_block,
)

BEGUN_NS = 1_763_600_000_000_000_000
TOLD = About("delta", "0123456789abcdef", 3, "0.1.0", "boot", 7, BEGUN_NS, '[fleet]\nname = "delta"\n')

keys = st.sampled_from(["delta/robot/3/hand", "delta/robot/3/plant/state", "delta/robot/3/told"])
payloads = st.binary(max_size=80) | st.integers(0, 400).map(
    lambda count: bytes(range(256)) * 2 + b"x" * count
)


@st.composite
def runs(draw: st.DrawFn) -> list[list[Received]]:
    """Blocks of messages, in the order of their reception."""
    now_ns = BEGUN_NS
    blocks = []
    for size in draw(st.lists(st.integers(1, 6), min_size=1, max_size=6)):
        block = []
        for _ in range(size):
            now_ns += draw(st.integers(0, 200_000_000))
            block.append((now_ns, draw(keys), draw(payloads)))
        blocks.append(block)
    return blocks


def written(blocks: list[list[Received]]) -> tuple[bytes, list[int]]:
    """A segment, and where in it each block ends, the first among them."""
    data = about_block(TOLD)
    ends = [len(data)]
    for block in blocks:
        data += message_block(block)
        ends.append(len(data))
    return data, ends


def read(data: bytes) -> tuple[list[About | None], list[list[Received]], Segment]:
    segment = Segment(BytesIO(data))
    about: list[About | None] = []
    messages = []
    for block in segment.blocks():
        if block.kind == ABOUT:
            about.append(segment.about(block))
        else:
            assert block.kind == MESSAGES
            found = segment.messages(block)
            if found:
                assert (block.first_ns, block.last_ns) == (found[0][0], found[-1][0])
                messages.append(found)
    return about, messages, segment


@given(runs())
def test_what_is_written_is_read(blocks: list[list[Received]]) -> None:
    about, messages, segment = read(written(blocks)[0])
    assert about == [TOLD]
    assert messages == blocks
    assert (segment.damaged, segment.cut) == (0, False)


@given(runs(), st.data())
def test_all_blocks_before_a_cut_are_read(blocks: list[list[Received]], draws: st.DataObject) -> None:
    data, ends = written(blocks)
    cut = draws.draw(st.integers(0, len(data)))
    about, messages, segment = read(data[:cut])
    whole = sum(end <= cut for end in ends)
    assert about == [TOLD][:whole]
    assert messages == blocks[: max(0, whole - 1)]
    assert segment.cut is (cut not in (0, *ends))
    assert segment.damaged == 0


@given(runs(), st.data(), st.binary(max_size=100))
def test_what_follows_a_cut_does_no_harm(
    blocks: list[list[Received]], draws: st.DataObject, rest: bytes
) -> None:
    """A file system may leave anything where a block was being written, such as zeros."""
    data, ends = written(blocks)
    cut = draws.draw(st.integers(0, len(data)))
    _, messages, _ = read(data[:cut] + rest)
    whole = sum(end <= cut for end in ends)
    assert messages[: max(0, whole - 1)] == blocks[: max(0, whole - 1)]


@given(runs(), st.data())
def test_a_flipped_byte_costs_one_block(blocks: list[list[Received]], draws: st.DataObject) -> None:
    data, ends = written(blocks)
    at = draws.draw(st.integers(0, len(data) - 1))
    flip = draws.draw(st.integers(1, 255))
    about, messages, segment = read(data[:at] + bytes([data[at] ^ flip]) + data[at + 1 :])
    hit = sum(end <= at for end in ends)
    assert about in ([[TOLD]] if hit else [[], [None]])
    assert messages == [block for number, block in enumerate(blocks, 1) if number != hit]
    assert segment.damaged + segment.cut == 1


@given(runs(), st.data())
def test_nothing_is_read_that_was_not_written(blocks: list[list[Received]], draws: st.DataObject) -> None:
    data, ends = written(blocks)
    start = draws.draw(st.integers(0, len(data)))
    end = draws.draw(st.integers(start, len(data)))
    _, messages, _ = read(data[:start] + data[end:])
    before = [block for block, its_end in zip(blocks, ends[1:], strict=True) if its_end <= start]
    assert messages[: len(before)] == before
    assert all(block in blocks for block in messages)


@given(st.binary(max_size=300))
def test_anything_else_is_no_segment(data: bytes) -> None:
    assert read(data)[:2] == ([], [])


def test_the_next_block_is_found_wherever_it_is() -> None:
    data, _ = written([[(BEGUN_NS, "key", b"payload")]])
    for size in range(65_520, 65_550):  # around the end of a piece that is searched
        about, messages, segment = read(bytes(size) + data)
        assert about == [TOLD], size
        assert messages == [[(BEGUN_NS, "key", b"payload")]]
        assert segment.damaged == 1


def test_a_whole_content_in_the_wrong_place_is_damage() -> None:
    """As where a disk has written one sector for another: it is sound in itself."""
    one, other = (message_block([(BEGUN_NS, "key", payload)]) for payload in (b"one", b"two"))
    assert len(one) == len(other)
    head = len(one) - len(one.partition(b"\x78\x01")[2]) - 2
    _, messages, segment = read(one[:head] + other[head:])
    assert messages == []
    assert segment.damaged == 1
