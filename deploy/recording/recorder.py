"""Writing a run to MCAP: every message as it arrived, in a file that stands on its own.

One channel per key and message class, JSON with a schema, so that Foxglove and every MCAP tool
reads it. The file holds the fleet file too (attachment) and what the run was (metadata). Nothing
here reads a clock: the same input gives the same bytes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import tomli_w
from mcap.writer import Writer

from handfast.agent.common.errors import Error
from handfast.agent.fleet.loading import law_name, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ingress import Decode
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import CLASSES, Message
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.recording.foxglove.channels import Channels
from handfast.deploy.recording.foxglove.schemas import SCHEMAS
from handfast.deploy.recording.message_json import schema, schema_name, to_json
from handfast.deploy.recording.run_files import FLEET_FILE, must_have_a_name

RUN_METADATA: Final = "handfast.run"
OUTCOME_METADATA: Final = "handfast.outcome"
RAW_ENCODING: Final = "application/octet-stream"

# A chunk is what a killed process loses at most: about a second of traffic, or this many bytes.
CHUNK_BYTES: Final = 256 * 1024
FLUSH_PERIOD_NS: Final = 1_000_000_000
# Garbage on made-up keys must not grow the file's tables without bound (MCAP has 2**16 channels).
CHANNELS_MAX: Final = 4096
_Kind = type[Message] | str | None
"""What a channel carries: a message class, the name of a derived channel's schema, or None for raw bytes."""
_TIME_MAX: Final = 2**64 - 1
_SEQUENCE_MASK: Final = 2**32 - 1  # MCAP's sequence has 32 bits
_SEQUENCES: Final = {
    cls: next((cls._fields.index(name) for name in ("sequence", "version") if name in cls._fields), None)
    for cls in CLASSES
}
"""Where each class has its sequence number, or what counts as one."""


class RecordingError(Error):
    """A recording that cannot be written or read; the text is one line naming the file."""


