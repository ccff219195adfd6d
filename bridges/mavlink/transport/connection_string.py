"""Reads connection strings as of pymavlink and MAVProxy: where a vehicle is (PURE)."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, get_args

Kind = Literal["udpin", "udpout", "tcp", "serial"]
BY_ID: Final = "/dev/serial/by-id/"
CHANGING: Final = ("/dev/ttyUSB", "/dev/ttyACM")
FORMS: Final = (
    "udpin:HOST:PORT (wait there for the vehicle), udpout:HOST:PORT (send there), tcp:HOST:PORT or a serial "
    "device as /dev/serial/by-id/..."
)
_PORT_MAX: Final = 65535
_UNSUPPORTED: Final = ("tcpin", "udpbcast", "mcast", "mcastv6", "wsserver", "ws", "wss")


class Unusable(OSError):
    """A connection that cannot be opened before somebody changes something; the text says what. Any other
    OSError may end by itself: a vehicle that is not on yet refuses connections, or has no device."""


class Connection(NamedTuple):
    """One connection: `host` and `port` of a network one, `device` (a path) of a serial one."""

    kind: Kind
    host: str = ""
    port: int = 0
    device: str = ""

    @property
    def by_id(self) -> bool:
        """Whether its name stays with the vehicle (`is_lasting`)."""
        return is_lasting(self.text)

    @property
    def text(self) -> str:
        """The connection as it is written, with `udp:` as `udpin:`."""
        if self.kind == "serial":
            return self.device
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def is_lasting(text: str) -> bool:
    """Whether a connection's name stays with the vehicle: /dev/ttyUSB0 is another one after the next boot. A
    computer's own UART has no other name, and keeps it.
    """
    return not text.startswith(CHANGING)


def parse_connection(text: str) -> Connection:
    """Reads a connection string.

    Raises:
        ValueError: it is none; the text says what would be right.
    """
    if not text.isprintable():
        raise ValueError(f"{text!r} is not a connection; write {FORMS}")
    if text.startswith("/"):
        return Connection("serial", device=text)
    kind, colon, place = text.partition(":")
    if kind in _UNSUPPORTED:
        raise ValueError(f"{text!r}: {kind} connections are not supported; write {FORMS}")
    if kind == "udp":
        kind = "udpin"
    if not colon or kind not in get_args(Kind) or kind == "serial":
        raise ValueError(f"{text!r} is not a connection; write {FORMS}")
    host, port = _address(text, kind, place)
    return Connection(kind, host, port)  # type: ignore[arg-type]  # one of Kind: looked up above


def _address(text: str, kind: str, place: str) -> tuple[str, int]:
    """Return host and port of the connection string `text`, whose HOST:PORT is `place`."""
    host, colon, digits = place.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise ValueError(f"{text!r}: an IPv6 address is written in brackets, as {kind}:[::1]:14550")
    if not colon or not host or any(letter.isspace() for letter in host):
        raise ValueError(
            f"{text!r} names no host and port; write {kind}:HOST:PORT, as {kind}:127.0.0.1:14550"
        )
    if not (digits.isascii() and digits.isdigit() and 1 <= int(digits) <= _PORT_MAX):
        raise ValueError(f"{text!r}: the port must be a whole number from 1 to {_PORT_MAX}, not {digits!r}")
    return host, int(digits)
