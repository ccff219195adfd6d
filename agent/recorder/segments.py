"""The bytes of what a robot's computer records (PURE). `agent.recorder.segment_folder` has the files.

A segment is a file to which blocks are only ever appended. Each block is a head (`_HEAD`) and its content,
compressed by zlib. The first block says whose the segment is (`About`), the second which orders were known
before it, all others hold messages: so each segment stands alone. Heads and contents have checksums of their
own: a segment can be cut at any byte and damaged anywhere, and all blocks that are whole are read. A power
loss costs the block that was being written.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from struct import Struct
from typing import IO, Any, Final, NamedTuple

import msgpack

Received = tuple[int, str, bytes]
"""One message: when it was received (wall clock, ns), its key, its bytes as they came."""

MAGIC: Final = b"\x89HFSEG\r\n"
FORMAT: Final = 1
LEVEL: Final = 1
"""Of zlib: higher ones take several times as long for a few per cent."""
CONTENT_BYTES_MAX: Final = 8 << 20
"""Of a block, before compression."""
PACKED_BYTES_MAX: Final = CONTENT_BYTES_MAX + 65_536
"""And after it: what cannot be compressed grows a little."""

ABOUT: Final = 0
MESSAGES: Final = 1
KNOWN: Final = 2
"""Orders from before the segment, with their times."""
# Flags of a block.
ORDERS: Final = 1
"""It holds orders: those who look for them need not read all other blocks."""
OVERFLOW: Final = 2
"""More came than the recorder could take: how much is missing before it is not known."""

# Magic, kind, flags, format, bytes of the content, messages in it, messages lost before it, reception of the
# first and of the last (ns), CRC-32 of the content, CRC-32 of all that.
_HEAD: Final = Struct(">8sBBHIIIQQII")
_CHECKED: Final = _HEAD.size - 4
_SEARCH_BYTES: Final = 1 << 16
_COUNT_MAX: Final = 2**32 - 1


class About(NamedTuple):
    """Whose a segment is.

    `digest` is that of the fleet file, `fleet_toml` the file's text. `version` is handfast's; `boot` names
    the start of the computer, "" where that is not known. `number` counts segments; `begun_ns` is the
    reception of its first message (wall clock).
    """

    fleet: str
    digest: str
    robot: int
    version: str
    boot: str
    number: int
    begun_ns: int
    fleet_toml: str


class Block(NamedTuple):
    """The head of a block. The disk took none of `lost` messages that came before it."""

    kind: int
    flags: int
    messages: int
    lost: int
    first_ns: int
    last_ns: int
    offset: int
    """Of its content in the file."""
    length: int
    checksum: int


def about_block(about: About) -> bytes:
    """The first block of a segment."""
    content = msgpack.packb(about._asdict())
    return _block(ABOUT, 0, 0, 0, about.begun_ns, about.begun_ns, content)


def message_block(
    received: Iterable[Received], *, kind: int = MESSAGES, flags: int = 0, lost: int = 0
) -> bytes:
    """A block of messages, at least one, in the order of their reception: `CONTENT_BYTES_MAX` at most."""
    entries = list(received)
    first_ns = entries[0][0]
    pack = msgpack.Packer(use_bin_type=True).pack
    content = b"".join(pack((max(0, at_ns - first_ns), key, payload)) for at_ns, key, payload in entries)
    return _block(kind, flags, len(entries), lost, first_ns, max(first_ns, entries[-1][0]), content)


def _block(
    kind: int, flags: int, count: int, lost: int, first_ns: int, last_ns: int, content: bytes
) -> bytes:
    packed = zlib.compress(content, LEVEL)
    numbers = (kind, flags, FORMAT, len(packed), count, min(lost, _COUNT_MAX), first_ns, last_ns)
    head = _HEAD.pack(MAGIC, *numbers, zlib.crc32(packed), 0)[:_CHECKED]
    return head + zlib.crc32(head).to_bytes(4, "big") + packed


class Segment:
    """Reads one segment.

    Args:
        stream: the file, open for reading bytes, that can be sought in.

    Attributes:
        damaged: pieces that were no block, and blocks that did not hold what was written; counted while
            reading.
        cut: whether the file ended within a block, or with something that is none.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.damaged = 0
        self.cut = False

    def blocks(self) -> Iterator[Block]:
        """The heads of all blocks; `about` and `messages` may be asked for each in between."""
        end = self._stream.seek(0, 2)
        offset = 0
        while offset < end:
            block = self._head(offset)
            if block is None:
                found = self._find(offset + 1)
                if found is None:
                    self.cut = True
                    return
                self.damaged += 1
                offset = found
                continue
            offset = block.offset + block.length
            if offset > end:
                self.cut = True
                return
            if block.kind in (ABOUT, MESSAGES, KNOWN):
                yield block

    def about(self, block: Block) -> About | None:
        """What a block of the kind `ABOUT` holds, None when it is damaged."""
        try:
            fields = msgpack.unpackb(self._content(block))
            about = About(**fields)
        except Exception:  # msgpack raises a dozen unrelated types; each means the same here
            self.damaged += 1
            return None
        kinds = (str, str, int, str, str, int, int, str)
        if any(type(value) is not kind for value, kind in zip(about, kinds, strict=True)):
            self.damaged += 1
            return None
        return about

    def messages(self, block: Block) -> list[Received]:
        """The messages of a block of the kind `MESSAGES` or `KNOWN`, none when it is damaged."""
        try:
            entries: list[Any] = []
            content = self._content(block)
            unpacker = msgpack.Unpacker(use_list=False, max_buffer_size=CONTENT_BYTES_MAX)
            unpacker.feed(content)
            for after_ns, key, payload in unpacker:
                if not (type(after_ns) is int and type(key) is str and type(payload) is bytes):
                    raise ValueError(f"not a message: {key!r}")
                entries.append((block.first_ns + after_ns, key, payload))
            if len(entries) != block.messages:
                raise ValueError(f"{len(entries)} messages instead of {block.messages}")
        except Exception:  # see `about`
            self.damaged += 1
            return []
        return entries

    def _content(self, block: Block) -> bytes:
        packed = self._read(block.offset, block.length)
        if zlib.crc32(packed) != block.checksum:
            raise ValueError("the checksum of its content is wrong")
        inflate = zlib.decompressobj()
        content = inflate.decompress(packed, CONTENT_BYTES_MAX)
        if not inflate.eof:
            raise ValueError("its content does not end")
        return content

    def _head(self, offset: int) -> Block | None:
        head = self._read(offset, _HEAD.size)
        if len(head) < _HEAD.size or not head.startswith(MAGIC):
            return None
        _, kind, flags, form, length, count, lost, first_ns, last_ns, content, own = _HEAD.unpack(head)
        if zlib.crc32(head[:_CHECKED]) != own or form != FORMAT or length > PACKED_BYTES_MAX:
            return None
        return Block(kind, flags, count, lost, first_ns, last_ns, offset + _HEAD.size, length, content)

    def _find(self, offset: int) -> int | None:
        """Where the next head may begin."""
        while len(data := self._read(offset, _SEARCH_BYTES)) >= len(MAGIC):
            found = data.find(MAGIC)
            if found >= 0:
                return offset + found
            offset += len(data) - len(MAGIC) + 1
        return None

    def _read(self, offset: int, length: int) -> bytes:
        self._stream.seek(offset)
        return self._stream.read(length)
