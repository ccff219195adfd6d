"""Recorded fates of messages as text, so that a scenario can give them again (PURE).

A link's fates are one number a message in the order of sequence numbers: the delay after the stamp (us),
`LOST`, or `UNTOUCHED` where no rule had anything to do with it. The text is the base64 of the zlib-compressed
int32 numbers, the lowest byte first.
"""

from __future__ import annotations

import base64
import binascii
import sys
import zlib
from array import array
from collections.abc import Sequence
from typing import Final

LOST: Final = -1
"""The fate of a message that was lost."""
UNTOUCHED: Final = -2
"""The fate of a message that no rule concerned."""
DELAY_US_MAX: Final = 2**31 - 1
"""35 minutes, which int32 holds; a message that comes later is of no use to anybody."""
FATES_MAX: Final = 10_000_000
"""Messages of one link in one text: 55 hours at 50 Hz."""
_BYTES: Final = 4


def encode_fates(fates: Sequence[int]) -> str:
    """The text of fates.

    Raises:
        ValueError: there is none, more than `FATES_MAX`, or one that is neither a delay up to
            `DELAY_US_MAX` nor `LOST` nor `UNTOUCHED`.
    """
    if not 0 < len(fates) <= FATES_MAX:
        raise ValueError(f"must be 1 to {FATES_MAX} fates, got {len(fates)}")
    if min(fates) < UNTOUCHED or max(fates) > DELAY_US_MAX:
        wrong = next(fate for fate in fates if not UNTOUCHED <= fate <= DELAY_US_MAX)
        raise ValueError(
            f"must be delays in us up to {DELAY_US_MAX}, {LOST} for lost or {UNTOUCHED} for untouched; "
            f"got {wrong}"
        )
    packed = zlib.compress(_lowest_first(array("i", fates)).tobytes(), 9)
    return base64.b64encode(packed).decode("ascii")


def decode_fates(text: str) -> array[int]:
    """The fates in a text that `encode_fates` wrote.

    Raises:
        ValueError: anything else, with what is wrong with it.
    """
    wrong = "must be fates as `handfast faults replay` writes them"
    try:
        packed = base64.b64decode(text.encode("ascii"), validate=True)
    except (UnicodeEncodeError, binascii.Error):
        raise ValueError(f"{wrong}: this is not base64") from None
    reader = zlib.decompressobj()
    try:
        data = reader.decompress(packed, _BYTES * FATES_MAX + 1)
    except zlib.error:
        raise ValueError(f"{wrong}: the text is damaged (zlib cannot unpack it)") from None
    if len(data) > _BYTES * FATES_MAX:
        raise ValueError(f"{wrong}: there are more than {FATES_MAX} of them")
    if not reader.eof or reader.unused_data:
        raise ValueError(f"{wrong}: the text is cut short, or goes on after its end")
    if not data or len(data) % _BYTES:
        raise ValueError(f"{wrong}: {len(data)} bytes are not whole numbers of {_BYTES} bytes, at least one")
    fates = array("i")
    fates.frombytes(data)
    fates = _lowest_first(fates)
    if min(fates) < UNTOUCHED:
        raise ValueError(f"{wrong}: {min(fates)} is neither a delay in us nor {LOST} nor {UNTOUCHED}")
    return fates


def _lowest_first(numbers: array[int]) -> array[int]:
    """`numbers` with the lowest byte first, to write them, or from such bytes to numbers."""
    assert numbers.itemsize == _BYTES
    if sys.byteorder == "big":
        numbers = numbers[:]
        numbers.byteswap()
    return numbers
