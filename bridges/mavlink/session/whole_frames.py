"""The messages of bytes that are whole frames of MAVLink 2, unsigned, of types without arrays (PURE).

That is what nearly all datagrams of a vehicle are, some 70 a second. They are read here with pymavlink's own
tables, in a fifth of the time of its parser, which takes everything else: half frames, MAVLink 1, signatures,
texts, noise.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Collection
from struct import Struct
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

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
