"""A MAVLink 2 codec: pymavlink's parser and packer, skipping unwanted messages, strict about signatures.

Nearly all datagrams of a vehicle, some 70 a second, are whole unsigned frames of types without arrays.
`WholeFrames` reads those with pymavlink's own tables, in a fifth of the time of its parser, which takes
everything else: half frames, MAVLink 1, signatures, texts, noise.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Collection
from hashlib import sha256
from hmac import compare_digest
from struct import Struct
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.bridges.mavlink.session.identity import STEPS_PER_S, Signing

_V2: Final = 0xFD
_HEADER: Final = 10
_CHECKSUM: Final = 2
_numbers = Struct("<xBBBBBBHB").unpack_from
_checksum = Struct("<H").unpack_from


class Header(NamedTuple):
    """What is used of pymavlink's MAVLink_header."""

    msgId: int
    srcSystem: int
    srcComponent: int
    incompat_flags: int = 0


class _Type(NamedTuple):
    size: int
    unpack: Callable[[bytes], tuple[int | float, ...]]
    crc_extra: bytes
    make: Callable[..., Any]


class _Message:
    """As pymavlink's MAVLink_message has it."""

    __slots__ = ()
    header: Header

    def get_header(self) -> Header:
        return self.header

    def get_msgId(self) -> int:
        return self.header.msgId


class WholeFrames:
    """Takes the frames of such types.

    Args:
        wanted: numbers of messages; others are skipped before their checksum is reckoned.
    """

    def __init__(self, wanted: Collection[int]) -> None:
        self._wanted = frozenset(wanted)
        self._types = {number: _type(number) for number in wanted if not _has_arrays(number)}

    def take(self, data: bytes) -> tuple[list[Any], int]:
        """The messages that it begins with, and how many bytes they are: up to what is for pymavlink."""
        messages: list[Any] = []
        at, length = 0, len(data)
        while length - at >= _HEADER + _CHECKSUM and data[at] == _V2:
            size, incompatible, _, _, system, component, low, high = _numbers(data, at)
            end = at + _HEADER + size + _CHECKSUM
            if incompatible or end > length:
                break
            number = low | high << 16
            if number in self._wanted:
                known = self._types.get(number)
                if known is None:
                    break
                summed = dialect.x25crc(data[at + 1 : end - _CHECKSUM] + known.crc_extra).crc
                if summed != _checksum(data, end - _CHECKSUM)[0]:
                    break
                content = data[at + _HEADER : end - _CHECKSUM]
                if size < known.size:  # zeros at the end are not sent
                    content += bytes(known.size - size)
                header = Header(number, system, component)
                messages.append(known.make(header, *known.unpack(content[: known.size])))
            at = end
        return messages, at


def _has_arrays(number: int) -> bool:
    return any(dialect.mavlink_map[number].array_lengths)


def _type(number: int) -> _Type:
    found = dialect.mavlink_map[number]
    fields = namedtuple(found.msgname, ["header", *found.ordered_fieldnames])  # type: ignore[misc]
    make = type(found.msgname, (_Message, fields), {"__slots__": ()})
    return _Type(found.unpacker.size, found.unpacker.unpack, bytes([found.crc_extra]), make)


STREAMS_MAX: Final = 64
NEW_STREAM_BEHIND: Final = 60 * STEPS_PER_S
"""A stream of signed messages may begin a minute behind the own timestamp (10 us), no more."""
_BUFFER_KEPT: Final = 4096
_SIGNATURE: Final = 6
_V1: Final = 0xFE


class Codec(dialect.MAVLink):  # type: ignore[misc]  # pymavlink ships no types
    """MAVLink 2 out, 1 and 2 in. Messages outside `wanted` are skipped before their checksum is reckoned.

    A timestamp counts only after its signature was found right: pymavlink does it the other way round, and
    one forged message with a late timestamp would shut out the vehicle's own.
    """

    buf: bytearray
    buf_index: int
    seq: int

    def __init__(self, wanted: Collection[int], signing: Signing | None) -> None:
        super().__init__(None)
        self.robust_parsing = True
        self._wanted = frozenset(wanted)
        self._whole = WholeFrames(self._wanted)
        if signing is not None:
            self.signing.secret_key = signing.key
            self.signing.link_id = signing.link_id
            self.signing.sign_outgoing = True
            self.signing.timestamp = signing.timestamps.latest  # older streams are refused from the start
            # What is not signed is refused, and counted by being asked about.
            self.signing.allow_unsigned_callback = lambda _codec, _message: False

    def parse(self, data: bytes) -> list[Any]:
        """The messages that `data` completes, bad ones as pymavlink's BAD_DATA."""
        messages: list[Any] = []
        if self.signing.secret_key is None and self.buf_index >= len(self.buf):  # no half message waits
            messages, taken = self._whole.take(data)
            data = data[taken:]
        if data:
            messages += self.parse_buffer(data) or []
        if self.buf_index > _BUFFER_KEPT:  # pymavlink lets it grow until it happens to be empty
            del self.buf[: self.buf_index]
            self.buf_index = 0
        return messages

    def forget(self) -> None:
        """Half a message of a connection that is gone."""
        self.buf = bytearray()
        self.buf_index = 0
        self.expected_length = dialect.HEADER_LEN_V1 + 2

    def encoded(self, message: Any) -> bytes:
        """The bytes of a message, numbered and, with a key, signed."""
        data: bytes = message.pack(self)
        self.seq = (self.seq + 1) % 256
        return data

    def decode(self, msgbuf: bytearray) -> Any:
        if msgbuf[0] == _V1:
            number = msgbuf[5]
        else:
            number = int.from_bytes(msgbuf[7:10], "little")
        if number not in self._wanted:
            return dialect.MAVLink_unknown(number, msgbuf)
        return super().decode(msgbuf)

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        signing = self.signing
        expected = sha256(signing.secret_key + msgbuf[:-_SIGNATURE]).digest()[:_SIGNATURE]
        if not compare_digest(expected, bytes(msgbuf[-_SIGNATURE:])):
            return False
        stamp = int.from_bytes(msgbuf[-12:-6], "little")
        stream = (msgbuf[-13], srcSystem, srcComponent)
        last = signing.stream_timestamps.get(stream)
        if last is None:
            if stamp + NEW_STREAM_BEHIND < signing.timestamp or len(signing.stream_timestamps) >= STREAMS_MAX:
                return False
        elif stamp <= last:
            return False
        signing.stream_timestamps[stream] = stamp
        signing.timestamp = max(signing.timestamp, stamp)
        return True
