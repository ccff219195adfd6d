"""The contract between the sans-IO core of a process on the bus and whatever drives it.

Three cores fulfil it, `agent.core.Agent`, `plant.node.PlantNode` and `plant.pool.PlantPool`, which is several
of those; two drivers use it, `agent.runtime.loop.loop` (real time, Zenoh) and `deploy.simulate.simulation`
(virtual time).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol

from handfast.agent.common.time import MachineClock
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages.types import Outgoing

INBOX_SIZE: Final = 64
"""Messages that wait for a node's tick, per subscription; the newest are kept."""
EACH: Final = 2
"""So many of each robot wait at least, where all of them may speak on one subscription."""

TOLD_SHARE: Final = 4
"""A tick that begins later than this part of a period is told that it is late."""


def inbox_size(subscription: str, robots: int) -> int:
    """How many messages wait on a subscription in a fleet of so many robots."""
    return max(INBOX_SIZE, EACH * robots) if "*" in subscription else INBOX_SIZE


class Node(Protocol):
    """A sans-IO core that ticks at a fixed rate. All times are wall-clock nanoseconds."""

    @property
    def plan(self) -> FaultPlan:
        """The fault rules of the file and of operators."""
        ...

    @property
    def period_ns(self) -> int:
        """Time between two ticks, which may be another after each. Ticks come at multiples of the period plus
        `phase_ns`."""
        ...

    @property
    def phase_ns(self) -> int:
        """Offset of the ticks from the multiples of the period; a plant's changes when it follows another
        clock."""
        ...

    @property
    def alive_keys(self) -> Sequence[str]:
        """Keys of the liveliness tokens that stand for this process: one for each robot that it serves."""
        ...

    @property
    def subscriptions(self) -> Sequence[str]:
        """Keys to listen to, another object when they have changed; ``*`` in one stands for any robot.

        What waits is taken in their order.
        """
        ...

    @property
    def watched(self) -> Sequence[str]:
        """Key expressions of the liveliness tokens whose changes `present` takes, another object when they
        have changed; none overlap."""
        ...

    @property
    def publications(self) -> Sequence[str]:
        """Keys that `tick` may publish on."""
        ...

    @property
    def condition(self) -> tuple[str, str]:
        """State in one word, and the reason for it ("" when there is nothing to say); for logs."""
        ...

    @property
    def rejected(self) -> Mapping[str, int]:
        """How many messages were not valid, by reason."""
        ...

    @property
    def done(self) -> bool:
        """True when, after `end`, the process may end."""
        ...

    @property
    def lasting(self) -> tuple[bytes, ...]:
        """The operators' orders, encoded, that must outlive the process; another object when they have
        changed."""
        ...

    def recall(self, now_ns: int, orders: Sequence[bytes]) -> None:
        """Takes, before the first tick, the orders that were kept when the process ran last; from now on
        an order is kept when `kept` says so. Not called where nothing is kept."""
        ...

    def kept(self, orders: tuple[bytes, ...], trouble: str) -> None:
        """Takes that `orders`, which `lasting` was, are on the disk, or why they cannot be."""
        ...

    def runs_by(self, clock: MachineClock) -> None:
        """Takes the clock of the process; not called in virtual time, where all have one."""
        ...

    def late(self, now_ns: int, late_ns: int) -> None:
        """Takes that the tick at `now_ns` begins so much after its deadline, before what came meanwhile is
        received. Not called for less than `TOLD_SHARE` of a period."""
        ...

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus; never raises for what it holds."""
        ...

    def present(self, key: str, here: bool) -> None:
        """Takes a change of presence: the process of a watched token came (`here`) or went."""
        ...

    def deaf_to(self, now_ns: int) -> Sequence[int]:
        """Robots from which nothing comes though others hear them: their links are opened anew, where they
        are this process's. Asked a few times a second; not in virtual time, where there are no links."""
        ...

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """Takes that a link is opened anew; `what` says which, and why."""
        ...

    def tick(self, now_ns: int) -> list[Outgoing]:
        """Does one tick and returns what to publish, most urgent first."""
        ...

    def timed(self, duration_ns: int, missed: int) -> None:
        """Takes, after each tick, how long it took from draining to encoding, and how many were skipped."""
        ...

    def end(self) -> None:
        """Begins to end: comes to a safe state, and says so by `done`."""
        ...
