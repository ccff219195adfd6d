"""The wire's outer form, written once more for the tests: an array, and its CRC-32 as a uint32."""

from __future__ import annotations

import struct
import zlib


def sealed(packed: bytes) -> bytes:
    """`packed` as a payload: with its checksum."""
    return packed + b"\xce" + struct.pack(">I", zlib.crc32(packed))


def opened(payload: bytes) -> bytes:
    """What `sealed` was given."""
    assert payload == sealed(payload[:-5])
    return payload[:-5]
