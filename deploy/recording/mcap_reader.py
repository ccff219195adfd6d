"""Reading a run's MCAP file, whole or cut short.

Not through `mcap.reader`: that one wants the index at the end of the file, which a killed run never
wrote, and parses messages one by one, which takes ten times as long.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from agent.fleet.loading import load_fleet, parse_fleet
from agent.fleet.model import Fleet
from agent.messages.types import CLASSES, Message
from deploy.recording.collector import RunData
from deploy.recording.foxglove import SCHEMA_PREFIX
from deploy.recording.message_json import reader, schema_name
from deploy.recording.recorder import OUTCOME_METADATA, RUN_METADATA, RecordingError
from deploy.recording.recording import Recording
from deploy.recording.run_files import FLEET_FILE, RECORDING_FILE

MAGIC: Final = b"\x89MCAP0\r\n"
_PREFIX: Final = struct.Struct("<BQ")  # opcode, length
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_RECORD_BYTES_MAX: Final = 1 << 30
_READERS: Final = {schema_name(cls): reader(cls) for cls in CLASSES}


class _CutShort(Exception):
    """The file ends, or makes no sense any more, before its end."""


class _File:
    """The contents of one MCAP file, channel by channel."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.fleet_toml: str | None = None
        self.warnings: list[str] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, Callable[[dict[str, Any]], Message]] | None] = {}

    def read(self) -> Iterator[tuple[int, str, Message]]:
        """(reception time ns, key, message) of every message of ours, chunk by chunk, channel by channel."""
        complete = False
        try:
            with open(self.path, "rb") as stream:
                self._check_magic(stream)
                try:
                    for opcode, content in _records(stream):
                        complete = complete or opcode == Opcode.DATA_END
                        if opcode == Opcode.FOOTER:
                            if stream.read(len(MAGIC)) != MAGIC:
                                raise _CutShort
                            return
                        yield from self._record(opcode, content)
                    raise _CutShort
                except _CutShort:
                    lost = (
                        "its messages are all there"
                        if complete
                        else "what follows its last complete chunk is lost"
                    )
                    self.warnings.append(f"{self.path} is cut short or damaged: {lost}")
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror or error}") from error

    def _check_magic(self, stream: IO[bytes]) -> None:
        magic = stream.read(len(MAGIC))
        if not magic:
            raise RecordingError(f"{self.path} is empty; a recording of handfast (MCAP) was expected")
        if magic != MAGIC:
            raise RecordingError(f"{self.path} is not an MCAP file; a recording of handfast was expected")

    def _record(self, opcode: int, content: bytes) -> Iterator[tuple[int, str, Message]]:
        try:
            if opcode == Opcode.CHUNK:
                data, length = get_chunk_data_stream(Chunk.read(_stream(content)), validate_crc=True)
                yield from self._inside(data.read(length))
            elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):  # a file without chunks
                yield from self._inside(_PREFIX.pack(opcode, len(content)) + content)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(_stream(content))
                self.metadata[metadata.name] = metadata.metadata
            elif opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(_stream(content))
                if attachment.name == FLEET_FILE:
                    self.fleet_toml = attachment.data.decode()
        except RecordingError:
            raise
        # The decompressors and the parser of damaged records raise a dozen unrelated types.
        except (McapError, ValueError, struct.error, RuntimeError, MemoryError, OverflowError) as error:
            raise _CutShort from error
        except Exception as error:
            if type(error).__module__.partition(".")[0] not in ("zstandard", "lz4", "zstd"):
                raise
            raise _CutShort from error

    def _inside(self, data: bytes) -> Iterator[tuple[int, str, Message]]:
        times: dict[int, list[int]] = {}
        texts: dict[int, list[bytes]] = {}
        for opcode, content in _records(BytesIO(data)):
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(content)
                if self._channels.get(channel) is not None:
                    times.setdefault(channel, []).append(log_ns)
                    texts.setdefault(channel, []).append(content[_MESSAGE.size :])
            elif opcode == Opcode.SCHEMA:
                found = Schema.read(_stream(content))
                self._schemas[found.id] = found.name
            elif opcode == Opcode.CHANNEL:
                self._add_channel(Channel.read(_stream(content)))
        for channel, log_times in times.items():
            entry = self._channels[channel]
            assert entry is not None
            key, read = entry
            try:
                # All of a channel's messages in one call of the parser: half the time.
                contents = json.loads(b"[" + b",".join(texts[channel]) + b"]")
                messages = [read(each) for each in contents]
            except (ValueError, TypeError, KeyError, IndexError) as error:
                raise RecordingError(
                    f"{self.path}: channel {key} holds what is not a message of handfast"
                ) from error
            if len(messages) != len(log_times):
                raise RecordingError(f"{self.path}: channel {key} holds what is not a message of handfast")
            for log_ns, message in zip(log_times, messages, strict=True):
                yield log_ns, key, message

    def _add_channel(self, channel: Channel) -> None:
        name = self._schemas.get(channel.schema_id, "")
        # Raw payloads (no schema), pictures for Foxglove and schemas of a later version are not ours to read.
        known = channel.message_encoding == "json" and name in _READERS and not name.startswith(SCHEMA_PREFIX)
        self._channels[channel.id] = (channel.topic, _READERS[name]) if known else None


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _records(stream: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of every record; raises `_CutShort` where one is not complete."""
    while prefix := stream.read(_PREFIX.size):
        if len(prefix) < _PREFIX.size:
            raise _CutShort
        opcode, length = _PREFIX.unpack(prefix)
        if length > _RECORD_BYTES_MAX:
            raise _CutShort
        content = stream.read(length)
        if len(content) < length:
            raise _CutShort
        yield opcode, content


def read_run(folder: str | PathLike[str]) -> Recording:
    """Read the run in `folder` (its ``run.mcap`` and ``fleet.toml``).

    Raises:
        RecordingError: when it is not a run's folder, or its recording cannot be read.
        FleetError: when its fleet file is not valid.
    """
    path = Path(folder)
    if not path.is_dir():
        what = "is not a folder" if path.exists() else "does not exist"
        raise RecordingError(
            f"{path} {what}; give the folder that a run has left (it holds {RECORDING_FILE})"
        )
    if not (path / RECORDING_FILE).is_file():
        raise RecordingError(f"{path} holds no {RECORDING_FILE}; give the folder that a run has left")
    return read_mcap(path / RECORDING_FILE, path / FLEET_FILE)


def read_mcap(path: str | PathLike[str], fleet_path: str | PathLike[str] | None = None) -> Recording:
    """Read the recording at `path`, with the fleet file at `fleet_path`, else with the one inside it.

    A file that was cut short, at whatever byte, is read to its last complete chunk; `Recording.warnings`
    then says so.

    Raises:
        RecordingError, FleetError: as `read_run`.
    """
    path = Path(path)
    file = _File(path)
    messages = file.read()
    first = next(messages, None)
    if RUN_METADATA not in file.metadata:
        what = "is cut short before it says what it is" if file.warnings else "was not written by handfast"
        raise RecordingError(f"{path} {what}; a recording that a run has left was expected")
    if first is None:
        cut = " (it is cut short)" if file.warnings else ""
        raise RecordingError(f"{path} holds no message{cut}: there is nothing to report")
    fleet, fleet_toml = _fleet(file, None if fleet_path is None else Path(fleet_path))
    run = file.metadata[RUN_METADATA]
    data = RunData(fleet, mode=run.get("mode", "run"), seed=_seed(run))
    data.feed(*first)
    for received_ns, key, message in messages:
        data.feed(received_ns, key, message)
    outcome = file.metadata.get(OUTCOME_METADATA, {})
    try:
        reasons = [str(reason) for reason in json.loads(outcome.get("reasons", "[]"))]
        interrupted = bool(json.loads(outcome.get("interrupted", "false")))
        warnings = [str(warning) for warning in json.loads(outcome.get("warnings", "[]"))]
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path}: its metadata {OUTCOME_METADATA} is damaged") from error
    warnings += file.warnings
    return data.recording(reasons=reasons, interrupted=interrupted, warnings=warnings, fleet_toml=fleet_toml)


def _seed(run: dict[str, str]) -> int | None:
    text = run.get("seed", "")
    return int(text) if text.removeprefix("-").isdecimal() else None


def _fleet(file: _File, fleet_path: Path | None) -> tuple[Fleet, str]:
    """The fleet and its file's text: from the run's folder, else from inside the recording."""
    if fleet_path is not None and fleet_path.is_file():
        return load_fleet(fleet_path, recorded=True), fleet_path.read_text("utf-8-sig")
    if file.fleet_toml is None:
        raise RecordingError(f"{file.path} holds no fleet file, and there is none beside it")
    source = f"{FLEET_FILE} inside {file.path}"
    return parse_fleet(file.fleet_toml, source=source, recorded=True), file.fleet_toml
