"""Reading a run's MCAP file, whole, cut short or damaged.

All messages of a channel in a chunk go through one call of the JSON parser, which halves the time.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from itertools import repeat
from math import inf
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import Any, Final

import orjson
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import CLASSES
from handfast.agent.messages.types import Message as BusMessage
from handfast.agent.recorder.message_file import FLEET_ATTACHMENT, RUN_METADATA
from handfast.agent.recorder.message_json import reader, schema_name
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.mcap_records import MAGIC, Lost, Records, parsed, records_in
from handfast.deploy.recording.recorder import OUTCOME_METADATA
from handfast.deploy.recording.recording import Damage, Recording
from handfast.deploy.recording.run_files import FLEET_FILE, RECORDING_FILE, RecordingError

_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_READERS: Final = {schema_name(cls): reader(cls) for cls in CLASSES}


class McapFile:
    """The contents of one MCAP file.

    Args:
        wants: False for a chunk whose messages are skipped.
        keys: channels of other keys are skipped; None for none.
    """

    def __init__(
        self,
        path: Path,
        wants: Callable[[Chunk], bool] = lambda chunk: True,
        keys: Container[str] | None = None,
    ) -> None:
        self.path = path
        self._wants, self._keys = wants, keys
        self.metadata: dict[str, dict[str, str]] = {}
        self.fleet_toml: str | None = None
        self._records: Records | None = None
        self._last_ns = 0
        """When the last message came."""
        self._unknown = 0
        """Messages of which it is not known what they are."""
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, Callable[[dict[str, Any]], BusMessage]] | None] = {}

    def read(self) -> Iterator[tuple[int, str, BusMessage]]:
        """(reception time ns, key, message) of every message of ours, chunk by chunk, by reception."""
        try:
            with open(self.path, "rb") as stream:
                records = self._records = Records(stream)
                magic = stream.seek(0) or stream.read(len(MAGIC))
                if not magic:
                    raise RecordingError(f"{self.path} is empty; a recording of handfast (MCAP) was expected")
                for record in records:
                    yield from self._record(record)
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror or error}") from error
        if magic != MAGIC and not records.damaged:
            raise RecordingError(f"{self.path} is not an MCAP file; a recording of handfast was expected")

    @property
    def lost(self) -> list[Lost]:
        """Lost parts, after `read` has ended."""
        return [] if self._records is None else self._records.lost

    @property
    def is_damaged(self) -> bool:
        """Whether something of it could not be read; it may be cut short as well."""
        return self._records is not None and self._records.damaged

    def warnings(self, begun_ns: int) -> list[str]:
        """What is to be said of parts that could not be read, by a clock that shows zero at `begun_ns`."""
        records = self._records
        assert records is not None
        found = []
        if records.lost:
            spans = " and ".join(dict.fromkeys(_span(each, begun_ns) for each in records.lost))
            found.append(f"{self.path}: damaged {spans}, left out")
        if self._unknown:
            found.append(
                f"{self.path}: {self._unknown} messages of later on are lost as well: what they are was said "
                "in what is damaged"
            )
        if not records.ends:
            found.append(f"{self.path} is cut short or damaged: what follows its last complete chunk is lost")
        elif not found and (records.damaged or not records.is_whole):
            found.append(f"{self.path} is cut short or damaged: its messages are all there")
        return found

    def damage(self, begun_ns: int) -> list[Damage]:
        """What of it is lost, by such a clock."""
        records = self._records
        assert records is not None
        lost = [*records.lost]
        if self._unknown:
            lost.append(Lost(None, None))
        if not records.ends:
            lost.append(Lost(self._last_ns, None))
        return [
            Damage(
                self.path.name,
                -inf if since_ns is None else (since_ns - begun_ns) / NS_PER_S,
                inf if until_ns is None else (until_ns - begun_ns) / NS_PER_S,
            )
            for since_ns, until_ns in lost
        ]

    def _record(self, record: McapRecord) -> Iterator[tuple[int, str, BusMessage]]:
        if isinstance(record, Chunk):
            yield from self._inside(record.data, self._wants(record))
        elif isinstance(record, Message):  # a file without chunks
            builder = RecordBuilder()
            record.write(builder)
            yield from self._inside(builder.end())
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment) and record.name == FLEET_ATTACHMENT:
            self.fleet_toml = record.data.decode(errors="replace")
        else:
            self._define(record)

    def _inside(self, data: bytes, wanted: bool = True) -> list[tuple[int, str, BusMessage]]:
        times: dict[int, list[int]] = {}
        texts: dict[int, list[bytes]] = {}
        for opcode, content in records_in(data):
            if opcode == Opcode.MESSAGE:
                if not wanted:
                    continue
                channel, _, log_ns, _ = _MESSAGE.unpack_from(content)
                if channel not in self._channels and self.is_damaged:
                    self._look_up(channel)
                if self._channels.get(channel) is not None:
                    times.setdefault(channel, []).append(log_ns)
                    texts.setdefault(channel, []).append(content[_MESSAGE.size :])
            else:
                self._define(parsed(opcode, content))
        found: list[tuple[int, str, BusMessage]] = []
        for channel, log_times in times.items():
            entry = self._channels[channel]
            assert entry is not None
            key, read = entry
            try:
                # All of a channel's messages in one call of the parser: half the time.
                contents = orjson.loads(b"[" + b",".join(texts[channel]) + b"]")
                messages = [read(each) for each in contents]
            except (ValueError, TypeError, KeyError, IndexError) as error:
                raise RecordingError(
                    f"{self.path}: channel {key} holds what is not a message of handfast"
                ) from error
            if len(messages) != len(log_times):
                raise RecordingError(f"{self.path}: channel {key} holds what is not a message of handfast")
            self._last_ns = max(self._last_ns, *log_times)
            found += zip(log_times, repeat(key), messages, strict=False)
        return sorted(found, key=itemgetter(0))

    def _look_up(self, channel: int) -> None:
        """Finds at the file's end what a channel is that was introduced in a damaged part."""
        assert self._records is not None
        if summary := self._records.summary:
            for record in (*summary.schemas.values(), *summary.channels.values()):
                self._define(record)
        self._unknown += channel not in self._channels

    def _define(self, record: McapRecord) -> None:
        """Takes a schema or a channel."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel):
            self._add_channel(record)

    def _add_channel(self, channel: Channel) -> None:
        if channel.schema_id not in self._schemas and self.is_damaged:
            return  # its schema was in what is damaged: it is looked up once a message comes
        name = self._schemas.get(channel.schema_id, "")
        # Raw payloads (no schema), what is derived and schemas of a later version are not ours to read.
        known = channel.message_encoding == "json" and name in _READERS
        known = known and (self._keys is None or channel.topic in self._keys)
        self._channels[channel.id] = (channel.topic, _READERS[name]) if known else None


def _span(lost: Lost, begun_ns: int) -> str:
    """From when to when a part is lost, in words."""
    since, until = (None if ns is None else f"{(ns - begun_ns) / NS_PER_S:.1f} s" for ns in lost)
    if since is None:
        return "throughout" if until is None else f"up to {until}"
    if until is None:
        return f"from {since} on"
    return f"at {since}" if since == until else f"from {since} to {until}"


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

    A file that was cut short, at whatever byte, is read to its last complete chunk, and of one that is
    damaged all is read but the chunks that are; `Recording.warnings` and `damage` then say what is missing.

    Raises:
        RecordingError, FleetError: as `read_run`.
    """
    path = Path(path)
    file = McapFile(path)
    messages = file.read()
    first = next(messages, None)
    if RUN_METADATA not in file.metadata and first is None:
        cut = file.warnings(0)
        what = "is cut short before it says what it is" if cut else "was not written by handfast"
        raise RecordingError(f"{path} {what}; a recording that a run has left was expected")
    if first is None:
        why = " (it is cut short or damaged)" if file.warnings(0) else ""
        raise RecordingError(f"{path} holds no message{why}: there is nothing to report")
    fleet, fleet_toml = _fleet(file, None if fleet_path is None else Path(fleet_path))
    run = file.metadata.get(RUN_METADATA, {})
    data = RunData(fleet, mode=run.get("mode", "run"), seed=_seed(run))
    data.feed(*first)
    for received_ns, key, message in messages:
        data.feed(received_ns, key, message)
    reasons, interrupted, warnings = _outcome(file)
    if RUN_METADATA not in file.metadata:
        warnings.append(f"{path}: what it is a recording of is damaged, left out")
    warnings += file.warnings(data.begun_ns)
    recording = data.recording(
        reasons=reasons, interrupted=interrupted, warnings=warnings, fleet_toml=fleet_toml
    )
    return replace(recording, damage=tuple(file.damage(data.begun_ns)))


