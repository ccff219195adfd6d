"""Messages on the wire: their bytes.

A message is one MessagePack array ``[version, type, *fields]`` with the fields in
the order of the class, and after it the CRC-32 (IEEE 802.3, as zlib computes it) of the array's
bytes as a MessagePack uint32: the byte 0xce and 4 bytes, the highest first. Up to three flipped bits are
always found in a message of at most 91,607 bits (P. Koopman, "32-bit cyclic redundancy codes for Internet
applications", DSN 2002), which `BYTES_MAX` stays below, and so is any one burst of up to 32 bits.

`decode` never trusts its input: anything that is not exactly one known, well-typed, finite message
of at most `BYTES_MAX` raises `Malformed`, whose `reason` is one of `REASONS`, so that a receiver can
drop it and count it by reason.
"""

from __future__ import annotations

from struct import Struct
from typing import Any, Final
from zlib import crc32

import msgpack

from agent.messages.types import (
    BYTES_MAX,
    DEGREE_MAX,
    FLOAT_MAX,
    MISSION_BYTES_MAX,
    ROBOT_MAX,
    RULES_MAX,
    TEXT_MAX,
    TIME_NS_MAX,
    Beacon,
    Faults,
    HandState,
    Message,
    Mission,
    PlantState,
    Wrench,
)
from agent.messages.validation import (
    CLASSES,
    FIELD_TYPES,
    FLOATS,
    TYPE_OF,
    Malformed,
    are_pairs,
    are_versions,
    checked,
    shown,
)

VERSION: Final = 6
"""Version of the protocol, the first field of every message."""
_HEAD: Final = 2  # version and type come before the fields
# The messages of every tick, by the types on the wire: number of the class, its floats, the class.
_FREQUENT: Final = {
    (int, int, *FIELD_TYPES[number]): (
        number,
        slice(FLOATS[number].start + _HEAD, FLOATS[number].stop + _HEAD),
        CLASSES[number],
    )
    for number in map(CLASSES.index, (HandState, PlantState, Wrench, Beacon))
}
_HAND_STATE: Final = TYPE_OF[HandState]
_BEACON: Final = TYPE_OF[Beacon]
_STATUS_VALUES_MAX: Final = 2048
# A valid message of these kinds begins with these three bytes; only such a one may be long, in all or a text.
_FAULTS_HEAD: Final = bytes([0x90 | _HEAD + len(Faults._fields), VERSION, TYPE_OF[Faults]])
_MISSION_HEAD: Final = bytes([0x90 | _HEAD + len(Mission._fields), VERSION, TYPE_OF[Mission]])

_pack = msgpack.Packer(use_bin_type=True, autoreset=True).pack
_checksum = Struct(">BI").pack
_UINT32: Final = 0xCE
_CHECKSUM_BYTES: Final = 5


def newer(mission: Mission, known: Mission | None) -> bool:
    """Whether `mission` holds instead of `known`: by its version, and of equal ones by its content, so that
    of two operators' missions the same one wins everywhere."""
    if known is None:
        return True
    if mission.version != known.version:
        return mission.version > known.version
    return (tag(mission), _content(mission)) > (tag(known), _content(known))


def tag(mission: Mission) -> int:
    """A number that distinguishes missions of one version, by which `newer` puts them in order."""
    return crc32(_content(mission))


def _content(mission: Mission) -> bytes:
    return encode(mission._replace(time_ns=0))


def encode(message: Message) -> bytes:
    """The message's bytes. Does not check: what is sent was made here (see `Agent.tick`)."""
    packed: bytes = _pack((VERSION, TYPE_OF[type(message)], *message))
    return packed + _checksum(_UINT32, crc32(packed))


def decode(payload: bytes) -> Message:
    """The message in `payload`.

    Raises:
        Malformed: for anything but one valid message.
    """
    if len(payload) > BYTES_MAX:
        most = MISSION_BYTES_MAX if payload[:3] == _MISSION_HEAD else BYTES_MAX
        if len(payload) > most:
            raise Malformed("oversized", f"{len(payload)} bytes, at most {most} are accepted")
    packed = payload[:-_CHECKSUM_BYTES]
    if payload[-_CHECKSUM_BYTES:] != _checksum(_UINT32, crc32(packed)):
        raise _unchecked(payload)
    try:
        array = _unpacked(packed)
    except Exception as error:  # msgpack raises a dozen unrelated types; each means the same here
        raise Malformed("malformed", f"not one MessagePack array ({type(error).__name__})") from None
    # A valid message of the frequent kinds is through here; `_examine` takes all others and says why.
    if type(array) is tuple:
        frequent = _FREQUENT.get(tuple(map(type, array)))
        if frequent is not None:
            number, floats, cls = frequent
            if (
                array[0] == VERSION
                and array[1] == number
                and 0 < array[2] <= ROBOT_MAX
                and 0 <= array[3] < TIME_NS_MAX
                and 0 <= array[4] < TIME_NS_MAX
                and sum(map(abs, array[floats])) <= FLOAT_MAX  # false for NaN and infinities, too
                and (number != _HAND_STATE or _plain_hand(array))
                and (number != _BEACON or (not array[-1] and array[10] >= 0.0 and are_versions(array[-5:-1])))
            ):
                message: Message = tuple.__new__(cls, array[_HEAD:])
                return message
    return _examine(array)


def _plain_hand(array: tuple[Any, ...]) -> bool:
    return 0 <= array[6] <= DEGREE_MAX and array[-3] >= 0.0 and are_pairs(array[-2], array[-1])


def _unpacked(packed: bytes) -> Any:
    text_max = RULES_MAX if packed[: len(_FAULTS_HEAD)] == _FAULTS_HEAD else TEXT_MAX
    return msgpack.unpackb(packed, use_list=False, max_array_len=_STATUS_VALUES_MAX, max_str_len=text_max)


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


def _examine(array: Any) -> Message:
    """The message in what was unpacked, or `Malformed` with the first thing that is wrong with it."""
    if type(array) is not tuple or len(array) < 3:
        raise Malformed("malformed", "not a MessagePack array [version, type, *fields]")
    version, number, fields = array[0], array[1], array[_HEAD:]
    if type(version) is not int or version != VERSION:
        raise _other_version(version)
    if type(number) is not int or not 0 <= number < len(CLASSES):
        raise Malformed("type", f"message type {shown(number)} is not known")
    return checked(number, fields)
