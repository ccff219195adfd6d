"""Writing an MCAP file: the same bytes as `mcap.writer` writes, in a tenth of its time for each message.

The format: https://mcap.dev/spec. A file is records: opcode, length, content; integers are little-endian.
Messages stand in chunks, each compressed, with an index of its messages after it; a summary is at the end.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import IO, Final
from zlib import crc32

import zstandard
from mcap.opcode import Opcode

MAGIC: Final = b"\x89MCAP0\r\n"
PREFIX: Final = struct.Struct("<BQ")
"""What a record begins with: opcode, length of what follows."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""The beginning of a message's record: as above; channel, sequence, log time, publish time."""
_FIXED_BYTES: Final = _MESSAGE.size - PREFIX.size
_COMPRESSION: Final = "zstd"
_IS_MESSAGE: Final = int(Opcode.MESSAGE)


def _record(opcode: Opcode, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return PREFIX.pack(opcode, len(content)) + content


def _text(text: str) -> bytes:
    return _sized(text.encode())


def _sized(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def _map(texts: Mapping[str, str]) -> bytes:
    return _sized(b"".join(_text(name) + _text(value) for name, value in texts.items()))


class McapWriter:
    """Writes a file to a stream that is open at its beginning.

    Args:
        library: who writes, for the header.
        chunk_bytes: a chunk that has become larger is complete.

    All methods raise OSError where the stream cannot be written.
    """

    def __init__(self, stream: IO[bytes], library: str, chunk_bytes: int) -> None:
        self._stream, self._chunk_bytes = stream, chunk_bytes
        self._compress = zstandard.ZstdCompressor().compress
        self._at = 0
        """How much has been written."""
        self._parts: list[bytes] = []
        self._bytes = 0
        """The chunk in progress, and its length."""
        self._index: dict[int, list[int]] = {}
        """Of the chunk's messages, by channel: log time and place of each, one after the other."""
        self._counts: dict[int, int] = {}
        self._begin_ns: int | None = None
        self._end_ns = 0
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunks: list[bytes] = []
        self._attachments: list[bytes] = []
        self._metadata: list[bytes] = []
        self._write(MAGIC + _record(Opcode.HEADER, _text(""), _text(library)))

    def add_metadata(self, name: str, texts: Mapping[str, str]) -> None:
        """Writes named texts, now: before the chunk in progress."""
        record = _record(Opcode.METADATA, _text(name), _map(texts))
        place = struct.pack("<QQ", self._at, len(record))
        self._write(record)
        self._metadata.append(_record(Opcode.METADATA_INDEX, place, _text(name)))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Writes a file that belongs to the recording, now: before the chunk in progress."""
        times, named = struct.pack("<QQ", 0, 0), _text(name) + _text(media_type)
        size = struct.pack("<Q", len(data))
        content = times + named + size + data
        record = _record(Opcode.ATTACHMENT, content, struct.pack("<I", crc32(content)))
        place = struct.pack("<QQ", self._at, len(record))
        self._write(record)
        self._attachments.append(_record(Opcode.ATTACHMENT_INDEX, place, times, size, named))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Introduces a schema; returns its number."""
        number = len(self._schemas) + 1
        record = _record(Opcode.SCHEMA, struct.pack("<H", number), _text(name), _text(encoding), _sized(data))
        self._schemas.append(record)
        self._add(record)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, texts: Mapping[str, str]) -> int:
        """Introduces a channel; returns its number. `schema` 0: its messages have none."""
        number = len(self._channels) + 1
        record = _record(
            Opcode.CHANNEL, struct.pack("<HH", number, schema), _text(topic), _text(encoding), _map(texts)
        )
        self._channels.append(record)
        self._add(record)
        return number

    def add_message(self, channel: int, log_ns: int, content: bytes, publish_ns: int, sequence: int) -> None:
        """Adds a message. Its times have 64 bits and are not below 0, its sequence has 32 bits."""
        size = len(content)
        head = _MESSAGE.pack(_IS_MESSAGE, _FIXED_BYTES + size, channel, sequence, log_ns, publish_ns)
        places = self._index.get(channel)
        if places is None:
            places = self._index[channel] = []
        places += (log_ns, self._bytes)
        self._parts += (head, content)
        self._bytes += _MESSAGE.size + size
        if self._bytes > self._chunk_bytes:
            self._end_chunk()

    def flush(self) -> None:
        """Ends the chunk in progress, if it has a message, and hands all to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Completes the file, and leaves the stream open."""
        self._end_chunk()
        self._write(_record(Opcode.DATA_END, struct.pack("<I", 0)))
        begin = self._at
        summary, offsets = b"", b""
        groups: tuple[tuple[Opcode, list[bytes]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        for opcode, records in groups:
            group = b"".join(records)
            place = struct.pack("<BQQ", opcode, begin + len(summary), len(group))
            offsets += _record(Opcode.SUMMARY_OFFSET, place)
            summary += group
        footer = PREFIX.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", begin, begin + len(summary))
        summary += offsets
        self._write(summary + footer + struct.pack("<I", crc32(footer, crc32(summary))) + MAGIC)

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *count) for count in self._counts.items())
        numbers = struct.pack(
            "<QHIIIIQQ",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            len(self._attachments),
            len(self._metadata),
            len(self._chunks),
            self._begin_ns or 0,
            self._end_ns,
        )
        return _record(Opcode.STATISTICS, numbers, _sized(counts))

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._at += len(data)

    def _add(self, record: bytes) -> None:
        """Adds a record to the chunk."""
        self._parts.append(record)
        self._bytes += len(record)
        if self._bytes > self._chunk_bytes:
            self._end_chunk()

    def _end_chunk(self) -> None:
        if not self._index:
            return
        begin_ns = min(min(places[::2]) for places in self._index.values())
        end_ns = max(max(places[::2]) for places in self._index.values())
        self._begin_ns = begin_ns if self._begin_ns is None else min(self._begin_ns, begin_ns)
        self._end_ns = max(self._end_ns, end_ns)
        data = b"".join(self._parts)
        packed = self._compress(data)
        times, size = struct.pack("<QQ", begin_ns, end_ns), struct.pack("<Q", len(data))
        compression, packed_size = _text(_COMPRESSION), struct.pack("<Q", len(packed))
        crc = struct.pack("<I", crc32(data))
        chunk = _record(Opcode.CHUNK, times, size, crc, compression, packed_size, packed)
        place, after = struct.pack("<QQ", self._at, len(chunk)), self._at + len(chunk)
        indices, offsets = b"", b""
        for channel, places in self._index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(places) // 2
            offsets += struct.pack("<HQ", channel, after + len(indices))
            content = struct.pack(f"<{len(places)}Q", *places)
            indices += _record(Opcode.MESSAGE_INDEX, struct.pack("<H", channel), _sized(content))
        sizes = compression + packed_size + size
        self._chunks.append(
            _record(Opcode.CHUNK_INDEX, times, place, _sized(offsets), struct.pack("<Q", len(indices)), sizes)
        )
        self._parts, self._bytes, self._index = [], 0, {}
        self._write(chunk + indices)