class Recorder:
    """Records the messages of one run to an MCAP file. A context manager: leaving it completes the file.

    Args:
        path: the file to write; an existing one is overwritten.
        fleet: what runs.
        mode: ``run`` or ``simulate``.
        fleet_toml: text of the resolved fleet file, kept as an attachment; written from `fleet` unless given.
        seed: seed of the run, that of the fleet unless given.

    Raises:
        RecordingError: when the file cannot be written (from the constructor, `record` or `close`).
            What was written before stays readable. `record` does nothing more after it failed once.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        fleet: Fleet,
        *,
        mode: str = "run",
        fleet_toml: str | None = None,
        seed: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.recorded = 0
        """Messages written, those that do not decode included."""
        self.rejected: Counter[str] = Counter()
        """Payloads that do not decode, by reason (`agent.messages.validation.REASONS`), and ``channels`` for
        those that were not kept because they came on too many different keys."""
        self._failed = False
        self._closed = False
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, _Kind], int] = {}
        self._flush_due_ns: int | None = None
        self._now_ns = 0
        self._derived = Channels(fleet)
        self._stream: IO[bytes] | None = None
        run = {
            "version": handfast_version(),
            "fleet": fleet.fleet.name,
            "law": law_name(fleet.control),
            "mode": mode,
            "seed": str(fleet.fleet.seed if seed is None else seed),
        }
        text = tomli_w.dumps(to_dict(fleet)) if fleet_toml is None else fleet_toml
        try:
            self._stream = open(self.path, "wb")  # noqa: SIM115 - closed by close()
            self._writer = Writer(self._stream, CHUNK_BYTES)
            self._writer.start(library="handfast")
            self._writer.add_metadata(RUN_METADATA, run)
            # Its own write: a file cut short still says what it was.
            self._writer.add_attachment(0, 0, FLEET_FILE, "application/toml", text.encode())
            self._stream.flush()
        except OSError as error:
            failure = self._error(error)
            self.close()
            raise failure from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RecordingError:
            if error is None:  # never hide the error that ended the run
                raise

    def record(self, received_ns: int, key: str, payload: bytes, read: Decode = decode) -> Message | None:
        """Write one payload as it came from the bus.

        received_ns: wall clock (or virtual time) of its reception. read: as `decode`, of who has read it
        already. Returns the decoded message, None for a payload that is not one: it is kept as raw bytes and
        counted.
        """
        try:
            message = read(payload)
        except Malformed as problem:
            self.rejected[problem.reason] += 1
            self._write(received_ns, key, None, payload, received_ns, 0)
            return None
        self.record_message(received_ns, key, message)
        return message

    def record_message(self, received_ns: int, key: str, message: Message) -> None:
        """Write one message that is decoded already (a simulation has it at hand)."""
        kind, place = type(message), _SEQUENCES[type(message)]
        values: tuple[Any, ...] = message
        sequence: int = 0 if place is None else values[place]
        self._write(received_ns, key, kind, to_json(message), message.time_ns, sequence)
        for topic, name, content in self._derived.feed(received_ns, key, message):
            self._write(received_ns, topic, name, content, received_ns, 0)

    def set_outcome(
        self, reasons: Sequence[str], *, interrupted: bool = False, warnings: Sequence[str] = ()
    ) -> None:
        """Keep what only the operator's side knows: why the verdict fails, such as a process that died, and
        what must not go unsaid, such as what is missing.

        A report that is rebuilt from the file finds them in `Recording.reasons` and `Recording.warnings`.
        """
        outcome = {"reasons": json.dumps(list(reasons)), "interrupted": json.dumps(interrupted)}
        if warnings:
            outcome["warnings"] = json.dumps(list(warnings))
        if self._failed or self._closed:
            return
        try:
            self._writer.add_metadata(OUTCOME_METADATA, outcome)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Complete the file. Does nothing the second time."""
        if self._closed or self._stream is None:
            return
        self._closed = True
        try:
            if not self._failed:
                self._writer.finish()
            self._stream.close()
        except OSError as error:
            # What the file holds is what can be saved; closing once more drops the buffer quietly.
            with suppress(OSError):
                self._stream.close()
            if not self._failed:
                raise self._error(error) from error

    def _write(
        self,
        received_ns: int,
        key: str,
        kind: _Kind,
        content: bytes,
        time_ns: int,
        sequence: int,
    ) -> None:
        if self._failed or self._closed:
            return
        channel = self._channels.get((key, kind))
        try:
            if channel is None:
                if len(self._channels) >= CHANNELS_MAX:
                    self.rejected["channels"] += 1
                    return
                channel = self._channel(key, kind)
            log_ns = min(max(received_ns, 0), _TIME_MAX)
            self._writer.add_message(channel, log_ns, content, time_ns, sequence & _SEQUENCE_MASK)
            if self._flush_due_ns is None:
                self._flush_due_ns = log_ns + FLUSH_PERIOD_NS
            elif log_ns >= self._flush_due_ns:
                self._flush_due_ns = log_ns + FLUSH_PERIOD_NS
                self._writer.flush()
                if self._stream is not None:
                    must_have_a_name(self._stream.fileno())
        except OSError as error:
            raise self._error(error) from error
        if type(kind) is not str:
            self.recorded += 1

    def _channel(self, key: str, kind: _Kind) -> int:
        """Register the channel of a key and a kind."""
        if kind is None:
            channel = self._writer.register_channel(key, RAW_ENCODING, 0, {})
        else:
            name = kind if isinstance(kind, str) else schema_name(kind)
            if name not in self._schemas:
                content = json.dumps(SCHEMAS[kind] if isinstance(kind, str) else schema(kind))
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", content.encode())
            derived = {"derived": "true"} if isinstance(kind, str) else {}
            channel = self._writer.register_channel(key, "json", self._schemas[name], derived)
        self._channels[(key, kind)] = channel
        return channel

    def _error(self, error: OSError) -> RecordingError:
        self._failed = True
        return RecordingError(f"cannot write the recording {self.path}: {error.strerror or error}")
