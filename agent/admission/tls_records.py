"""What can be seen of a TLS connection from outside: its records (RFC 8446, section 5.1) (PURE).

In TLS 1.3 a server says little before it has seen the client's certificate: one record of application data
with all of its own part of the handshake, and perhaps an alert. Whoever is sent more has been let in.
"""

from __future__ import annotations

from typing import Final

HANDSHAKE: Final = 22
APPLICATION_DATA: Final = 23
"""Types of records. All that is encrypted has the latter, the handshake's rest and alerts too."""
HEADER_BYTES: Final = 5
LENGTH_MAX: Final = 16_384 + 256
"""Of a record, without its header."""
PROVEN_RECORDS: Final = 4
"""A server that has sent so many records of application data has taken the client's certificate: one or two
more than it ever sends before."""
_CLIENT_HELLO: Final = 1
_MAJOR: Final = 3


class NotTlsError(ValueError):
    """These are not the bytes of a TLS connection."""


def has_client_hello(data: bytes) -> bool:
    """Whether what a client has sent so far holds all of its first record, which must be a ClientHello.

    Raises:
        NotTlsError: it begins with something else.
    """
    if data[:1] and data[0] != HANDSHAKE:
        raise NotTlsError
    if len(data) > 1 and data[1] != _MAJOR:
        raise NotTlsError
    if len(data) < HEADER_BYTES:
        return False
    length = _length(data)
    if len(data) > HEADER_BYTES and data[HEADER_BYTES] != _CLIENT_HELLO:
        raise NotTlsError
    return len(data) >= HEADER_BYTES + length


def _length(header: bytes | bytearray) -> int:
    length = int.from_bytes(header[3:5], "big")
    if not 0 < length <= LENGTH_MAX:
        raise NotTlsError
    return length


class RecordCounter:
    """Counts the records of application data in what one end sends. It holds a header at most.

    Attributes:
        count: so many have begun.
    """

    def __init__(self) -> None:
        self.count = 0
        self._header = bytearray()
        self._left = 0

    def take(self, data: bytes) -> None:
        """Takes the next bytes.

        Raises:
            NotTlsError: a record cannot be like this.
        """
        at = 0
        while at < len(data):
            if self._left:
                skipped = min(self._left, len(data) - at)
                self._left -= skipped
                at += skipped
                continue
            more = data[at : at + HEADER_BYTES - len(self._header)]
            self._header += more
            at += len(more)
            if len(self._header) == HEADER_BYTES:
                self._left = _length(self._header)
                self.count += self._header[0] == APPLICATION_DATA
                self._header.clear()
