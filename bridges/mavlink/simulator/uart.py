"""A serial line in time: bytes go at its speed, ten bits each, and what is read at another speed is garbage
(PURE).
"""

from __future__ import annotations

from typing import Final

from handfast.agent.common.time import NS_PER_S

FRAME_BITS: Final = 10
"""A start bit, eight of data, a stop bit."""
HANDED_ON_NS: Final = 4_000_000
"""A receiver hands on what came in pieces of about so long, as the drivers of serial ports do."""


class Wire:
    """One direction of a line: what waits for it, in a buffer, and goes one byte after the other.

    Args:
        baud: bits per second.
        room: of the buffer, in bytes.

    Attributes:
        lost: how many messages did not fit.
    """

    def __init__(self, baud: int, room: int) -> None:
        self._baud, self._room = baud, room
        self._waiting = bytearray()
        self._begun_ns = 0
        self._gone = 0
        self.lost = 0

    def put(self, message: bytes, now_ns: int) -> None:
        """Adds the whole message, or loses it where there is no room."""
        if len(self._waiting) + len(message) > self._room:
            self.lost += 1
            return
        if not self._waiting:
            self._begun_ns, self._gone = now_ns, 0
        self._waiting += message

    def take(self, now_ns: int) -> bytes:
        """What has arrived at the far end since the last call."""
        arrived = (now_ns - self._begun_ns) * self._baud // (FRAME_BITS * NS_PER_S)
        count = min(max(0, arrived - self._gone), len(self._waiting))
        self._gone += count
        out = bytes(self._waiting[:count])
        del self._waiting[:count]
        return out

    @property
    def due_ns(self) -> int | None:
        """When the next piece has arrived; None: nothing is on its way."""
        if not self._waiting:
            return None
        piece = max(1, HANDED_ON_NS * self._baud // (FRAME_BITS * NS_PER_S))
        upto = self._gone + min(piece, len(self._waiting))
        return self._begun_ns - (-upto * FRAME_BITS * NS_PER_S // self._baud)

    def clear(self) -> None:
        """What waits is gone."""
        self._waiting.clear()


def misread(data: bytes, sent: int, read: int) -> bytes:
    """The bytes that a receiver at `read` baud finds in `data` sent at `sent` baud.

    It samples as a UART does: from the edge of a start bit, in the middle of what it takes for each bit. A
    stop bit that is none is not minded, as by a driver that is not asked to; the next start bit is looked for
    when the line has been at rest.
    """
    if sent == read:
        return data
    bits = [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
    step = sent / read
    out = bytearray()
    at = 0.0

    def level(place: float) -> int:
        return bits[int(place)] if place < len(bits) else 1

    while at < len(bits):
        if level(at):
            at = int(at) + 1.0
            continue
        out.append(sum(level(at + step * (1.5 + k)) << k for k in range(8)))
        at += step * (FRAME_BITS - 0.5)
        while not level(at):
            at = int(at) + 1.0
    return bytes(out)
