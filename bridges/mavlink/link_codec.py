"""pymavlink's parser and packer with what a bridge wants of them otherwise."""

from __future__ import annotations

from collections.abc import Collection
from hashlib import sha256
from hmac import compare_digest
from operator import attrgetter
from struct import Struct
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from bridges.mavlink.signing import Signing

STREAMS_MAX: Final = 64
NEW_STREAM_BEHIND: Final = 60 * 100_000
"""A stream of signed messages may begin a minute behind the own timestamp (10 us), no more."""
_BUFFER_KEPT: Final = 4096
_SIGNATURE: Final = 6
_V1: Final = 0xFE
_V2: Final = 0xFD
_HEADER: Final = Struct("<BBBBBBBHB")
_CRC: Final = 2


class _Plain:
    """How one kind of message without arrays is decoded and encoded."""

    __slots__ = ("crc", "fields", "number", "orders", "type", "unpacker")

    def __init__(self, kind: Any) -> None:
        self.type = kind
        self.unpacker: Struct = kind.unpacker
        self.orders: list[int] = kind.orders
        self.crc = bytes((kind.crc_extra,))
        self.number: int = kind.id
        self.fields = attrgetter(*kind.ordered_fieldnames)


_OFTEN_SENT: Final = (
    dialect.MAVLink_set_position_target_local_ned_message,
    dialect.MAVLink_timesync_message,
    dialect.MAVLink_heartbeat_message,
)


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
        # What has no arrays is decoded without more ado.
        self._plain = {
            number: _Plain(kind)
            for number, kind in dialect.mavlink_map.items()
            if number in self._wanted and not any(kind.array_lengths)
        }
        self._sent = {kind: _Plain(kind) for kind in _OFTEN_SENT}
        if signing is not None:
            self.signing.secret_key = signing.key
            self.signing.link_id = signing.link_id
            self.signing.sign_outgoing = True
            self.signing.timestamp = signing.timestamps.latest  # older streams are refused from the start
            # What is not signed is refused, and counted by being asked about.
            self.signing.allow_unsigned_callback = lambda _codec, _message: False

    def parse(self, data: bytes) -> list[Any]:
        """The messages that `data` completes, bad ones as pymavlink's BAD_DATA."""
        if self.signing.secret_key is not None or self.buf:
            return self._parse(data)
        messages: list[Any] = []
        at = self._whole(data, messages)
        if at < len(data):
            messages += self._parse(data[at:])
        return messages

    def _whole(self, data: bytes, messages: list[Any]) -> int:
        """Adds the messages at the beginning of `data` that are whole, good, unsigned and without arrays, as
        pymavlink would give them in three times the time. Where they end: the rest is for pymavlink.
        """
        at = 0
        while len(data) >= at + _HEADER.size:
            magic, size, signed, flags, sequence, system, component, low, high = _HEADER.unpack_from(data, at)
            kind = self._plain.get(low | high << 16)
            begin = at + _HEADER.size
            end = begin + size
            if magic != _V2 or signed or kind is None or len(data) < end + _CRC:
                break
            checksum = data[end] | data[end + 1] << 8
            if size > kind.unpacker.size or dialect.x25crc(data[at + 1 : end] + kind.crc).crc != checksum:
                break
            # Zeros at the end of a message are not sent.
            values = kind.unpacker.unpack(data[begin:end].ljust(kind.unpacker.size, b"\0"))
            message = kind.type(*map(values.__getitem__, kind.orders))
            message._header = dialect.MAVLink_header(kind.number, 0, flags, size, sequence, system, component)
            messages.append(message)
            at = end + _CRC
        return at

    def _parse(self, data: bytes) -> list[Any]:
        messages: list[Any] = self.parse_buffer(data) or []
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
        kind = None if self.signing.sign_outgoing else self._sent.get(type(message))
        if kind is None:
            data: bytes = message.pack(self)
        else:
            # As pymavlink does it, in a third of its time.
            payload = kind.unpacker.pack(*kind.fields(message))
            payload = payload.rstrip(b"\0") or payload[:1]
            number = kind.number & 0xFFFF, kind.number >> 16
            sender = self.srcSystem, self.srcComponent
            data = _HEADER.pack(_V2, len(payload), 0, 0, self.seq, *sender, *number) + payload
            data += dialect.x25crc(data[1:] + kind.crc).crc.to_bytes(_CRC, "little")
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

