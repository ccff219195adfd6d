"""An MCAP file of bus messages: a channel for each key and class of message, as JSON with a schema.

Both the recorder on a robot's computer and the operator's `deploy.recording.recorder` write such files, so
every MCAP tool opens either as it is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import IO, Any, Final

from mcap.writer import Writer

from handfast.agent.messages.types import CLASSES, Message
from handfast.agent.recorder.message_json import schema, schema_name, to_json

RUN_METADATA: Final = "handfast.run"
FLEET_ATTACHMENT: Final = "fleet.toml"
RAW_ENCODING: Final = "application/octet-stream"
CHUNK_BYTES: Final = 256 * 1024
"""Size above which a chunk is complete."""
CHANNELS_MAX: Final = 4096
"""Maximum number of channels: made-up keys must not grow the tables without bound (MCAP has 2**16)."""
_Kind = type[Message] | str | None
"""Content of a channel: a message class, the name of a derived channel's schema, or None for raw bytes."""
_TIME_MAX: Final = 2**64 - 1
_SEQUENCE_MASK: Final = 2**32 - 1  # MCAP's sequence has 32 bits
_SEQUENCES: Final = {
    cls: next((cls._fields.index(name) for name in ("sequence", "version") if name in cls._fields), None)
    for cls in CLASSES
}
"""Index of each class's field that counts as its sequence number."""


class MessageFile:
    """Writes messages to an MCAP file.

    Args:
        stream: written from its beginning; needs `write`, `tell` and `flush`.
        run: metadata that says what the file is a recording of.
        fleet_toml: text of the fleet file, kept as an attachment.
        derived: JSON schemas of derived channels, by name.

    All methods raise OSError where the stream cannot be written.
    """

    def __init__(
        self,
        stream: IO[bytes],
        run: Mapping[str, str],
        fleet_toml: str,
        derived: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, _Kind], int] = {}
        self._derived: Mapping[str, Mapping[str, Any]] = derived or {}
        self._writer = Writer(stream, CHUNK_BYTES)
        self._writer.start(library="handfast")
        self._writer.add_metadata(RUN_METADATA, dict(run))
        self._writer.add_attachment(0, 0, FLEET_ATTACHMENT, "application/toml", fleet_toml.encode())

    def add_metadata(self, name: str, texts: Mapping[str, str]) -> None:
        """Write named texts, before the chunk in progress."""
        self._writer.add_metadata(name, dict(texts))

    def add(self, received_ns: int, key: str, message: Message) -> bool:
        """Add a message. Return False if it has been left out as there are too many channels."""
        kind, place = type(message), _SEQUENCES[type(message)]
        values: tuple[Any, ...] = message
        sequence: int = 0 if place is None else values[place]
        return self._add(received_ns, key, kind, to_json(message), message.time_ns, sequence)

    def add_raw(self, received_ns: int, key: str, payload: bytes) -> bool:
        """Add a payload that is no message."""
        return self._add(received_ns, key, None, payload, received_ns, 0)

    def add_derived(self, received_ns: int, topic: str, schema_name: str, content: bytes) -> bool:
        """Add JSON to a derived channel."""
        return self._add(received_ns, topic, schema_name, content, received_ns, 0)

    def flush(self) -> None:
        """End the chunk in progress and flush the stream."""
        self._writer.flush()

    def finish(self) -> None:
        """Complete the file; the stream stays open."""
        self._writer.finish()

    def _add(
        self, received_ns: int, key: str, kind: _Kind, content: bytes, time_ns: int, sequence: int
    ) -> bool:
        channel = self._channels.get((key, kind))
        if channel is None:
            if len(self._channels) >= CHANNELS_MAX:
                return False
            channel = self._channels[key, kind] = self._channel(key, kind)
        log_ns = min(max(received_ns, 0), _TIME_MAX)
        self._writer.add_message(channel, log_ns, content, time_ns, sequence & _SEQUENCE_MASK)
        return True

    def _channel(self, key: str, kind: _Kind) -> int:
        """Register the channel of a key and a kind; return its number."""
        if kind is None:
            return self._writer.register_channel(key, RAW_ENCODING, 0)
        name = kind if isinstance(kind, str) else schema_name(kind)
        if name not in self._schemas:
            content = json.dumps(self._derived[kind] if isinstance(kind, str) else schema(kind))
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", content.encode())
        derived = {"derived": "true"} if isinstance(kind, str) else {}
        return self._writer.register_channel(key, "json", self._schemas[name], derived)
