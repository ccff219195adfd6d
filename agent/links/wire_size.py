"""How many bytes a message takes on a network link, with what Zenoh, TLS, TCP and IP add (PURE).

Counted is what IP carries; what a radio adds below it (headers of its frames, contention, repeats) is not.
The constants were measured on real sockets with eclipse-zenoh 1.10.2, plain and with TLS 1.3, by
`python -m tests.benchmarks radio`, which finds when they do not hold any more.
"""

from __future__ import annotations

from typing import Final

ZENOH_BYTES: Final = 12
"""What Zenoh puts around a payload that is alone in its batch: length of the batch, header and number of its
frame, number of the key, length of the payload."""
JOINED_BYTES: Final = 5
"""The same of one that goes along in the batch of another: messages of one tick to one neighbour do."""
TLS_BYTES: Final = 22
"""A record of TLS 1.3 around a batch: header 5, type 1, tag 16."""
HEADERS_BYTES: Final = 52
"""IPv4 (20) and TCP (20, and 12 for its time stamps) of every packet, an acknowledgement too."""
SEGMENT_BYTES: Final = 1448
"""What a TCP packet carries at most where IP packets may have 1500 bytes."""
ACKNOWLEDGED: Final = 0.75
"""Share of packets that are acknowledged by a packet of its own: others are by what goes the other way."""
KEEP_ALIVE_BYTES: Final = 3
"""A sign of life of Zenoh's, in a packet of its own, on a link on which nothing else goes."""
KEEP_ALIVE_HZ: Final = 3.0
"""How often it goes: three times within `agent.fleet.hosts.LEASE_MS`."""


def carried_bytes(payload_bytes: float, secured: bool) -> float:
    """A message on a link: itself, and what is around it."""
    return _packets(payload_bytes + ZENOH_BYTES, secured)


def joined_bytes(payload_bytes: float) -> float:
    """A message that goes along with another, which has the headers."""
    return payload_bytes + JOINED_BYTES


def keep_alive_bytes(secured: bool) -> float:
    """A sign of life on a link."""
    return _packets(KEEP_ALIVE_BYTES, secured)


def acknowledged_bytes(payload_bytes: float, secured: bool) -> float:
    """What goes the other way for a message, on average."""
    stream = payload_bytes + ZENOH_BYTES + (TLS_BYTES if secured else 0)
    return ACKNOWLEDGED * HEADERS_BYTES * -(-stream // SEGMENT_BYTES)


def _packets(stream_bytes: float, secured: bool) -> float:
    stream = stream_bytes + (TLS_BYTES if secured else 0)
    return stream + HEADERS_BYTES * -(-stream // SEGMENT_BYTES)
