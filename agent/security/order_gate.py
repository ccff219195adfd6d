"""The gate through which sealed orders come in and go out: between the bus and a process (PURE).

Behind it an order is what its codec made, without its seal: the gate opens the seal, and lets nothing in that
is no operator's.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import head
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.agent.security.sealed_order import Forged, Opener, Sealer

AGE_NS_MAX: Final = 2 * NS_PER_S
"""Of what is sent once and not relayed (heartbeats, faults, questions) a seal is not older, nor that much
ahead: who has overheard one cannot use it later. Missions, stops and resumes have versions, and are
relayed."""
SEALS_BYTES_MAX: Final = 2_097_152
"""Of orders that may be relayed: thousands of stops, or some twenty of the largest missions."""
NEW_MAX: Final = 4
NEW_PERIOD_NS: Final = NS_PER_S // 10
"""Within such a period so many seals that one robot relays are verified, and then no more, genuine or not:
to verify one costs ten times as much as to make one up, and old orders can be repeated for nothing. Those
that were verified of late are remembered, and cost nothing. What operators send is always looked at."""
_LASTING: Final = tuple(map(head, (Mission, Stop, Resume)))
"""How the orders begin that robots relay (`agent.messages.codec`)."""


class OrderGate:
    """Opens what comes as an order, and puts its seal on what goes out as one.

    Args:
        fleet: its name.
        robots: ids of its robots.
        opener: of that fleet.
        sealer: of the operator whose process this is, None for those who only pass on what operators said.
        refused: called with a few words for each order that is not let in.
    """

    def __init__(
        self,
        fleet: str,
        robots: Iterable[int],
        opener: Opener,
        sealer: Sealer | None,
        refused: Callable[[str], None],
    ) -> None:
        self._orders: Final = frozenset(
            key(fleet)
            for key in (
                key_expressions.mission,
                key_expressions.stop,
                key_expressions.resume,
                key_expressions.faults,
                key_expressions.heartbeat,
                key_expressions.ask,
            )
        )
        self._relayed: Final = frozenset(key_expressions.relayed(fleet, robot) for robot in robots)
        self._like_relayed: Final = tuple(key_expressions.relayed(fleet, "*").split("*"))
        self._opener, self._sealer, self._refused = opener, sealer, refused
        self._sealed: OrderedDict[bytes, bytes] = OrderedDict()
        self._size = 0
        self._new: Counter[str] = Counter()
        self._new_ns = 0

    def is_order(self, key: str) -> bool:
        """Whether only what an operator has sealed is let through on `key`."""
        before, after = self._like_relayed
        return key in self._orders or (key.startswith(before) and key.endswith(after))

    def let_in(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What came on `key`, opened if it is an order; None when it is not let in.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        is_relayed = key in self._relayed
        if not is_relayed and key not in self._orders:
            self._refused("an order where no robot of the fleet relays any")  # whoever sent it chose the key
            return None
        if is_relayed and not self._opener.has_verified(payload) and self._is_too_much(key, now_ns):
            self._refused(f"an order on {key}: after too many that were new")
            return None
        try:
            order = self._opener.open(payload, now_ns / NS_PER_S)
        except Forged as error:
            self._refused(f"an order on {key}: {error.reason.replace('_', ' ')}")
            return None
        lasts = order.payload.startswith(_LASTING)
        if is_relayed and not lasts:
            self._refused(f"an order on {key}: not one that robots relay")
            return None
        if not lasts and abs(now_ns - order.sealed_ns) > AGE_NS_MAX:
            when = "long ago" if now_ns > order.sealed_ns else "in the future"
            self._refused(f"an order on {key}: sealed {when} (by this computer's clock)")
            return None
        self._remember(order.payload, payload)
        return order.payload

    def let_out(self, key: str, payload: bytes, now_ns: int) -> bytes | None:
        """What is to go out on `key`; None for an order that no operator has given.

        An order that is relayed goes out as the same bytes, which receivers may have verified already.

        Args:
            now_ns: the present, wall time.
        """
        if not self.is_order(key):
            return payload
        sealed = self._sealed.get(payload)
        if sealed is None and self._sealer is not None:
            sealed = self._sealer.seal(payload, now_ns)
            self._remember(payload, sealed)
        if sealed is None:
            self._refused(f"to say an order on {key}: the operator's seal of it is no longer known here")
        return sealed

    def seal_of(self, payload: bytes) -> bytes | None:
        """The sealed order that these bytes came in, None where that is no longer known."""
        return self._sealed.get(payload)

    def recall(self, sealed: bytes) -> bytes:
        """The order that was let in once, and kept since as it came: relayed again it goes out so.

        Raises:
            Forged: it is none of an operator's, or not one that lasts.
        """
        payload = self._opener.open_recorded(sealed).payload
        if not payload.startswith(_LASTING):
            raise Forged("malformed", "not an order that lasts")
        self._remember(payload, sealed)
        return payload

    def _is_too_much(self, key: str, now_ns: int) -> bool:
        """Counts a seal that is new; whether too many of these have come on `key` of late."""
        if not 0 <= now_ns - self._new_ns < NEW_PERIOD_NS:
            self._new_ns = now_ns
            self._new.clear()
        self._new[key] += 1
        return self._new[key] > NEW_MAX

    def _remember(self, payload: bytes, sealed: bytes) -> None:
        if not payload.startswith(_LASTING):
            return  # heartbeats would soon be all that is remembered
        if payload in self._sealed:
            self._sealed.move_to_end(payload)
            return
        self._sealed[payload] = sealed
        self._size += len(payload) + len(sealed)
        while self._size > SEALS_BYTES_MAX:
            oldest = self._sealed.popitem(last=False)
            self._size -= sum(map(len, oldest))
