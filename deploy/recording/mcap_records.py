"""The records of an MCAP file, past what is damaged in it.

A chunk whose content does not fit its checksum is left out. Where no record begins that makes sense, the next
one is searched for: a chunk, metadata, or the end of the data. What the chunks held that are lost is known
from the index at the end of the file, where there is one, else from the chunks before and after them.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import IO, Any, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Footer, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from deploy.recording.mcap_writer import MAGIC, PREFIX

RECORD_BYTES_MAX: Final = 1 << 30
_FOOTER_BYTES: Final = PREFIX.size + 20
_CHUNK_BYTES: Final = 40
"""A chunk's record without its data and the name of the compression."""
_BLOCK_BYTES: Final = 1 << 20
_MARK_BYTES: Final = 80
_MARK: Final = re.compile(
    rb"\x06(?=.{36}(?:\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd))"
    rb"|\x0c(?=.{8}.\0\0\0handfast\.)"
    rb"|\x0f(?=\x04\0\0\0\0\0\0\0)",
    re.DOTALL,
)
"""How a chunk, metadata of ours and the end of the data begin; what follows may be another beginning."""
_PARSERS: Final[Mapping[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}
_WITHOUT_MESSAGES: Final = (*_PARSERS, Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX, Opcode.DATA_END)
_PRIVATE: Final = 0x80
"""From here on opcodes are anybody's."""


class Damaged(Exception):
    """What was read makes no sense."""


class Lost(NamedTuple):
    """A part of the file that is lost: when the first of its messages came (ns), and when the last one.

    None where nothing is known of that: it is at the beginning, or at the end.
    """

    since_ns: int | None
    until_ns: int | None


class Records:
    """The records of a file up to its end, or as far as it goes.

    Args:
        stream: of the file, at its beginning.

    Attributes:
        damaged: whether anything has been left out until now.
        lost: the messages that were, once all has been read.
        ends: whether all of its data was read, to their end.
        is_whole: whether what follows the data is all there, too.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._size = stream.seek(0, 2)
        self.lost: list[Lost] = []
        self.damaged = self.ends = self.is_whole = False
        self._open: list[tuple[int, int, Lost]] = []
        """Damaged parts after which no sound chunk has come yet: from where to where, and what they held."""
        self._last_ns: int | None = None
        self._summary: _Summary | None = None

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """(opcode, content) of every sound record of the data; of a chunk its records, decompressed."""
        at: int | None = 0
        if self._read(0, len(MAGIC)) == MAGIC:
            at = len(MAGIC)
        elif (at := self._next(0)) is not None:
            self._leave_out(0, at)
        while at is not None:
            try:
                opcode, content = self._record(at)
            except Damaged:
                at = self._past(at)
                continue
            after = at + PREFIX.size + len(content)
            if opcode == Opcode.CHUNK:
                chunk = Chunk.read(_stream(content))
                try:
                    data = _decompressed(chunk)
                except Damaged:
                    at = self._past_chunk(at, after, chunk)
                    continue
                self._settle(chunk.message_start_time)
                yield opcode, data
                self._last_ns = max(self._last_ns or 0, chunk.message_end_time)
            elif opcode == Opcode.DATA_END:
                self.ends, at = True, None
                self._settle(None)
                self._check_end(after)
                return
            elif opcode != Opcode.MESSAGE_INDEX:
                yield opcode, content
            at = after
        self._settle(None)
        # The chunks were all read or are named, though the end of the data is damaged.
        self.ends = self.summary.is_there

    def _past(self, at: int) -> int | None:
        """Leaves out what begins there, and gives where it goes on."""
        following = self._next(at + 1)
        prefix = self._read(at, PREFIX.size)
        if len(prefix) == PREFIX.size:
            opcode, length = PREFIX.unpack(prefix)
            end: int = at + PREFIX.size + length
            if opcode in _WITHOUT_MESSAGES and end <= (following or self._size) and self._is_record(end):
                self.damaged = True  # and no message is lost
                return end
        if following is not None or self.summary.is_there:
            self._leave_out(at, following or self._size)
        return following

    def _past_chunk(self, at: int, after: int, chunk: Chunk) -> int:
        """The same of a chunk whose content is damaged. Where some of it is missing, the next record begins
        before the end that it tells."""
        end = after if self._is_record(after) else self._next(at + 1) or after
        self.damaged = True
        self._open.append((at, end, Lost(chunk.message_start_time, chunk.message_end_time)))
        return end

    # ------------------------------------------------------------------ what is lost

    def _leave_out(self, begin: int, end: int) -> None:
        self.damaged = True
        self._open.append((begin, end, Lost(None, None)))

    def _settle(self, next_ns: int | None) -> None:
        """Works out what the damaged parts held before a sound chunk that begins with `next_ns`; None: before
        the end."""
        for begin, end, said in self._open:
            if self.summary.is_there:
                inside = [each for each in self.summary.chunks if begin <= each.chunk_start_offset < end]
                self.lost += [Lost(each.message_start_time, each.message_end_time) for each in inside]
                continue
            since_ns, until_ns = said
            # What a damaged chunk says of itself may be damaged as well.
            earliest, latest = self._last_ns or 0, 2**64 if next_ns is None else next_ns
            if since_ns is None or until_ns is None or not earliest <= since_ns <= until_ns <= latest:
                since_ns, until_ns = self._last_ns, next_ns
            self.lost.append(Lost(since_ns, until_ns))
        self._open.clear()

    @property
    def summary(self) -> _Summary:
        """What the end of the file says; nothing where that is damaged or missing."""
        if self._summary is None:
            self._summary = _Summary(self._end())
        return self._summary

    def _end(self) -> bytes:
        """The file's summary, b"" where it is not sound."""
        tail = self._read(max(0, self._size - _FOOTER_BYTES - len(MAGIC)), _FOOTER_BYTES + len(MAGIC))
        if len(tail) < _FOOTER_BYTES + len(MAGIC) or not tail.endswith(MAGIC):
            return b""
        if PREFIX.unpack_from(tail) != (Opcode.FOOTER, 20):
            return b""
        footer = Footer.read(ReadDataStream(BytesIO(tail[PREFIX.size : -len(MAGIC)])))
        begin, end = footer.summary_start, self._size - len(tail)
        if not len(MAGIC) <= begin < end:
            return b""
        summary = self._read(begin, end - begin)
        crc = zlib.crc32(summary + tail[: _FOOTER_BYTES - 4])
        return summary if footer.summary_crc in (0, crc) else b""

    def _check_end(self, at: int) -> None:
        """Follows the summary to the end of the file."""
        while len(prefix := self._read(at, PREFIX.size)) == PREFIX.size:
            opcode, length = PREFIX.unpack(prefix)
            at += PREFIX.size + length
            if at > self._size:
                return
            if opcode == Opcode.FOOTER:
                self.is_whole = self._read(at, len(MAGIC)) == MAGIC
                return

    # ------------------------------------------------------------------ where records are

    def _read(self, at: int, length: int) -> bytes:
        self._stream.seek(at)
        return self._stream.read(length)

    def _record(self, at: int) -> tuple[int, bytes]:
        """The opcode and content of the record that begins there; raises `Damaged`."""
        opcode, content = self._alone(at)
        after = at + PREFIX.size + len(content)
        if opcode in (Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT) and not self._may_begin(after):
            raise Damaged  # some of it is missing
        if opcode >= _PRIVATE and not self._is_record(after):
            raise Damaged  # anything may look like one
        return opcode, content

    def _alone(self, at: int) -> tuple[int, bytes]:
        """The same, whatever follows it."""
        prefix = self._read(at, PREFIX.size)
        if len(prefix) < PREFIX.size:
            raise Damaged
        opcode, length = PREFIX.unpack(prefix)
        if length > min(RECORD_BYTES_MAX, self._size - at - PREFIX.size):
            raise Damaged
        content = self._stream.read(length)
        if opcode != Opcode.CHUNK and _is_sound(Opcode.CHUNK, content):
            return Opcode.CHUNK, content  # nothing but its opcode is damaged
        if not _is_sound(opcode, content) or (opcode == Opcode.MESSAGE and self._last_ns is not None):
            raise Damaged  # nobody writes messages between chunks
        return opcode, content

    def _may_begin(self, at: int) -> bool:
        """Whether something begins there that looks like a record, or the file ends."""
        if at >= self._size:
            return True
        try:
            return self._alone(at)[0] < _PRIVATE or self._is_record(at)
        except Damaged:
            return False

    def _next(self, at: int) -> int | None:
        """Where the next chunk, metadata or the end of the data begins, from there on."""
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


class _Summary:
    """What the end of a file says of its chunks, and of its channels and their schemas.

    Attributes:
        is_there: whether it says anything.
        records: schemas and channels, as `Records` gives them.
    """

    def __init__(self, data: bytes) -> None:
        self.chunks: list[ChunkIndex] = []
        self.records: list[tuple[int, bytes]] = []
        try:
            for opcode, content in records_in(data):
                if opcode == Opcode.CHUNK_INDEX:
                    self.chunks.append(ChunkIndex.read(ReadDataStream(BytesIO(content))))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self.records.append((opcode, content))
        except (Damaged, McapError, ValueError, struct.error):
            self.chunks, self.records = [], []
        self.is_there = bool(self.chunks)


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of every record in a chunk or a summary; raises `Damaged` where one is not whole."""
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


def _marks(data: bytes) -> Iterator[int]:
    """Where in it something begins by which one may go on."""
    for found in _MARK.finditer(data):
        begin = found.start()
        if found[0] == b"\x06":
            length, name = *struct.unpack_from("<Q", data, begin + 1), data[begin + 37]
            size = data[begin + 41 + name : begin + 49 + name]
            if len(size) < 8 or length != _CHUNK_BYTES + name + int.from_bytes(size, "little"):
                continue
        yield begin


def _holds_mark(content: bytes) -> bool:
    """Whether a record goes on over one by which one may go on: its length is damaged."""
    return next(_marks(content), None) is not None


def _is_sound(opcode: int, content: bytes) -> bool:
    """Whether a record's length, as it says it, fits its content: a length that is damaged would have chunks
    skipped."""
    length = len(content)
    try:
        if opcode == Opcode.CHUNK:
            (name,) = struct.unpack_from("<I", content, 28)
            (data,) = struct.unpack_from("<Q", content, 32 + name)
            return length == _CHUNK_BYTES + int(name) + int(data)
        if opcode == Opcode.MESSAGE_INDEX:
            return bool(length == 6 + struct.unpack_from("<I", content, 2)[0])
        if opcode == Opcode.DATA_END:
            return length == 4
        if opcode == Opcode.ATTACHMENT:
            (crc,) = struct.unpack_from("<I", content, length - 4)
            return crc in (0, zlib.crc32(content[:-4])) and Attachment.read(_stream(content)) is not None
        if opcode == Opcode.MESSAGE:
            return length >= 22 and not _holds_mark(content)
        parser = _PARSERS.get(opcode)
        if parser is not None:
            stream = _stream(content)
            parser.read(stream)
            if stream.count != length:
                return False
        elif opcode < _PRIVATE:
            return False
    except (McapError, ValueError, struct.error, OverflowError, MemoryError):
        return False
    return not _holds_mark(content)


def _decompressed(chunk: Chunk) -> bytes:
    """A chunk's records; raises `Damaged`."""
    if chunk.uncompressed_size > RECORD_BYTES_MAX:
        raise Damaged
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data: bytes = stream.read(length)
    # The decompressors and the parser of damaged records raise a dozen unrelated types.
    except (McapError, ValueError, struct.error, RuntimeError, MemoryError, OverflowError) as error:
        raise Damaged from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("zstandard", "lz4", "zstd"):
            raise
        raise Damaged from error
    if not chunk.uncompressed_crc and not all(_is_sound(*record) for record in records_in(data)):
        raise Damaged
    return data


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
