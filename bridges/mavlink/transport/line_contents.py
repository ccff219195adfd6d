"""What comes in on a serial line: MAVLink, of which version, or something else, and what that may be."""

from __future__ import annotations

import re
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport.port_diagnosis import CONSOLE, TO_DO

PATIENCE_NS: Final = 3 * NS_PER_S
"""Bytes may come for so long without a message among them."""
GOOD_NS: Final = NS_PER_S
"""After a message it is not looked for another for so long: it costs next to nothing when all is well."""
QUIET_NS: Final = 2 * NS_PER_S
BYTES_MIN: Final = 16
"""Fewer are no evidence."""
TEXT_SHARE: Final = 0.95
TEXT_SHOWN: Final = 40
KEPT: Final = 1024
_START: Final = re.compile(rb"[\xfd\xfe]")
_LONGEST: Final = 280
_V1, _V2 = 0xFE, 0xFD
_RADIO: Final = (dialect.MAVLINK_MSG_ID_RADIO, dialect.MAVLINK_MSG_ID_RADIO_STATUS)
_PROMPT: Final = re.compile(rb"login: ?|[Pp]assword: ?|Login incorrect|[$#] $")
_TEXT: Final = frozenset((*b"\t\r\n\x1b", *range(0x20, 0x7F)))
USUAL: Final = "57600, 115200 and 921600 are usual"


def first_message(data: bytes) -> tuple[int, int] | None:
    """Version (1 or 2) and id of the first MAVLink message in `data` with a good checksum; None: none."""
    for match in _START.finditer(data):
        at = match.start()
        head = 10 if data[at] == _V2 else 6
        if at + head > len(data):
            continue
        end = at + head + data[at + 1]
        number = int.from_bytes(data[at + 7 : at + 10], "little") if head == 10 else data[at + 5]
        kind = dialect.mavlink_map.get(number)
        if kind is None or end + 2 > len(data):
            continue
        crc = dialect.x25crc(data[at + 1 : end] + bytes([kind.crc_extra])).crc
        if crc == int.from_bytes(data[end : end + 2], "little"):
            return (2 if head == 10 else 1), number
    return None


class LineContents:
    """Takes what comes in at `baud`.

    Attributes:
        trouble: why it is of no use, "" when it is MAVLink, or nothing comes.
        note: what is odd though it is MAVLink, "" when nothing is.
    """

    def __init__(self, baud: int) -> None:
        self._baud = baud
        self._kept = b""
        self._good_ns = self._since_ns = self._last_ns = self._first_ns = -PATIENCE_NS
        self._bytes = 0
        self.trouble = self.note = ""

    def take(self, now_ns: int, data: bytes) -> None:
        """Bytes that came now."""
        if 0 <= now_ns - self._good_ns < GOOD_NS:
            return
        self.look(now_ns)
        self._last_ns = now_ns
        if not self._bytes:
            self._since_ns = now_ns
        self._bytes += len(data)
        searched = self._kept[-_LONGEST:] + data
        self._kept = (self._kept + data)[-KEPT:]
        found = first_message(searched)
        if found is not None:
            self._good(now_ns, *found)
        elif now_ns - self._since_ns >= PATIENCE_NS and self._bytes >= BYTES_MIN:
            self.trouble = self._what()

    def look(self, now_ns: int) -> None:
        """Time has passed: what came long ago says nothing of the line any more."""
        if self._bytes and now_ns - self._last_ns >= QUIET_NS:
            self._bytes, self._kept, self.trouble = 0, b"", ""

    def _good(self, now_ns: int, version: int, number: int) -> None:
        self._good_ns, self._bytes, self._kept, self.trouble = now_ns, 0, b"", ""
        if version == 2:
            self._first_ns, self.note = -PATIENCE_NS, ""
        elif number not in _RADIO:  # a radio's own may be of either version
            if self._first_ns < 0:
                self._first_ns = now_ns
            elif now_ns - self._first_ns >= PATIENCE_NS:
                self.note = (
                    f"it speaks MAVLink 1{TO_DO}SERIALx_PROTOCOL = 2 for the autopilot's port, and restart it"
                )

    def _what(self) -> str:
        kept = self._kept
        if sum(byte in _TEXT for byte in kept) < TEXT_SHARE * len(kept):
            return (
                f"bytes come at {self._baud} baud, but no MAVLink: another speed?{TO_DO}give SERIALx_BAUD of "
                f"the autopilot's port and baud in the fleet file the same speed ({USUAL})"
            )
        lines = [line.strip() for line in kept.splitlines() if line.strip()]
        said = "".join(map(chr, lines[-1][:TEXT_SHOWN] if lines else b"")).replace("\x1b", "")
        if _PROMPT.search(kept):
            return (
                f"{CONSOLE}: it says {said!r}{TO_DO}end the login at its other end, or name the autopilot's "
                "port (Raspberry Pi: raspi-config, serial port, no login shell)"
            )
        if said.startswith("$G"):
            return f"a GPS is on it: it says {said!r}{TO_DO}name the autopilot's port"
        return (
            f"text comes, no MAVLink: {said!r}{TO_DO}SERIALx_PROTOCOL = 2 for the autopilot's port, or name "
            "that: this may be a console"
        )
