"""What is read of a segment that somebody else wrote."""

from __future__ import annotations

import zlib
from io import BytesIO

from handfast.agent.recorder.segments import PACKED_BYTES_MAX, Segment, message_block


class Reads(BytesIO):
    """A file that knows the largest piece that was asked of it."""

    most = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.most = max(self.most, size if size is not None and size >= 0 else 2**62)
        return super().read(size)


def with_length(block: bytes, length: int) -> bytes:
    """A block whose head claims another length of its content, with a checksum that is right."""
    head = block[:12] + length.to_bytes(4, "big") + block[16:44]
    return head + zlib.crc32(head).to_bytes(4, "big") + block[48:]


def test_a_head_cannot_have_gigabytes_read() -> None:
    block = message_block([(1, "a", b"b")])
    size = len(block) - 48
    assert with_length(block, size) == block
    for length in (PACKED_BYTES_MAX + 1, 2**32 - 1):
        stream = Reads(with_length(block, length) + bytes(length - size if length < 2**24 else 0) + block)
        segment = Segment(stream)
        found = [segment.messages(each) for each in segment.blocks()]
        assert found == [[(1, "a", b"b")]], "what follows is read"
        assert segment.damaged == 1
        assert stream.most <= 1 << 16
