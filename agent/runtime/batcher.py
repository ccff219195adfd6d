"""What a router does for the messages of a large fleet: it passes them on in batches, one a round.

Everybody hears the beacon of everybody, and each message costs whom it reaches some 40 us, mostly to wake for
it: of 200 robots that would be all that two processors have. A batch costs as much as one message, and those
that hear it take what is in it at their next tick anyway: so what is said in a round goes out before the next
round, and is no older then than if each had come by itself. Where all robots share a machine their hand
states go the same way (`Fleet.batches_hands`): a robot that hears ten others would else wake ten times in a
round.

Of several routers the one with the least name does so; when it goes, the next. No two have to agree: what
comes twice is known already. Who gets no batches listens to each robot (`agent.transport.batches`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import next_tick_ns
from handfast.agent.messages import batch, key_expressions
from handfast.agent.transport.batches import SAID_NS

AT: Final = 0.8
"""Batches of a round go out after so large a part of the period: agents have said what they say by then,
those of a crowd in the first half (`agent.links.ticks`), and it is there before the next round."""
LATE_AT: Final = 0.95
"""Hand states of loops that were late go out then. Beacons wait for the next round: everybody wakes for
them."""


class Tokens(Protocol):
    """The part of an `agent.transport.bus.Presence` that is needed; members as there."""

    alive: set[str]

    def update(self) -> object: ...


class Client(Protocol):
    """What is needed of an `agent.transport.bus.Bus` that is a client of the router; members as there."""

    @property
    def name(self) -> str: ...

    def listen(self, subscriptions: Sequence[str]) -> None: ...

    def drain(self) -> Sequence[tuple[str, bytes]]: ...

    def declare(self, key: str) -> None: ...

    def publish(self, key: str, payload: bytes) -> None: ...

    def announce(self, key: str) -> None: ...

    def watch(self, key: str, is_known: Callable[[str], object]) -> Tokens: ...


class Batcher:
    """Passes on the beacons of `fleet` for one router.

    Args:
        client: of that router.
        now_ns: wall clock.

    Attributes:
        due_ns: when `look` is to be called next, wall clock.
    """

    def __init__(self, fleet: Fleet, client: Client, now_ns: int) -> None:
        name, period_ns = fleet.fleet.name, fleet.period_ns
        self._client, self._period_ns, self._robots = client, period_ns, len(fleet.robots)
        # Agents tick half a period in.
        self._phase_ns, self._late_phase_ns = (
            round((0.5 + at) * period_ns) % period_ns for at in (AT, LATE_AT)
        )
        self._each = [key_expressions.beacon(name, "*")]
        self._beacons = key_expressions.beacon_batch(name)
        self._batch_of = {key_expressions.beacon(name, robot): (self._beacons, robot) for robot in fleet.ids}
        client.declare(self._beacons)
        self._hands = fleet.batches_hands
        if self._hands:
            hands = key_expressions.hand_batch(name)
            self._each.append(key_expressions.hand(name, "*"))
            self._batch_of |= {key_expressions.hand(name, robot): (hands, robot) for robot in fleet.ids}
            client.declare(hands)
        self._own = key_expressions.router_alive(name, client.name)
        self._routers = client.watch(key_expressions.router_alive(name, "*"), key_expressions.router_of_alive)
        client.announce(self._own)
        self._said: dict[str, list[tuple[int, bytes]]] = {key: [] for key, _ in self._batch_of.values()}
        """By the key of the batch: what has come since it went out."""
        self._leads = False
        self._said_ns = now_ns - SAID_NS
        self.due_ns = self._next_ns(now_ns)

    def _next_ns(self, now_ns: int) -> int:
        due_ns = next_tick_ns(now_ns, self._period_ns, self._phase_ns)
        if not self._hands:
            return due_ns
        return min(due_ns, next_tick_ns(now_ns, self._period_ns, self._late_phase_ns))

    def look(self, now_ns: int) -> None:
        """Sends what has come, when it is due."""
        if self.due_ns - self._period_ns <= now_ns < self.due_ns:  # else the clock has been set
            return
        is_late = self._hands and self.due_ns % self._period_ns == self._late_phase_ns
        self.due_ns = self._next_ns(now_ns)
        self._routers.update()
        leads = min(self._routers.alive, default=self._own) >= self._own
        if leads is not self._leads:
            self._leads = leads
            self._client.listen(self._each if leads else [])
        for key, payload in self._client.drain():
            if (found := self._batch_of.get(key)) is not None:
                self._said[found[0]].append((found[1], payload))
        for key, said in self._said.items():
            if is_late and key == self._beacons:
                continue
            if said or (key == self._beacons and now_ns - self._said_ns >= SAID_NS):
                self._say(key, said, now_ns)

    def _say(self, key: str, said: list[tuple[int, bytes]], now_ns: int) -> None:
        if key == self._beacons:
            self._said_ns = now_ns
        if self._leads:
            for each in batch.packed(said, self._robots):
                self._client.publish(key, each)
        said.clear()
