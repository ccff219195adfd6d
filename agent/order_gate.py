"""Where sealed orders come in and go out, between the bus and whoever takes and gives orders (PURE).

Inside, an order is what its codec made, sealed or not; so nobody inside can take one that is no operator's.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Final

from agent import keys
from agent.clock import NS_PER_S
from agent.seal import Forged, Opener, Sealer

AGE_NS_MAX: Final = 2 * NS_PER_S
"""Of what is said once and not again (heartbeats, faults, questions) a seal is not older, nor that much
ahead: who has overheard one cannot use it later. Missions, stops and leaves have versions, and are said
again."""
SEALS_BYTES_MAX: Final = 2_097_152
"""Of orders that may be said again: thousands of stops, or some twenty of the largest missions."""
FORGED_MAX: Final = 4
FORGED_PERIOD_NS: Final = NS_PER_S // 10
"""Within such a period so many forged orders that one robot tells are looked at, and then no more of what it
tells: to find out that a seal is none costs ten times as much as to make up one. What operators say
themselves is always looked at."""


class OrderGate:
    """Opens what comes as an order, and puts its seal on what goes out as one.

    Args:
        fleet: its name.
        opener: of that fleet.
        sealer: of the operator whose process this is, None for those who only pass on what operators said.
        refused: told in a few words of each order that is not let in.
    """

    def __init__(
        self, fleet: str, opener: Opener, sealer: Sealer | None, refused: Callable[[str], None]
    ) -> None:
        self._orders: Final = frozenset(
            key(fleet)
            for key in (keys.mission, keys.stop, keys.resume, keys.faults, keys.heartbeat, keys.ask)
        )
        self._said_again: Final = frozenset(key(fleet) for key in (keys.mission, keys.stop, keys.resume))
        self._told: Final = tuple(keys.told(fleet, "*").split("*"))
        self._opener, self._sealer, self._refused = opener, sealer, refused
        self._sealed: OrderedDict[bytes, bytes] = OrderedDict()
        self._size = 0
        self._forged: Counter[str] = Counter()
        self._forged_ns = 0

    def is_order(self, key: str) -> bool:
        """Whether only what an operator has sealed is let through on `key`."""
        return key in self._orders or self._is_told(key)

    def let_in(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What came on `key`, opened if it is an order; None when it is not let in.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        if self._is_told(key) and self._forges(key, now_ns):
            self._refused(f"an order on {key}: after too many forged ones")
            return None
        try:
            order = self._opener.open(payload, now_ns / NS_PER_S)
        except Forged as error:
            self._forged[key] += 1
            self._refused(f"an order on {key}: {error.reason.replace('_', ' ')}")
            return None
        if not self._is_lasting(key) and abs(now_ns - order.sealed_ns) > AGE_NS_MAX:
            when = "long ago" if now_ns > order.sealed_ns else "in the future"
            self._refused(f"an order on {key}: sealed {when} (by this computer's clock)")
            return None
        self._remember(key, order.payload, payload)
        return order.payload

    def let_out(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What is to go out on `key`; None for an order that no operator has given.

        An order that is said again goes out as the same bytes, which receivers know already.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        sealed = self._sealed.get(payload)
        if sealed is None and self._sealer is not None:
            sealed = self._sealer.seal(payload, now_ns)
            self._remember(key, payload, sealed)
        return sealed

    def _forges(self, key: str, now_ns: int) -> bool:
        """Whether too much that was forged has come on `key` of late."""
        if not 0 <= now_ns - self._forged_ns < FORGED_PERIOD_NS:
            self._forged_ns = now_ns
            self._forged.clear()
        return self._forged[key] >= FORGED_MAX

    def _is_told(self, key: str) -> bool:
        return key.startswith(self._told[0]) and key.endswith(self._told[1])

    def _is_lasting(self, key: str) -> bool:
        """Whether what comes there is said again, by whoever knows it."""
        return key in self._said_again or self._is_told(key)

    def _remember(self, key: str, payload: bytes, sealed: bytes) -> None:
        if not self._is_lasting(key):
            return  # heartbeats would soon be all that is remembered
        if payload in self._sealed:
            self._sealed.move_to_end(payload)
            return
        self._sealed[payload] = sealed
        self._size += len(payload) + len(sealed)
        while self._size > SEALS_BYTES_MAX:
            oldest = self._sealed.popitem(last=False)
            self._size -= sum(map(len, oldest))
