"""Whose connections are let through to the bus now: budgets of handshakes that fail (PURE).

For every TLS handshake that fails Zenoh's acceptor sleeps 100 ms, one after the other, so that some ten a
second, from anybody, keep everybody else out. Hence a connection costs a token when its handshake begins, and
whoever has a certificate of the fleet gets it back as soon as that shows: failures alone spend budgets.

- **Known** sources are the hosts of the fleet file, and whoever has completed a handshake before. Each has a
  budget of its own: nobody else can spend it.
- **Unknown** sources share two: one those that come for the first time, the other those that have failed. The
  latter wait, longer each time, before they may try again.

Times are of any clock that never goes back, s.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from enum import Enum
from ipaddress import IPv6Address, ip_address
from typing import Final

FIRST_PER_S: Final = 3.0
AGAIN_PER_S: Final = 2.0
"""Handshakes of all unknown sources that may fail in a second, of those that never failed before and of the
others. Together half of what Zenoh's acceptor stands. A burst is what may fail in a second, too."""
KNOWN_PER_S: Final = 1.0
"""Handshakes of one known source that may fail in a second."""
KNOWN_BURST: Final = 32.0
"""All robots of a host dial at once when another one has started again."""
BACKOFF_S: Final = 1.0
"""Who failed may try again after this; after twice as long each time that it fails again."""
BACKOFF_MAX_S: Final = 60.0
WAITING_MAX: Final = 64
"""Connections of unknown sources that may be there without having proven anything yet."""
WAITING_OF_ONE_MAX: Final = 4
"""Those of one unknown source: an operator's command dials agent and plant."""
SOURCES_MAX: Final = 4096
"""Sources that are remembered, those that were heard last."""
PROVEN_MAX: Final = 256
"""Sources that are known for what they have proven, those that did last."""
IPV6_PREFIX: Final = 64
"""Bits of an IPv6 address that tell unknown sources apart: the others are anybody's to choose."""


class Refused(Enum):
    """Why a connection is not let through, in words that follow on whose it is."""

    BACKOFF = "too soon after one that failed"
    WAITING = "too many of it, or of others that are not known, have shown no certificate yet"
    BUDGET = "too many that failed of late"


class Outcome(Enum):
    """What became of a connection that was let through."""

    PROVEN = 1
    """Its handshake was completed with a certificate of the fleet."""
    FAILED = 2
    """It was not: refused, given up, or not in time."""
    NOBODY = 3
    """Nobody was there to answer it, which is not its fault."""


class Bucket:
    """A token bucket: `rate` tokens a second, `burst` at most."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._tokens, self._at_s = burst, 0.0

    def take(self, now_s: float) -> bool:
        """Takes a token, if there is one."""
        self._tokens = min(self._burst, self._tokens + (now_s - self._at_s) * self._rate)
        self._at_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True

    def give(self) -> None:
        """Gives one back."""
        self._tokens = min(self._burst, self._tokens + 1.0)


@dataclass(slots=True)
class _Source:
    bucket: Bucket | None
    """Its own, if it is known."""
    waiting: int = 0
    failures: int = 0
    not_before_s: float = 0.0


@dataclass(slots=True)
class Ticket:
    """A connection that was let in. `Budgets.ended` takes it back, once."""

    address: str
    source: _Source = field(repr=False)
    charged: Bucket | None = field(default=None, repr=False)


class Budgets:
    """Decides which connections are let through. `opened`, then `begun`, then `ended`.

    Args:
        proven: addresses that have proven themselves before, the latest last.

    Attributes:
        hosts: addresses of the fleet's hosts, as numbers; may be set anew at any time.
    """

    def __init__(self, proven: Iterable[str] = ()) -> None:
        self.hosts: Collection[str] = frozenset()
        self._proven = OrderedDict.fromkeys(proven)
        self._first = Bucket(FIRST_PER_S, FIRST_PER_S)
        self._again = Bucket(AGAIN_PER_S, AGAIN_PER_S)
        self._sources: OrderedDict[str, _Source] = OrderedDict()
        self._waiting = 0
        self._forget()

    @property
    def proven(self) -> tuple[str, ...]:
        """Addresses that have proven themselves, the latest last."""
        return tuple(self._proven)

    def is_known(self, address: str) -> bool:
        """Whether a source has a budget of its own."""
        return address in self.hosts or address in self._proven

    def opened(self, address: str, now_s: float) -> Ticket | Refused:
        """A connection of `address` is there, and nothing is known of it yet."""
        source = self._source(address)
        if source.bucket is None:
            if now_s < source.not_before_s:
                return Refused.BACKOFF
            if self._waiting >= WAITING_MAX or source.waiting >= WAITING_OF_ONE_MAX:
                return Refused.WAITING
            self._waiting += 1
        elif source.waiting >= KNOWN_BURST:
            return Refused.WAITING
        source.waiting += 1
        return Ticket(address, source)

    def begun(self, ticket: Ticket, now_s: float) -> Refused | None:
        """Its handshake has begun; None when it is to be let through."""
        bucket = ticket.source.bucket or (self._again if ticket.source.failures else self._first)
        if not bucket.take(now_s):
            return Refused.BUDGET
        ticket.charged = bucket
        return None

    def ended(self, ticket: Ticket, outcome: Outcome, now_s: float) -> bool:
        """What became of it; whether `proven` has another address now."""
        source = ticket.source
        source.waiting -= 1
        if source.bucket is None:
            self._waiting -= 1
        if outcome is Outcome.FAILED:
            wait_s = min(BACKOFF_MAX_S, BACKOFF_S * 2.0 ** min(source.failures, 20))
            source.failures += 1
            source.not_before_s = max(source.not_before_s, now_s + wait_s)
            return False
        if ticket.charged is not None:
            ticket.charged.give()
        if outcome is Outcome.NOBODY:
            return False
        source.failures, source.not_before_s = 0, 0.0
        is_new = ticket.address not in self._proven
        self._proven[ticket.address] = None
        self._proven.move_to_end(ticket.address)
        self._forget()
        return is_new

    def _source(self, address: str) -> _Source:
        known = self.is_known(address)
        name = address if known else unknown_source(address)
        source = self._sources.get(name)
        if source is None or (source.bucket is not None) != known:
            source = _Source(Bucket(KNOWN_PER_S, KNOWN_BURST) if known else None)
            self._sources[name] = source
        self._sources.move_to_end(name)
        self._forget()
        return source

    def _forget(self) -> None:
        while len(self._sources) > SOURCES_MAX:
            self._sources.popitem(last=False)
        while len(self._proven) > PROVEN_MAX:
            self._proven.popitem(last=False)


def unknown_source(address: str) -> str:
    """What an unknown source is told apart by: its address, or the network of an IPv6 one."""
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if not isinstance(found, IPv6Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(IPv6Address(int(found) >> (128 - IPV6_PREFIX) << (128 - IPV6_PREFIX)))
