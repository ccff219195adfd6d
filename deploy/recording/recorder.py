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
from typing import IO, Final, Self

import tomli_w

from handfast.agent.fleet.loading import law_name, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ingress import Decode
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message
from handfast.agent.messages.validation import Malformed
from handfast.agent.recorder.message_file import MessageFile
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.recording.foxglove.channels import Channels
from handfast.deploy.recording.foxglove.schemas import SCHEMAS
from handfast.deploy.recording.run_files import RecordingError, must_have_a_name

OUTCOME_METADATA: Final = "handfast.outcome"

FLUSH_PERIOD_NS: Final = 1_000_000_000
"""Period at which chunks are written: a killed process loses at most that."""


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
            self._file = MessageFile(self._stream, run, text, SCHEMAS)
            self._stream.flush()  # a file that is cut short still says what it is
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
            if not (self._failed or self._closed):
                try:
                    self._count(self._file.add_raw(received_ns, key, payload), received_ns)
                except OSError as error:
                    raise self._error(error) from error
            return None
        self.record_message(received_ns, key, message)
        return message

    def record_message(self, received_ns: int, key: str, message: Message) -> None:
        """Write one message that is decoded already (a simulation has it at hand)."""
        if self._failed or self._closed:
            return
        try:
            self._count(self._file.add(received_ns, key, message), received_ns)
            for topic, name, content in self._derived.feed(received_ns, key, message):
                self._file.add_derived(received_ns, topic, name, content)
        except OSError as error:
            raise self._error(error) from error

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
            self._file.add_metadata(OUTCOME_METADATA, outcome)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Complete the file. Does nothing the second time."""
        if self._closed or self._stream is None:
            return
        self._closed = True
        try:
            if not self._failed:
                self._file.finish()
            self._stream.close()
        except OSError as error:
            # What the file holds is what can be saved; closing once more drops the buffer quietly.
            with suppress(OSError):
                self._stream.close()
            if not self._failed:
                raise self._error(error) from error

    def _count(self, kept: bool, received_ns: int) -> None:
        """Count a message, and flush the file once a period."""
        if not kept:
            self.rejected["channels"] += 1
            return
        self.recorded += 1
        if self._flush_due_ns is None:
            self._flush_due_ns = received_ns + FLUSH_PERIOD_NS
        elif received_ns >= self._flush_due_ns:
            self._flush_due_ns = received_ns + FLUSH_PERIOD_NS
            self._file.flush()
            if self._stream is not None:
                must_have_a_name(self._stream.fileno())

    def _error(self, error: OSError) -> RecordingError:
        self._failed = True
        return RecordingError(f"cannot write the recording {self.path}: {error.strerror or error}")
