"""What Zenoh refuses, made readable: from the lines of its log to a few of our own (PURE).

Whoever may be refused can try again and again, so each kind of refusal has one line in `PERIOD_NS` at most,
which counts the others. Nothing of what is in a line of ours comes from those who were refused: who they are
is from a certificate of the fleet, the rest is from the lists here.
"""

from __future__ import annotations

import re
from collections import Counter, OrderedDict
from collections.abc import Iterator
from typing import Final

FILTER: Final = ",".join(
    (
        "off",
        "zenoh_link_tls=warn",  # connections that were refused
        "zenoh::net::runtime::orchestrator=debug",  # and those of ours that others refused
        # That a message was refused, and, around it, from which link it came. Which key it had stands in
        # lines of access_control alone, which has one for every message that is let in, too.
        "zenoh::net::routing::interceptor=trace",
        "zenoh::net::routing::interceptor::access_control=off",
        "zenoh::net::primitives=debug",
    )
)
"""What of Zenoh's log is wanted, as its ``RUST_LOG`` has it."""
PERIOD_NS: Final = 10_000_000_000
"""Each kind of refusal is logged at most once in this time, ns."""
LINKS_MAX: Final = 256
"""Links that are remembered by who is at their other end."""
KINDS_MAX: Final = 64
"""Different refusals that are counted apart."""

_WORTH_READING: Final = (b"intercepted", b"link_tls", b"Unable to connect", b"low_pass")
_COLOURS: Final = re.compile(rb"\x1b\[[0-9;]*m")
_ACCEPTED: Final = re.compile(
    rb"New low-pass filter transport.{0,200}\bzid: ([0-9a-f]{1,32}),"
    rb'.{0,2000}?auth_identifier: Tls\(Some\("([A-Za-z0-9._-]{1,64})"\)\)'
)
_MESSAGE: Final = re.compile(
    rb"demux\{.{0,200}?src=[a-z:0-9]{1,20}/([0-9a-f]{1,8}):[0-9]+.{0,300}Msg intercepted!"
)
_INCOMING: Final = re.compile(rb" WARN .{0,80}zenoh_link_tls::[a-z_:]{1,40}: (.{1,200})")
_OUTGOING: Final = re.compile(
    rb"Unable to connect to[a-z ]{0,40} ([a-z]{1,8}/[A-Za-z0-9._:\[\]-]{1,270})! (.{1,600})"
)
ANOTHER_AUTHORITY: Final = (
    "its certificate is not from this fleet's authority",
    "it does not know the authority of our certificate",
)
"""Why links fail between those of two authorities, as the one says it and as the other."""
_MEANINGS: Final = (
    (b"Too many open files", "this process has no file handles left"),
    (b"sent no certificate", "it has no certificate"),
    (b"UnknownIssuer", ANOTHER_AUTHORITY[0]),
    (b"certificate: BadSignature", ANOTHER_AUTHORITY[0]),
    (b"certificate expired", "its certificate has expired"),
    (b"not valid yet", "its certificate is not valid yet"),
    (b"not valid for name", "its certificate is for other addresses"),
    (b"invalid peer certificate", "its certificate is not good"),
    (b"corrupt message", "it does not speak TLS"),
    (b"alert: UnknownCA", ANOTHER_AUTHORITY[1]),
    (b"alert: DecryptError", ANOTHER_AUTHORITY[1]),
    (b"alert: CertificateExpired", "by its clock our certificate is not valid: are both right?"),
    (b"alert: CertificateRequired", "we have no certificate"),
    (b"alert: BadCertificate", "to it our certificate is wrong, or for other addresses"),
    (b"fatal alert", "it broke the handshake off"),
)
"""Words of Zenoh's, and what they mean of the one at the other end. The first that is found holds."""
_OTHER: Final = "the handshake failed"


class Refusals:
    """Takes the bytes of Zenoh's log as they come, and says now and then what was refused.

    Args:
        kinds_max: different refusals that are counted apart within `PERIOD_NS`, with a line each; all others
            share one.

    Attributes:
        total: refusals since the start.
    """

    def __init__(self, kinds_max: int = KINDS_MAX) -> None:
        self.total = 0
        self._kinds_max = kinds_max
        self._links: OrderedDict[bytes, str] = OrderedDict()
        self._waiting: Counter[str] = Counter()
        self._said_ns: dict[str, int] = {}

    def take(self, log: bytes, share: float = 1.0) -> None:
        """Reads a piece of the log, of whole lines but perhaps the first and the last.

        Args:
            share: how much of what came it is, within 0..1; the rest is taken for more of the same.
        """
        before = self.total
        for line in log.splitlines():
            if any(word in line for word in _WORTH_READING):
                kind = self._kind(_COLOURS.sub(b"", line))
                if kind is not None:
                    self.add(kind)
        if more := round((self.total - before) * (1.0 / share - 1.0)):
            self.add("attempts in a flood of them", more)

    def add(self, kind: str, count: int = 1) -> None:
        """Counts a refusal; `kind` says what was refused and why, of few different texts."""
        self.total += count
        apart = self._waiting.keys() | self._said_ns.keys()
        if kind not in apart and len(apart) >= self._kinds_max:
            kind = "other attempts"
        self._waiting[kind] += count

    def lines(self, now_ns: int) -> Iterator[str]:
        """The lines that are due at `now_ns`, of a clock that never goes back."""
        for kind, said_ns in list(self._said_ns.items()):
            if now_ns - said_ns >= PERIOD_NS:
                del self._said_ns[kind]
        for kind, count in list(self._waiting.items()):
            if kind in self._said_ns:
                continue
            del self._waiting[kind]
            self._said_ns[kind] = now_ns
            times = "" if count == 1 else f" ({count} times)"
            yield f"refused: {kind}{times}"

    def _kind(self, line: bytes) -> str | None:
        if b"Msg intercepted!" in line:
            found = _MESSAGE.search(line)
            who = self._links.get(found[1]) if found else None
            return f"a message of {who or 'somebody'} that it may not send, or that is too large"
        if found := _INCOMING.search(line):
            return f"a connection of somebody: {_why(found[1]) or _OTHER}"
        if found := _OUTGOING.search(line):
            why = _why(found[2])  # nothing when nobody is there, which refuses nobody
            return f"the connection to {found[1].decode('ascii')}: {why}" if why else None
        if found := _ACCEPTED.search(line):
            self._opened(_short(found[1]), found[2].decode("ascii"))
        return None

    def _opened(self, link: bytes, name: str) -> None:
        # Who chooses the number of another link shall not be taken for the one who has it.
        known = self._links.pop(link, name)
        self._links[link] = known if name in known.split(" or ") else f"{known} or {name}"[:200]
        if len(self._links) > LINKS_MAX:
            self._links.popitem(last=False)


def _short(zid: bytes) -> bytes:
    """The number of a link as it stands around messages: of its first four bytes, without zeros in front."""
    return zid.rjust(len(zid) + len(zid) % 2, b"0")[:8].lstrip(b"0")


def _why(text: bytes) -> str:
    return next((why for word, why in _MEANINGS if word in text), "")
