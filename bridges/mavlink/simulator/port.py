"""One port of a simulated rover: its MAVLink 2 codec with signing, and the messages that it streams."""

from __future__ import annotations

from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.random_streams import stream, uniform
from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.signing import timestamp_at
from handfast.bridges.mavlink.simulator.telemetry import BUILDERS, DEFAULT_STREAMS, Message

DEFAULT_INTERVAL_NS: Final = round(NS_PER_S / constants.STREAM_RATE_HZ)
LATE: Final = 0.02
"""Share of the streamed messages that a busy autopilot sends a loop late."""
PARAMETER_LIST_SLOWS: Final = 4
"""By this factor streams are slower while a list of parameters is sent."""
UNSIGNED_ALWAYS: Final = frozenset({mavlink.MAVLINK_MSG_ID_RADIO, mavlink.MAVLINK_MSG_ID_RADIO_STATUS})


class _Stream:
    __slots__ = ("due_ns", "interval_ns", "late")

    def __init__(self, interval_ns: int, due_ns: int) -> None:
        self.interval_ns, self.due_ns = interval_ns, due_ns
        self.late = False


class Port:
    """One port from one boot on.

    Args:
        number: 0 is the first serial port, which takes unsigned messages even when there is a key.
        now_ns: its streams start within a second of this.
        key: names its draws.

    Attributes: `next_parameter`: how far the list of parameters that was asked for has come, or None.
    """

    def __init__(self, number: int, system: int, now_ns: int, *key: int | str) -> None:
        self.number = number
        self._mav = mavlink.MAVLink(None, system, constants.COMPONENT_AUTOPILOT)
        self._mav.robust_parsing = True
        self._draws = stream("rover port", number, *key)
        self._drawn = 0
        step = DEFAULT_INTERVAL_NS // len(DEFAULT_STREAMS)
        self._streams = {
            message: _Stream(DEFAULT_INTERVAL_NS, now_ns + step * k)
            for k, message in enumerate(DEFAULT_STREAMS)
        }
        self.next_parameter: int | None = None

    def sign(self, key: bytes, timestamp: int) -> None:
        """Signs with `key` (32 bytes) and takes what is signed with it; an empty one ends that."""
        signing = self._mav.signing
        signing.secret_key = key or None
        signing.sign_outgoing = bool(key)
        signing.link_id = self.number
        signing.timestamp = max(signing.timestamp, timestamp)
        first = self.number == 0
        signing.allow_unsigned_callback = lambda _mav, message: first or message in UNSIGNED_ALWAYS

    def read(self, data: bytes, now_ns: int) -> list[Message]:
        """The messages that these bytes complete. Garbage, and what signing refuses, is left out."""
        self._set_signing_time(now_ns)
        messages: list[Any] = self._mav.parse_buffer(data) or []
        return [m for m in messages if m.get_msgId() >= 0 and not isinstance(m, mavlink.MAVLink_unknown)]

    def pack(self, message: Message, now_ns: int) -> bytes:
        """The bytes of a message of the vehicle's own."""
        self._set_signing_time(now_ns)
        data: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) & 0xFF
        return data

    def _set_signing_time(self, now_ns: int) -> None:
        signing = self._mav.signing
        if signing.secret_key is not None:
            signing.timestamp = max(signing.timestamp, timestamp_at(now_ns))

    def interval_ns(self, message: int) -> int | None:
        """How often a message is sent; 0: not at all; None: it is not one of this vehicle's."""
        if message not in BUILDERS:
            return None
        found = self._streams.get(message)
        return 0 if found is None else found.interval_ns

    def set_interval(self, message: int, interval_ns: int, now_ns: int) -> None:
        """Streams a message every `interval_ns`; 0 ends that, less than 0 brings its default back."""
        if interval_ns < 0:
            interval_ns = DEFAULT_INTERVAL_NS if message in DEFAULT_STREAMS else 0
        if interval_ns:
            self._streams[message] = _Stream(interval_ns, now_ns + interval_ns)
        else:
            self._streams.pop(message, None)

    def due(self, now_ns: int) -> list[int]:
        """Ids of the messages to send in this loop."""
        slow = 1 if self.next_parameter is None else PARAMETER_LIST_SLOWS
        ids = []
        for message, each in self._streams.items():
            if now_ns < each.due_ns:
                continue
            self._drawn += 1
            each.late = not each.late and uniform(self._draws, self._drawn) < LATE
            if each.late:
                continue
            ids.append(message)
            each.due_ns += each.interval_ns * slow
        return ids
