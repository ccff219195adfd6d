"""Writes what a robot says to the disk of its computer, as a sequence of MCAP files.

No clock and no bus: the process around it has both. Messages that the disk does not take leave a gap. Besides
its messages a file holds, as metadata, the fleet and robot (`RUN_METADATA`) and orders as they were received
(`ORDER_METADATA`).
"""

from __future__ import annotations

import binascii
from collections.abc import Callable, Container, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple, Self

from mcap.records import Metadata
from mcap.stream_reader import StreamReader

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message
from handfast.agent.messages.validation import Malformed
from handfast.agent.recorder.folder import RecordingFolder
from handfast.agent.recorder.message_file import MessageFile
from handfast.agent.security.sealed_order import Forged, unverified

FLUSH_NS: Final = 9 * NS_PER_S // 10
"""Longest time for which messages wait in memory; with waking and writing, a power loss costs a second."""
FLUSH_BYTES: Final = 1 << 20
"""Maximum size of the messages that wait in memory."""
KNOWN_BYTES: Final = 1 << 18
"""Maximum size of the earlier orders that every file repeats: older files are deleted."""
WAITING_BYTES: Final = 16_000_000
"""Maximum size of the messages that wait while the disk stalls: more than a minute of one robot."""
RETRY_NS: Final = 5 * NS_PER_S
"""Time for which the recorder does not write to a disk that failed."""
AGAIN: Final = f"tried again every {RETRY_NS // NS_PER_S} s"
ORDER_METADATA: Final = "handfast.order"
"""An order as it was received, with the operator's seal: its key, time of reception, bytes (base64)."""

Received = tuple[int, str, bytes]
"""One message: time of reception (wall clock, ns), key, payload."""


class About(NamedTuple):
    """The fleet and robot of a recording: the fleet's name, the digest and text of its file, the robot's id,
    and the version of handfast."""

    fleet: str
    digest: str
    robot: int
    version: str
    fleet_toml: str


def order_keys(fleet: str, robot: int) -> frozenset[str]:
    """Keys on which a recorder may receive orders."""
    return frozenset(
        {
            key_expressions.mission(fleet),
            key_expressions.stop(fleet),
            key_expressions.resume(fleet),
            key_expressions.relayed(fleet, robot),
        }
    )


def order_of(metadata: Mapping[str, str]) -> Received:
    """The order in metadata of the name `ORDER_METADATA`; raises KeyError or ValueError where it is none."""
    payload = binascii.a2b_base64(metadata["payload"], strict_mode=True)
    return int(metadata["received_ns"]), metadata["key"], payload


def known_orders(path: Path, orders: Container[str]) -> list[Received]:
    """The orders in a file, up to where it is cut or damaged.

    Raises:
        OSError: the file cannot be opened.
    """
    found = []
    with open(path, "rb") as stream, suppress(Exception):  # the library raises many types for damage
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Metadata) and record.name == ORDER_METADATA:
                found.append(order_of(record.metadata))
    return [order for order in found if order[1] in orders]


def order_message(payload: bytes) -> Message:
    """The message in an order that may be sealed, whoever sealed it; raises `Malformed` or `Forged`."""
    try:
        return decode(payload)
    except Malformed:
        return decode(unverified(payload))


