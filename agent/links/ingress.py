"""What a node hears over links that may fail: the part that agents and plants have in common (PURE).

It keeps the node's fault plan up to date, passes messages through `agent.links.link_emulator`, and publishes
what was done: every decision (`LinkTrace`), and the live rules that are held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

from agent.common.time import NS_PER_S
from agent.fleet.model import Fleet
from agent.links.fault_plan import FaultPlan
from agent.links.link_emulator import Arrival, LinkEmulator, Sample
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.types import FUTURE_NS_MAX, Faults, Outgoing

HELD_PERIOD_NS: Final = NS_PER_S
"""Live rules that are held are published again so often."""


class Ingress:
    """The incoming links of the agent or the plant of robot `robot`.

    Args:
        sources: by topic (`agent.messages.types.TOPICS`), the robots whose messages come here.

    Attributes:
        subscriptions, publications: keys that the node needs for it.
        idle: True while nothing happens to any message: then `take` and `arrivals` need not be called.
    """

    def __init__(
        self, fleet: Fleet, robot: int, role: Literal["agent", "plant"], sources: Mapping[str, Sequence[int]]
    ) -> None:
        name = fleet.fleet.name
        self.plan: Final = FaultPlan(fleet)
        self._links = LinkEmulator(self.plan, robot, sources)
        self.key_faults: Final = key_expressions.faults(name)
        self._key_trace = (
            key_expressions.links(name, robot)
            if role == "agent"
            else key_expressions.plant_links(name, robot)
        )
        self._key_held = key_expressions.faults_held(name, robot, role)
        self.subscriptions: Final = (self.key_faults,)
        self.publications: Final = (self._key_trace, self._key_held)
        self._said: dict[str, Faults] = {}
        self._held_due_ns: int | None = None

    @property
    def idle(self) -> bool:
        return self._links.idle

    def begin(self, epoch_ns: int) -> None:
        """Begins a mission: the times of the file's rules count from `epoch_ns`, wall time."""
        self.plan.begin(epoch_ns)
        self._links.refresh()

    def accept(self, message: Faults, now_ns: int) -> str | None:
        """Takes live rules; returns why they are refused (`FaultPlan.take`)."""
        before = self._versions()
        reason = self.plan.take(message, now_ns)
        self._links.refresh()
        if self._versions() != before:
            self._held_due_ns = now_ns
        return reason

    def _versions(self) -> set[tuple[str, int]]:
        return {(held.message.author, held.message.version) for held in self.plan.live}

    def take(
        self,
        now_ns: int,
        key: str,
        payload: bytes,
        topic: int,
        message: Sample,
        own_position: tuple[float, float] | None = None,
    ) -> bool:
        """True when a message that has come is to be delivered at once; else it is lost, or comes later.

        Args:
            topic: index into `agent.messages.types.TOPICS`.
            own_position: (x, y), m, W, for a range channel.

        A message from the future is delivered, to be refused: waiting for its time, it would keep the
        link's queue from all others.
        """
        if message.time_ns > now_ns + FUTURE_NS_MAX:
            return True
        return self._links.take(key, payload, topic, message, own_position)

    def arrivals(self, now_ns: int) -> list[Arrival]:
        """Messages whose time has come at the tick `now_ns`."""
        return self._links.due(now_ns)

    def outgoing(self, now_ns: int, *, flush: bool = False) -> list[Outgoing]:
        """What to publish at the tick `now_ns` of what was done to messages, and of live rules.

        `flush` keeps no decision back for a fuller message: there may be no other tick.
        """
        if self._held_due_ns is None and self._links.idle:
            return []
        out: list[Outgoing] = []
        if self._held_due_ns is not None:
            if self.plan.expire(now_ns):
                self._links.refresh()
                self._held_due_ns = now_ns
            if now_ns >= self._held_due_ns:
                out += self._held(now_ns)
        if not self._links.idle:
            out += [(self._key_trace, encode(message)) for message in self._links.traced(now_ns, flush=flush)]
        return out

    def _held(self, now_ns: int) -> list[Outgoing]:
        """The live sets that are held, and for each that is no more an empty one of its author."""
        live = {held.message.author: held.message for held in self.plan.live}
        gone = [
            Faults(max(message.version, self.plan.ended(author)), now_ns, author, message.origin_ns, 1, "")
            for author, message in self._said.items()
            if author not in live
        ]
        self._said = live
        self._held_due_ns = now_ns + HELD_PERIOD_NS if live else None
        return [(self._key_held, encode(message)) for message in (*live.values(), *gone)]
