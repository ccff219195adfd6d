"""The sound records of an MCAP file that may be cut short or damaged.

The `mcap` library reads a file up to its first damaged byte. This module leaves out what is damaged: a chunk
whose content does not match its checksum, and any bytes that are no record. It goes on at the next chunk,
metadata or end of data. The times of lost messages come from the index at the end of the file; without an
index they come from the chunks before and after the damage.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from typing import IO, Any, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

MAGIC: Final[bytes] = MCAP0_MAGIC
PREFIX: Final = struct.Struct("<BQ")
"""Beginning of a record: opcode, length of its content."""
RECORD_BYTES_MAX: Final = 1 << 30
_FOOTER_BYTES: Final = PREFIX.size + 20
_CHUNK_BYTES: Final = 40
"""Length of a chunk's record without its data and the name of the compression."""
_BLOCK_BYTES: Final = 1 << 20
_MARK_BYTES: Final = 80
_MARK: Final = re.compile(
    rb"\x06(?=.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd))"
    rb"|\x0c(?=.{8}.\0\0\0handfast\.)"
    rb"|\x0f(?=\x04\0\0\0\0\0\0\0)",
    re.DOTALL,
)
"""Beginnings of a chunk, of our metadata and of the end of the data."""
_CLASSES: Final[Mapping[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.DATA_END: DataEnd,
}
_WITHOUT_MESSAGES: Final = (*_CLASSES.keys() - {Opcode.CHUNK}, Opcode.MESSAGE_INDEX)
_ERRORS: Final = (McapError, ValueError, struct.error, RuntimeError, MemoryError, OverflowError)
"""Exceptions of the library for damaged input; those of its decompressors come on top (`unpacked`)."""


class Damaged(Exception):
    """The bytes read are no sound record."""


class Lost(NamedTuple):
    """A part of the file that is lost: log times (ns) of its first and last message.

    None where the time is unknown: the part is at the beginning or at the end.
    """

    since_ns: int | None
    until_ns: int | None


class Records:
    """The sound records of a file's data section, in order. Iterate once.

    Args:
        stream: the file, seekable.
        wants: False for a chunk that need not be unpacked. Such a chunk is not checked either.

    Attributes:
        damaged: True once anything has been left out.
        lost: the lost parts, complete when the iteration has ended.
        ends: True if the data was read to its end.
        is_whole: True if the end of the data and the summary after it are there and sound.
    """

    def __init__(self, stream: IO[bytes], wants: Callable[[Chunk], bool] = lambda chunk: True) -> None:
        self._stream, self._wants = stream, wants
        self._size = stream.seek(0, 2)
        self.lost: list[Lost] = []
        self.damaged = self.ends = self.is_whole = False
        self._open: list[Lost] = []
        """Damaged parts since the last sound chunk, with the times that they claim."""
        self._last_ns: int | None = None
        self._sound: set[int] = set()
        """Offsets of the sound chunks."""
        self.summary: Final = self._read_summary()
        """The summary at the end of the file; None where it is missing or damaged."""

    def __iter__(self) -> Iterator[McapRecord]:
        """Header, schemas, channels, messages, metadata, attachments, and chunks with their data unpacked."""
        at: int | None = len(MAGIC)
        if self._read(0, len(MAGIC)) != MAGIC:
            at = self._next(0)
            if at is not None:
                self._leave_out(Lost(None, None))
        ended = False
        while at is not None and not ended:
            try:
                record, after = self._record(at)
                if isinstance(record, Chunk) and self._wants(record):
                    record.data, record.compression = unpacked(record), ""
            except Damaged:
                at = self._past(at)
                continue
            if isinstance(record, Chunk):
                self._settle(record.message_start_time)
                self._sound.add(at)
                self._last_ns = max(self._last_ns or 0, record.message_end_time)
            ended = isinstance(record, DataEnd)
            if not ended and not isinstance(record, MessageIndex):
                yield record
            at = after
        self._end(ended)

    def _end(self, ended: bool) -> None:
        """Determine what is lost, now that all has been read."""
        self._settle(None)
        chunks = self.summary.chunk_indexes if self.summary else []
        if chunks:
            self.lost = [
                Lost(each.message_start_time, each.message_end_time)
                for each in sorted(chunks, key=lambda each: each.chunk_start_offset)
                if each.chunk_start_offset not in self._sound
            ]
        self.ends = ended or bool(chunks)
        self.is_whole = ended and self.summary is not None

    def _past(self, at: int) -> int | None:
        """Leave out what begins at `at`; return where to go on."""
        self.damaged = True
        try:
            opcode, content = self._content(at)
            chunk = parsed(Opcode.CHUNK, content) if opcode == Opcode.CHUNK else None
        except Damaged:
            opcode, content, chunk = 0, b"", None
        end = at + PREFIX.size + len(content)
        if isinstance(chunk, Chunk):
            # A chunk that lacks bytes ends before the length that it states.
            self._leave_out(Lost(chunk.message_start_time, chunk.message_end_time))
            return end if self._is_record(end) else self._next(at + 1) or end
        following = self._next(at + 1)
        if opcode in _WITHOUT_MESSAGES and end <= (following or self._size) and self._is_record(end):
            return end  # no message is lost
        if following is not None:
            self._leave_out(Lost(None, None))
        return following

    def _leave_out(self, lost: Lost) -> None:
        self.damaged = True
        self._open.append(lost)

    def _settle(self, next_ns: int | None) -> None:
        """Determine the times of the open parts, which lie before a chunk that begins at `next_ns`."""
        earliest, latest = self._last_ns or 0, 2**64 if next_ns is None else next_ns
        for since_ns, until_ns in self._open:
            # The times that a damaged chunk states may be damaged as well.
            if since_ns is None or until_ns is None or not earliest <= since_ns <= until_ns <= latest:
                since_ns, until_ns = self._last_ns, next_ns
            self.lost.append(Lost(since_ns, until_ns))
        self._open.clear()

    # ------------------------------------------------------------------ where records are

    def _read_summary(self) -> Summary | None:
        tail = self._read(max(0, self._size - _FOOTER_BYTES - len(MAGIC)), _FOOTER_BYTES + len(MAGIC))
        if len(tail) < _FOOTER_BYTES + len(MAGIC) or not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER:
            return None
        summary = Summary()
        footer = Footer.read(_stream(tail[PREFIX.size :]))
        if not footer.summary_start:
            return summary
        if footer.summary_start >= self._size:
            return None
        data = self._read(footer.summary_start, self._size - footer.summary_start)
        if footer.summary_crc not in (0, zlib.crc32(data[: -4 - len(MAGIC)])):
            return None
        try:
            for record in StreamReader(BytesIO(data), skip_magic=True).records:
                if isinstance(record, ChunkIndex):
                    summary.chunk_indexes.append(record)
                elif isinstance(record, Schema):
                    summary.schemas[record.id] = record
                elif isinstance(record, Channel):
                    summary.channels[record.id] = record
        except _ERRORS:
            return None
        return summary

    def _read(self, at: int, length: int) -> bytes:
        self._stream.seek(at)
        return self._stream.read(length)

    def _content(self, at: int) -> tuple[int, bytes]:
        """The opcode and the content that begin at `at`; raises `Damaged` where the file ends before."""
        prefix = self._read(at, PREFIX.size)
        if len(prefix) < PREFIX.size:
            raise Damaged
        opcode, length = PREFIX.unpack(prefix)
        if length > min(RECORD_BYTES_MAX, self._size - at - PREFIX.size):
            raise Damaged
        return opcode, self._stream.read(length)

    def _record(self, at: int) -> tuple[McapRecord, int]:
        """The sound record that begins at `at`, and where the next one begins; raises `Damaged`."""
        opcode, content = self._content(at)
        after = at + PREFIX.size + len(content)
        if opcode != Opcode.CHUNK and _mark_at_start(b"\x06" + PREFIX.pack(0, len(content))[1:] + content):
            opcode = Opcode.CHUNK  # only its opcode is damaged
        if opcode == Opcode.MESSAGE and self._last_ns is not None:
            raise Damaged  # a file with chunks has no messages between them
        record = parsed(opcode, content)
        if opcode in (Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT) and not self._may_begin(after):
            raise Damaged  # some of it is missing
        return record, after

    def _may_begin(self, at: int) -> bool:
        """Return True if the file ends at `at` or something like a record begins there."""
        if at >= self._size:
            return True
        try:
            parsed(*self._content(at))
        except Damaged:
            return False
        return True

    def _next(self, at: int) -> int | None:
        """Where the next chunk, metadata or end of the data begins, from `at` on."""
        while at < self._size:
            block = self._read(at, _BLOCK_BYTES + _MARK_BYTES)
            for begin in _marks(block):
                if begin < _BLOCK_BYTES and self._is_record(at + begin):
                    return at + begin
            at += _BLOCK_BYTES
        return None

    def _is_record(self, at: int) -> bool:
        try:
            self._record(at)
        except Damaged:
            return False
        return True


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of every record in an unpacked chunk; raises `Damaged` where one is not whole."""
    at = 0
    while at < len(data):
        if at + PREFIX.size > len(data):
            raise Damaged
        opcode, length = PREFIX.unpack_from(data, at)
        at += PREFIX.size
        if at + length > len(data):
            raise Damaged
        yield opcode, data[at : at + length]
        at += length


def unpacked(chunk: Chunk) -> bytes:
    """A chunk's records; raises `Damaged`."""
    if chunk.uncompressed_size > RECORD_BYTES_MAX:
        raise Damaged
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data: bytes = stream.read(length)
    except _ERRORS as error:
        raise Damaged from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("zstandard", "lz4", "zstd"):
            raise
        raise Damaged from error
    if not chunk.uncompressed_crc:
        for record in records_in(data):
            parsed(*record)
    return data


def parsed(opcode: int, content: bytes) -> McapRecord:
    """A record whose content has the length that it states; raises `Damaged`.

    A message index is returned without its entries.
    """
    try:
        if opcode == Opcode.MESSAGE_INDEX:
            channel, length = struct.unpack_from("<HI", content)
            if len(content) == 6 + length:
                return MessageIndex(channel, [])
        elif opcode == Opcode.MESSAGE:
            if len(content) >= 22 and next(_marks(content), None) is None:
                message: McapRecord = Message.read(_stream(content), len(content))
                return message
        elif opcode in _CLASSES:
            stream = _stream(content)
            record: McapRecord = _CLASSES[opcode].read(stream)
            crc = content[-4:] if isinstance(record, Attachment) else b""
            if crc.strip(b"\0") and crc != struct.pack("<I", zlib.crc32(content[:-4])):
                raise Damaged
            if stream.count == len(content):
                return record
    except _ERRORS as error:
        raise Damaged from error
    raise Damaged


def _marks(data: bytes) -> Iterator[int]:
    """Offsets in `data` of bytes that look like the beginning of a chunk, metadata or the end of the data."""
    for found in _MARK.finditer(data):
        begin = found.start()
        if found[0] == b"\x06":
            length, name = *struct.unpack_from("<Q", data, begin + 1), data[begin + 37]
            size = data[begin + 41 + name : begin + 49 + name]
            if len(size) < 8 or length != _CHUNK_BYTES + name + int.from_bytes(size, "little"):
                continue
        yield begin


def _mark_at_start(data: bytes) -> bool:
    return _MARK.match(data) is not None and next(_marks(data[:_MARK_BYTES]), None) == 0


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
