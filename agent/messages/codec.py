"""Messages on the wire: their bytes.

A message is one MessagePack array ``[version, type, *fields]`` with the fields in
the order of the class, and after it the CRC-32 (IEEE 802.3, as zlib computes it) of the array's
bytes as a MessagePack uint32: the byte 0xce and 4 bytes, the highest first. Up to three flipped bits are
always found in a message of at most 91,607 bits (P. Koopman, "32-bit cyclic redundancy codes for Internet
applications", DSN 2002), which `BYTES_MAX` stays below, and so is any one burst of up to 32 bits.

`decode` never trusts its input: anything that is not exactly one known, well-typed, finite message
of at most `BYTES_MAX` raises `Malformed`, whose `reason` is one of `REASONS`, so that a receiver can
drop it and count it by reason.

Versions of orders, on which all robots have to agree, are here too.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from struct import Struct
from typing import Any, Final
from zlib import crc32

import msgpack

from handfast.agent.common.compiled import COMPILED
from handfast.agent.messages.fast_path import HEAD, Taker, omitted, taker
from handfast.agent.messages.types import (
    BYTES_MAX,
    CLASSES,
    MISSION_BYTES_MAX,
    RULES_MAX,
    TEXT_MAX,
    VERSION,
    Faults,
    Message,
    Mission,
    Resume,
    Stop,
)
from handfast.agent.messages.validation import Malformed, examined, shown

TYPE_OF: Final = {cls: number for number, cls in enumerate(CLASSES)}
_HEADS: Final[dict[type[Message], tuple[Any, ...]]] = {cls: (VERSION, TYPE_OF[cls]) for cls in CLASSES}
_FEWEST: Final = {cls: len(cls._fields) - len(rest) for cls in CLASSES if (rest := omitted(cls))}
_examined: Final = examined
_takers: Final[dict[int, Taker]] = {}
"""By the number of the class; each is made when the first of its messages comes, or by `be_ready`."""
COMPILED_FAST_PATH: Final = "handfast.agent.messages.compiled_fast_path"
"""Module that there is only where the rest is compiled."""
_STATUS_VALUES_MAX: Final = 2048


def head(cls: type[Message]) -> bytes:
    """How every message of a class without `About.omitted` fields begins."""
    array: bytes = msgpack.Packer().pack_array_header(HEAD + len(cls._fields))
    return array + bytes([VERSION, TYPE_OF[cls]])


# Only what begins like these may be long, in all or a text.
_FAULTS_HEAD: Final = head(Faults)
_MISSION_HEAD: Final = head(Mission)

LONG: Final = 512
KNOWN: Final = 4
"""A mission of so many bytes takes longer to read than to find among the last so many, and comes often:
operators and robots say the same bytes until all have it, and all robots of a process hear them."""

# Final, here: in C a name of a module that is none is looked up each time.
_pack: Final = msgpack.Packer(use_bin_type=True, autoreset=True).pack
_unpack: Final = msgpack.unpackb
_checksum: Final = Struct(">BI").pack
_crc32: Final = crc32
_UINT32: Final = 0xCE
_CHECKSUM_BYTES: Final = 5


Mark = tuple[int, int]
"""Which of a thing somebody has acknowledged: its version, and what tells those of one version apart."""


def newer(mission: Mission, known: Mission | None) -> bool:
    """Whether `mission` holds instead of `known`: by its version, and of equal ones by its content, so that
    of two operators' missions the same one wins everywhere."""
    if known is None:
        return True
    if mission is known:
        return False
    if mission.version != known.version:
        return mission.version > known.version
    return (tag(mission), _content(mission)) > (tag(known), _content(known))


def tag(mission: Mission) -> int:
    """A number that distinguishes missions of one version, by which `newer` puts them in order."""
    return crc32(_content(mission))


def mark_of(mission: Mission) -> Mark:
    """What tells a mission from every other one."""
    return mission.version, tag(mission)


@lru_cache(maxsize=KNOWN)
def _content(mission: Mission) -> bytes:
    return encode(mission._replace(time_ns=0))


