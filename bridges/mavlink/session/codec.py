"""A MAVLink 2 codec: pymavlink's parser and packer, skipping unwanted messages, strict about signatures.

Whole unsigned frames are read the short way (`bridges.mavlink.session.whole_frames`)."""

from __future__ import annotations

from collections.abc import Collection
from hashlib import sha256
from hmac import compare_digest
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.bridges.mavlink.session.signing import STEPS_PER_S, Signing
from handfast.bridges.mavlink.session.whole_frames import WholeFrames

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