class RobotRecorder:
    """Records one robot. A context manager, whose end waits for the disk.

    A thread writes to the disk, so `add` and `flush` never wait for it.

    Args:
        folder: receives the files.
        about: fleet and robot of the recording.
        orders: keys of orders.
        known: orders that were received before.
        log: writes one line of the process's log.

    Attributes:
        lost: messages that the disk did not take since it last took some.
    """

    def __init__(
        self,
        folder: RecordingFolder,
        about: About,
        orders: Container[str],
        known: Iterable[Received],
        log: Callable[[str], None],
    ) -> None:
        self._folder, self._about, self._orders, self._log = folder, about, orders, log
        self._disk = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None
        self._written = 0
        """Number of the messages that are being written."""
        self._stream = BytesIO()
        """Contents of the newest file, small enough to be kept in memory."""
        self._taken = 0
        """Length of what has gone to the disk."""
        self._file: MessageFile | None = None
        self._count = self._bytes = self._begun_ns = 0
        """Messages that wait for the disk, their size, and the reception of the first."""
        self._retry_ns: int | None = None
        """Time at which the disk is tried again; None while it works."""
        self.lost = 0
        self._known: dict[tuple[str, bytes], int] = {}
        """Times at which orders were received, the newest last."""
        self._known_bytes = 0
        for received in known:
            self._know(*received)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._disk.shutdown()

    def add(self, now_ns: int, key: str, payload: bytes) -> None:
        """Add a message that was received at `now_ns` (wall clock)."""
        if not self._count:
            self._begun_ns = now_ns
        file = self._file or self._begin()
        self._count += 1
        self._bytes += len(key) + len(payload)
        is_order = key in self._orders
        if is_order and self._know(now_ns, key, payload):
            _write_order(file, now_ns, key, payload)
        try:
            message = order_message(payload) if is_order else decode(payload)
        except (Malformed, Forged):
            file.add_raw(now_ns, key, payload)
        else:
            file.add(now_ns, key, message)
        if self._bytes >= FLUSH_BYTES:
            self.flush(now_ns)  # a flood

    def _know(self, now_ns: int, key: str, payload: bytes) -> bool:
        """Remember an order; return True if it is new."""
        if (key, payload) in self._known:
            return False
        self._known[key, payload] = now_ns
        self._known_bytes += len(key) + len(payload)
        while self._known_bytes > KNOWN_BYTES:
            oldest = next(iter(self._known))
            del self._known[oldest]
            self._known_bytes -= sum(map(len, oldest))
        return True

    @property
    def is_idle(self) -> bool:
        """True if nothing is being written to the disk."""
        return self._writing is None or self._writing.done()

    def flush_if_due(self, now_ns: int) -> None:
        """Flush if messages have waited long enough."""
        if self._count and now_ns - self._begun_ns >= FLUSH_NS:
            self.flush(now_ns)

    def flush(self, now_ns: int, *, ends: bool = False) -> None:
        """Have all waiting messages written to the disk; those that it does not take are lost.

        While the disk is busy with earlier messages they go on waiting, up to `WAITING_BYTES`.

        Args:
            ends: the file ends after them.

        Raises:
            FileNotFoundError: the folder is gone. Only another start makes it again.
        """
        if not self.is_idle:
            if self._bytes > WAITING_BYTES:
                if self.lost == 0:
                    self._log("the disk is too slow: messages are not kept")
                self._drop()
            return
        self._settle(now_ns)
        if self._retry_ns is not None and now_ns < self._retry_ns:
            self._drop()
        if self._file is None:
            return
        self._file.flush()
        ends = ends or self._folder.is_full_with(self._stream.tell() - self._taken)
        if ends:
            self._file.finish()
            self._file = None
        begins, data = not self._taken, bytes(self._stream.getbuffer()[self._taken :])
        self._taken += len(data)
        self._written, self._count, self._bytes = self._count, 0, 0
        self._writing = self._disk.submit(self._folder.append, data, begins=begins, ends=ends)

    def _settle(self, now_ns: int) -> None:
        """Take the result of the last write, waiting for it."""
        writing, self._writing = self._writing, None
        if writing is None:
            return
        try:
            writing.result()
        except FileNotFoundError:
            raise
        except OSError as error:
            if self._retry_ns is None:  # logged once
                why = error.strerror or type(error).__name__
                self._log(f"not recording: {self._folder.path} takes no more ({why}); {AGAIN}")
            self._retry_ns = now_ns + RETRY_NS
            self.lost += self._written
            self._drop()
        else:
            if self.lost:
                self._log(f"recording again; {self.lost} messages were not kept")
            self._retry_ns, self.lost = None, 0

    def end_file(self, now_ns: int) -> None:
        """Have all waiting messages written and the file completed; wait for it."""
        self._settle(now_ns)
        self.flush(now_ns, ends=True)
        self._settle(now_ns)

    def set_clock(self, now_ns: int, by_s: float) -> None:
        """Begin another file, as the wall clock was set by `by_s` s."""
        self.end_file(now_ns)
        if self._retry_ns is not None:
            self._retry_ns = 0
        self._log(f"this computer's clock was set by {by_s:+.3f} s")

    def _begin(self) -> MessageFile:
        about = self._about
        run = {"version": about.version, "fleet": about.fleet, "mode": "run", "robot": str(about.robot)}
        self._stream, self._taken = BytesIO(), 0
        self._file = MessageFile(self._stream, run | {"digest": about.digest}, about.fleet_toml)
        for (key, payload), at_ns in self._known.items():
            _write_order(self._file, at_ns, key, payload)
        return self._file

    def _drop(self) -> None:
        """Lose all waiting messages, and begin another file."""
        self.lost += self._count
        self._count = self._bytes = 0
        self._file = None


def _write_order(file: MessageFile, at_ns: int, key: str, payload: bytes) -> None:
    text = binascii.b2a_base64(payload, newline=False).decode()
    file.add_metadata(ORDER_METADATA, {"key": key, "received_ns": str(at_ns), "payload": text})