def _outcome(file: McapFile) -> tuple[list[str], bool, list[str]]:
    """What only the operator knew of the run's end: reasons, whether it was interrupted, warnings."""
    outcome = file.metadata.get(OUTCOME_METADATA, {})
    try:
        return (
            [str(reason) for reason in json.loads(outcome.get("reasons", "[]"))],
            bool(json.loads(outcome.get("interrupted", "false"))),
            [str(warning) for warning in json.loads(outcome.get("warnings", "[]"))],
        )
    except (ValueError, TypeError):
        return [], False, [f"{file.path}: what was noted at its end is damaged, left out"]


def _seed(run: dict[str, str]) -> int | None:
    text = run.get("seed", "")
    return int(text) if text.removeprefix("-").isdecimal() else None


def _fleet(file: McapFile, fleet_path: Path | None) -> tuple[Fleet, str]:
    """The fleet and its file's text: from the run's folder, else from inside the recording."""
    if fleet_path is not None and fleet_path.is_file():
        return load_fleet(fleet_path, recorded=True), fleet_path.read_text("utf-8-sig")
    if file.fleet_toml is None:
        raise RecordingError(f"{file.path} holds no fleet file, and there is none beside it")
    source = f"{FLEET_ATTACHMENT} inside {file.path}"
    return parse_fleet(file.fleet_toml, source=source, recorded=True), file.fleet_toml
