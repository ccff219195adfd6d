"""What a node takes off the bus: the part that agents and plants have in common (PURE).

A message is decoded, must have come on a key and from a robot that may send it, passes a link that may fail
(`agent.links.link_emulator`), and is given to whoever takes it. What was done to messages is published: every
decision (`LinkTrace`), and the live fault rules that are held.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.link_emulator import LinkEmulator
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import FUTURE_NS_MAX, TOPICS, Faults, Message, Outgoing
from handfast.agent.messages.validation import Malformed

HELD_PERIOD_NS: Final = NS_PER_S
"""Live rules that are held are published again so often."""


Accept = Callable[[Any, int], str | None]
"""(message, wall time ns) -> why it is refused, None when it is taken."""
Decode = Callable[[bytes], Message]
"""Bytes -> the message; raises `Malformed`."""


class _Route(NamedTuple):
    """Messages of one class on one key: who takes them; the robot that must have sent them and the topic of
    the link that they pass, if any."""

    accept: Accept
    robot: int | None
    topic: int | None


class Ingress:
    """The incoming links of the agent or the plant of robot `robot`.

    Args:
        sources: by topic (`agent.messages.types.TOPICS`), the robots whose messages come here.
        damaged: called with the key of what is no valid message, and why.
        decoder: makes a message of bytes; None for `agent.messages.codec.decode`.

    Attributes:
        subscriptions, publications: keys that the node needs for it.
        rejected: messages that were refused, by reason.
        position: (x, y) of the own robot, m, W, for range channels; None while not known: they do nothing.
    """

    def __init__(
        self,
        fleet: Fleet,
        robot: int,
        role: Literal["agent", "plant"],
        sources: Mapping[str, Sequence[int]],
        damaged: Callable[[str, Malformed], None] | None = None,
        decoder: Decode | None = None,
    ) -> None:
        name = fleet.fleet.name
        self._decode: Decode = decode if decoder is None else decoder
        self.plan: Final = FaultPlan(fleet)
        self._links = LinkEmulator(self.plan, robot, sources)
        self._damaged = damaged
        self._routes: dict[tuple[str, type[Message]], _Route] = {}
        self.rejected: Final[Counter[str]] = Counter()
        self.position: tuple[float, float] | None = None
        key_faults = key_expressions.faults(name)
        self._key_trace = (
            key_expressions.links(name, robot)
            if role == "agent"
            else key_expressions.plant_links(name, robot)
        )
        self._key_held = key_expressions.faults_held(name, robot, role)
        self.subscriptions: Final[tuple[str, ...]] = (key_faults,)
        self.publications: Final[tuple[str, ...]] = (self._key_trace, self._key_held)
        self._said: dict[str, Faults] = {}
        self._held_due_ns: int | None = None
        self.on(key_faults, Faults, self.accept)

    def on(
        self,
        key: str,
        kind: type[Message],
        accept: Accept,
        *,
        robot: int | None = None,
        topic: str | None = None,
    ) -> None:
        """Messages of this class that come on `key` go to `accept`.

        Args:
            robot: must have sent them; None: anybody may, or they do not say.
            topic: of `TOPICS`: over a link that may fail.
        """
        self._routes[key, kind] = _Route(accept, robot, None if topic is None else TOPICS.index(topic))

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus. What is not valid is counted by its reason and changes nothing."""
        try:
            message = self._decode(payload)
        except Malformed as error:
            self._refuse(key, error)
            return
        route = self._routes.get((key, type(message)))
        reason: str | None
        if route is None:
            reason = "wrong_key"
        else:
            accept, robot, topic = route
            if robot is not None and message.robot != robot:  # type: ignore[union-attr]
                reason = "wrong_key"
            elif topic is None or self._links.idle or self._passes(now_ns, key, payload, topic, message):
                reason = accept(message, now_ns)
            else:
                return
        if reason is not None:
            self.rejected[reason] += 1

    def arrive(self, now_ns: int) -> None:
        """Takes the messages that failing links let through at the tick `now_ns`."""
        if self._links.idle:
            return
        for key, payload, whole in self._links.due(now_ns):
            try:
                message = whole or decode(payload)  # damaged bytes are what the codec must find
            except Malformed as error:
                self._refuse(key, error)
                continue
            self._take(now_ns, key, message)

    def _take(self, now_ns: int, key: str, message: Message) -> None:
        """Gives a message that has waited to whoever takes it."""
        route = self._routes.get((key, type(message)))
        reason = "wrong_key" if route is None else route.accept(message, now_ns)
        if reason is not None:
            self.rejected[reason] += 1

    def _refuse(self, key: str, error: Malformed) -> None:
        self.rejected[error.reason] += 1
        if self._damaged is not None:
            self._damaged(key, error)

    def begin(self, epoch_ns: int) -> None:
        """Begins a mission: the times of the file's rules count from `epoch_ns`, wall time."""
        self.plan.begin(epoch_ns)
        self._links.refresh()

    def moved(self, by_ns: int) -> None:
        """The node's clock is read `by_ns` later from now on."""
        self._links.moved(by_ns)
        if self._held_due_ns is not None:
            self._held_due_ns += by_ns

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

    def _passes(self, now_ns: int, key: str, payload: bytes, topic: int, message: Any) -> bool:
        """True when a message that has come is to be delivered at once; else it is lost, or comes later.

        A message from the future is delivered, to be refused: waiting for its time, it would keep the
        link's queue from all others.
        """
        if message.time_ns > now_ns + FUTURE_NS_MAX:
            return True
        return self._links.take(key, payload, topic, message, self.position)

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
