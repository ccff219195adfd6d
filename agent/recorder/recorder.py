"""Makes blocks of what a robot says, and writes them to the disk of its computer.

No clock, no bus: the process around it has both. What the disk does not take is counted, and the block
after it says how much is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from pathlib import Path
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.recorder.segment_folder import SegmentFolder
from handfast.agent.recorder.segments import (
    KNOWN,
    ORDERS,
    OVERFLOW,
    About,
    Received,
    Segment,
    about_block,
    message_block,
)

BLOCK_NS: Final = 9 * NS_PER_S // 10
"""A block holds so much: with waking and writing, what a power loss costs is about a second."""
BLOCK_BYTES: Final = 1 << 20
"""Or so many bytes, if that is less: a flood on the bus takes no memory."""
KNOWN_BYTES: Final = 1 << 18
"""So much of the newest orders stands in every segment: the one that had them first may be gone."""
RETRY_NS: Final = 5 * NS_PER_S
"""How long a disk that took nothing is left alone."""
AGAIN: Final = f"tried again every {RETRY_NS // NS_PER_S} s"


def order_keys(fleet: str, robot: int) -> frozenset[str]:
    """Keys on which a recorder may hear orders."""
    return frozenset(
        {
            key_expressions.mission(fleet),
            key_expressions.stop(fleet),
            key_expressions.resume(fleet),
            key_expressions.relayed(fleet, robot),
        }
    )


def known_orders(path: Path, orders: Container[str]) -> Iterator[Received]:
    """The orders in a segment, as they were received.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as stream:
        segment = Segment(stream)
        for block in segment.blocks():
            if block.kind == KNOWN or block.flags & ORDERS:
                yield from (each for each in segment.messages(block) if each[1] in orders)


class RobotRecorder:
    """Records one robot.

    Args:
        folder: where to.
        about: whose the segments are; their numbers and times are filled in.
        orders: keys of orders.
        known: orders that were received before.
        log: writes one line of the process's log.

    Attributes:
        lost: messages that the disk did not take since it last took some.
    """

    def __init__(
        self,
        folder: SegmentFolder,
        about: About,
        orders: Container[str],
        known: Iterable[Received],
        log: Callable[[str], None],
    ) -> None:
        self._folder, self._about, self._orders, self._log = folder, about, orders, log
        self._received: list[Received] = []
        self._bytes = 0
        self._flags = 0
        self._begun_ns = 0
        self._retry_ns: int | None = None
        """When the disk is tried again; None while it takes what it is given."""
        self.lost = 0
        self._known: dict[tuple[str, bytes], int] = {}
        """When orders came, those that came last at the end."""
        self._known_bytes = 0
        for received in known:
            self._know(*received)

    def add(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message that was received at `now_ns` (wall clock)."""
        if not self._received:
            self._begun_ns = now_ns
        self._received.append((now_ns, key, payload))
        self._bytes += len(key) + len(payload)
        if key in self._orders:
            self._flags |= ORDERS
            self._know(now_ns, key, payload)
        if self._bytes >= BLOCK_BYTES:
            self.flush(now_ns)

    def _know(self, now_ns: int, key: str, payload: bytes) -> None:
        if (key, payload) in self._known:
            return
        self._known[key, payload] = now_ns
        self._known_bytes += len(key) + len(payload)
        while self._known_bytes > KNOWN_BYTES:
            oldest = next(iter(self._known))
            del self._known[oldest]
            self._known_bytes -= sum(map(len, oldest))

    def overflow(self) -> None:
        """Notes that messages were lost before they were added."""
        self._flags |= OVERFLOW

    def lose(self, count: int) -> None:
        """Counts messages that were given up before they were added: the disk was too slow."""
        if self._retry_ns is None:  # else it is logged when the disk takes some again
            self._log(f"the disk was too slow: {count} messages were not kept")
        self.lost += count

    def flush_if_due(self, now_ns: int) -> None:
        """Puts on the disk what has waited for long enough."""
        if self._received and now_ns - self._begun_ns >= BLOCK_NS:
            self.flush(now_ns)

    def flush(self, now_ns: int) -> None:
        """Puts on the disk what waits; what it does not take is lost.

        Raises:
            FileNotFoundError: the folder is gone: only another start makes it again.
        """
        received, flags = self._received, self._flags
        if not received:
            return
        self._received, self._bytes = [], 0
        if self._retry_ns is not None and now_ns < self._retry_ns:
            self.lost += len(received)
            return
        block = message_block(received, flags=flags, lost=self.lost)
        try:
            self._folder.append(block, lambda number: self._first(number, received[0][0]))
        except FileNotFoundError:
            raise
        except OSError as error:
            self._failed(now_ns, error)
            self.lost += len(received)
            return
        self._flags = 0
        if self._retry_ns is not None:
            self._log(f"recording again; {self.lost} messages were not kept")
        self._retry_ns, self.lost = None, 0

    def set_clock(self, by_s: float) -> None:
        """Begins a segment, as the wall clock was set by `by_s` s. Call `flush` before."""
        self._folder.end_segment()
        if self._retry_ns is not None:
            self._retry_ns = 0
        self._log(f"this computer's clock was set by {by_s:+.3f} s")

    def _first(self, number: int, begun_ns: int) -> bytes:
        head = about_block(self._about._replace(number=number, begun_ns=begun_ns))
        known = sorted((at_ns, key, payload) for (key, payload), at_ns in self._known.items())
        return head + message_block(known, kind=KNOWN) if known else head

    def _failed(self, now_ns: int, error: OSError) -> None:
        if self._retry_ns is None:  # said once
            why = error.strerror or type(error).__name__
            self._log(f"not recording: {self._folder.path} takes no more ({why}); {AGAIN}")
        self._retry_ns = now_ns + RETRY_NS
