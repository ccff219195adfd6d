"""A robot's radio of limited rate: a queue for all that it says to others, and one for all it hears (PURE).

What `network.emulate_budget` switches on. As with tbf and red of tc(8) on an interface: messages of all
links wait for one another, with what is put round them on the way (`agent.links.wire_size`); where many wait,
some are dropped by chance. What a robot says waits in its own agent: it is published when it has left. What
it hears waits there, too, before any fault rule. The finest step is a control period: a message that leaves
before the next tick leaves at once, for nobody looks sooner.

Operators' orders that robots relay take their time on the radio, but wait for nobody and are never dropped,
as with fault rules. What goes to an operator is left alone: he is to see what happens.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

from agent.common import random_streams
from agent.common.time import NS_PER_S
from agent.fleet.model import Fleet
from agent.links.fault_plan import FaultPlan
from agent.links.wire_size import acknowledged_bytes, carried_bytes, joined_bytes
from agent.messages import key_expressions
from agent.messages.types import Outgoing

T = TypeVar("T")


class RateQueue:
    """A queue that leaves at a rate, and drops by chance where it is long.

    Random early detection (S. Floyd, V. Jacobson, 1993), by the queue as it is: up to half of the longest
    wait none is dropped, from there on the more the longer it is. A queue that drops what comes while it is
    full would drop the same every time, for robots speak at fixed moments: some would never be heard.

    Args:
        bits_per_second: the rate.
        longest_ns: nothing waits longer.
        stream: of draws, one for each message.
    """

    def __init__(self, bits_per_second: float, longest_ns: int, stream: int) -> None:
        self._ns_per_byte = 8.0 * NS_PER_S / bits_per_second
        self._longest_ns = longest_ns
        self._stream = stream
        self._count = 0
        self._free_ns = 0

    def occupy(self, now_ns: int, size: float) -> int:
        """So many bytes leave, whatever waits; when they have left, if they wait for all before them."""
        self._free_ns = max(self._free_ns, now_ns) + round(size * self._ns_per_byte)
        return self._free_ns

    def leaves_ns(self, now_ns: int, size: float) -> int | None:
        """When a message of so many bytes that comes now has left; None: it is dropped."""
        self._count += 1
        half_ns = self._longest_ns / 2
        over = (self._free_ns - now_ns - half_ns) / half_ns
        if over > 0.0 and random_streams.uniform(self._stream, self._count) < over:
            return None
        return self.occupy(now_ns, size)


DROPPED: Final = -1
AT_ONCE: Final = 0


class Radio(Generic[T]):
    """The radio of robot `robot` of `fleet`, which has a `network.budget`.

    Attributes:
        dropped_up, dropped_down: messages that were dropped, of those that it said and heard.
    """

    def __init__(self, fleet: Fleet, robot: int) -> None:
        network, name = fleet.network, fleet.fleet.name
        assert network.budget is not None
        longest_ns = round(network.budget_queue_s * NS_PER_S)
        seed = FaultPlan(fleet).seed

        def queue(way: str) -> RateQueue:
            stream = random_streams.stream(seed, "radio", robot, way)
            return RateQueue(network.budget or 1.0, longest_ns, stream)

        self._up, self._down = queue("up"), queue("down")
        self._period_ns = fleet.period_ns
        self._secured, self._routed = fleet.is_secured, fleet.is_routed
        self._others = len(fleet.ids) - 1
        self._key_hand = key_expressions.hand(name, robot)
        self._key_beacon = key_expressions.beacon(name, robot)
        self._key_relayed = key_expressions.relayed(name, robot)
        self._leaving: deque[tuple[int, Outgoing]] = deque()
        self._waiting: deque[tuple[int, T]] = deque()
        self._speakers: set[int] = set()
        self._since_ns: int | None = None
        self.dropped_up = self.dropped_down = 0

    def counted(self) -> dict[str, int]:
        """What was dropped so far, as a status says it."""
        return {"radio.dropped.said": self.dropped_up, "radio.dropped.heard": self.dropped_down}

    # ------------------------------------------------------------------ what the robot says

    def send(self, now_ns: int, outgoing: Sequence[Outgoing], listeners: int) -> list[Outgoing]:
        """What to publish at the tick `now_ns`, of what the robot wants to say and of what has waited.

        Args:
            listeners: robots that listen to its hand states.
        """
        until_ns = now_ns + self._period_ns
        out: list[Outgoing] = []
        opened = 0  # links on which something goes in this tick
        for each in outgoing:
            key, payload = each
            if key == self._key_hand:
                copies = listeners
            elif key in (self._key_beacon, self._key_relayed):
                copies = self._others
            else:
                out.append(each)
                continue
            if self._routed:
                copies = min(copies, 1)
            alone = max(0, copies - opened)
            opened = max(opened, copies)
            size = alone * carried_bytes(len(payload), self._secured)
            size += (copies - alone) * joined_bytes(len(payload))
            self._down.occupy(now_ns, alone * acknowledged_bytes(len(payload), self._secured))
            if key == self._key_relayed:
                self._up.occupy(now_ns, size)
                out.append(each)
                continue
            leaves_ns = self._up.leaves_ns(now_ns, size)
            if leaves_ns is None:
                self.dropped_up += 1
            else:
                self._leaving.append((leaves_ns, each))
        while self._leaving and self._leaving[0][0] <= until_ns:
            out.append(self._leaving.popleft()[1])
        return out

    # ------------------------------------------------------------------ what it hears

    def hear(self, now_ns: int, source: int, payload: bytes, what: T) -> int:
        """When a message that came since the last tick has been received, ns; it comes by `heard` then.

        `AT_ONCE` where it is to be taken now, `DROPPED` where it is not.
        """
        since_ns = self._before(now_ns)
        leaves_ns = self._down.leaves_ns(since_ns, self._carried(since_ns, source, payload))
        if leaves_ns is None:
            self.dropped_down += 1
            return DROPPED
        if leaves_ns <= now_ns and not self._waiting:
            return AT_ONCE
        self._waiting.append((leaves_ns, what))  # behind what came before
        return leaves_ns

    def hear_order(self, now_ns: int, source: int, payload: bytes) -> None:
        """An order came that another robot relays: it waits for nobody."""
        since_ns = self._before(now_ns)
        self._down.occupy(since_ns, self._carried(since_ns, source, payload))

    def _before(self, now_ns: int) -> int:
        """The tick before the one at `now_ns`: what came since then may have come at once."""
        return now_ns - self._period_ns if self._since_ns is None else self._since_ns

    def _carried(self, now_ns: int, source: int, payload: bytes) -> float:
        """Bytes that a message takes: one that comes with another of its sender has no headers of its own."""
        if source in self._speakers:
            return joined_bytes(len(payload))
        self._speakers.add(source)
        self._up.occupy(now_ns, acknowledged_bytes(len(payload), self._secured))
        return carried_bytes(len(payload), self._secured)

    def heard(self, now_ns: int) -> list[T]:
        """What has been received at the tick `now_ns`, the earliest first."""
        self._since_ns = now_ns
        self._speakers.clear()
        out = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            out.append(self._waiting.popleft()[1])
        return out