def encode(message: Message) -> bytes:
    """The message's bytes. Does not check: what is sent was made here (see `Agent.tick`)."""
    cls = type(message)
    fewest = _FEWEST.get(cls)
    if fewest is None or message[-1]:
        packed: bytes = _pack(_HEADS[cls] + message)
    else:
        count = len(message) - 1
        while count > fewest and not message[count - 1]:
            count -= 1
        packed = _pack(_HEADS[cls] + message[:count])
    return packed + _checksum(_UINT32, _crc32(packed))


def decode(payload: bytes) -> Message:
    """The message in `payload`; that of a mission that is still known is the same object.

    Raises:
        Malformed: for anything but one valid message.
    """
    if len(payload) > LONG and payload.startswith(_MISSION_HEAD):
        return _known(payload)
    return _decoded(payload)


def _decoded(payload: bytes) -> Message:
    if len(payload) > BYTES_MAX:
        most = MISSION_BYTES_MAX if payload.startswith(_MISSION_HEAD) else BYTES_MAX
        if len(payload) > most:
            raise Malformed("oversized", f"{len(payload)} bytes, at most {most} are accepted")
    packed = payload[:-_CHECKSUM_BYTES]
    if payload[-_CHECKSUM_BYTES:] != _checksum(_UINT32, _crc32(packed)):
        raise _unchecked(payload)
    try:
        array = _unpacked(packed)
    except Exception as error:  # msgpack raises a dozen unrelated types; each means the same here
        raise Malformed("malformed", f"not one MessagePack array ({type(error).__name__})") from None
    if type(array) is not tuple or len(array) < HEAD + 1:
        raise Malformed("malformed", "not a MessagePack array [version, type, *fields]")
    version, number = array[0], array[1]
    if type(version) is not int or version != VERSION:
        raise _other_version(version)
    take = _takers.get(number) if type(number) is int else None
    if take is None:
        take = _taker(number)
    return take(array, _examined)


_known: Final = lru_cache(maxsize=KNOWN)(_decoded)


def be_ready() -> None:
    """Makes now what `decode` would make with the first message of each class: for all processes that are
    forked from this one, which would all do so in one tick of a drive that begins. It takes some 5 ms for a
    class."""
    for number in range(len(CLASSES)):
        _taker(number)


def _taker(number: Any) -> Taker:
    if type(number) is not int or not 0 <= number < len(CLASSES):
        raise Malformed("type", f"message type {shown(number)} is not known")
    if COMPILED:
        return _takers.setdefault(number, import_module(COMPILED_FAST_PATH).TAKERS[number])
    return _takers.setdefault(number, taker(CLASSES[number]))


def _unpacked(packed: bytes) -> Any:
    text_max = RULES_MAX if packed.startswith(_FAULTS_HEAD) else TEXT_MAX
    return _unpack(packed, use_list=False, max_array_len=_STATUS_VALUES_MAX, max_str_len=text_max)


def _unchecked(payload: bytes) -> Malformed:
    """Why a payload without its checksum is refused: version 1 had none."""
    try:
        array = _unpacked(payload)
    except Exception:  # whatever it is, it is no array of version 1
        array = None
    if type(array) is tuple and array and type(array[0]) is int and array[0] != VERSION:
        return _other_version(array[0])
    return Malformed("checksum", "the bytes are not those that were sent, or not of this protocol")


def _other_version(version: Any) -> Malformed:
    return Malformed("version", f"version {shown(version)}, this program speaks {VERSION}")


AHEAD_US_MAX: Final = 24 * 3600 * 1_000_000
"""Versions are us of operators' clocks, which differ by less than a day. A robot that tells of a later order
lies, and must not push versions so far that no order can have a greater one; nor must an operator whose clock
is wrong."""


def can_be(version: int, now_ns: int) -> bool:
    """Whether an order of that version can have been given by now, wall clock."""
    return version <= now_ns // 1_000 + AHEAD_US_MAX


def least_believed(version: int, now_ns: int) -> int:
    """The least version as which who hears a stop at `now_ns` or later takes it."""
    return version if can_be(version, now_ns) else now_ns // 1_000


def as_believed(order: Mission | Resume | Stop, now_ns: int) -> Mission | Resume | Stop | None:
    """An order as who hears it at `now_ns`, wall clock, takes it: a stop that cannot have been given by now
    is one that is given now, anything else of the kind is none."""
    if can_be(order.version, now_ns):
        return order
    return order._replace(version=now_ns // 1_000) if isinstance(order, Stop) else None
