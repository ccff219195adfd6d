"""What one process on the bus is made of: the contract between a sans-IO core and whatever drives it.

Two cores fulfil it, `agent.core.Agent` and `plant.node.PlantNode`; two drivers use it,
`agent.runtime.process.loop` (real time, Zenoh) and `deploy.simulate.simulation` (virtual time).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol

from agent.common import random_streams
from agent.links.fault_plan import FaultPlan
from agent.messages import key_expressions

Outgoing = tuple[str, bytes]
"""A message to publish: its key and its bytes."""


INBOX_SIZE: Final = 64
"""Messages that wait for a node's tick, per subscription; the newest are kept."""


FIRST_ROUND: Final = 1 << 20
"""Number of the message of the mission's first round."""


class SequenceNumbers:
    """Sequence numbers of one topic, which say when: they count rounds from the mission's epoch.

    So the messages of a run and of its simulation bear the same numbers, a process that starts again goes on
    with those of its place, and a skipped tick leaves a gap. Before a mission is known they count from 0.

    Args:
        period_ns, phase_ns: of the sender's ticks (`Node`); a late one has the number of its round.
    """

    def __init__(self, period_ns: int, phase_ns: int = 0) -> None:
        self._period_ns, self._phase_ns = period_ns, phase_ns
        self._epoch_ns: int | None = None
        self._count = 0

    def begin(self, epoch_ns: int) -> None:
        """Told of the mission's epoch (wall time, ns)."""
        self._epoch_ns = epoch_ns

    def next(self, stamp_ns: int) -> int:
        """Number of a message whose content holds at `stamp_ns`; at most one a round."""
        if self._epoch_ns is None:
            self._count += 1
            return self._count - 1
        return self.at(stamp_ns)

    def at(self, stamp_ns: int) -> int:
        """The number that belongs to a time, 0 while no mission is known."""
        if self._epoch_ns is None:
            return 0
        return max(0, FIRST_ROUND + (stamp_ns - self._epoch_ns - self._phase_ns) // self._period_ns)


class Node(Protocol):
    """A sans-IO core that ticks at a fixed rate. All times are wall-clock nanoseconds."""

    @property
    def plan(self) -> FaultPlan:
        """The fault rules that it knows of."""
        ...

    @property
    def period_ns(self) -> int:
        """Time between two ticks. Ticks come at multiples of the period plus `phase_ns`."""
        ...

    @property
    def phase_ns(self) -> int: ...

    @property
    def alive_key(self) -> str:
        """Key of the liveliness token that stands for this process."""
        ...

    @property
    def subscriptions(self) -> Sequence[str]:
        """Keys to listen to, another object when they have changed; ``*`` in one stands for any robot.

        What waits is taken in their order.
        """
        ...

    @property
    def watched(self) -> str:
        """Liveliness tokens to be told of, with wildcards; "" for none."""
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
        """True when, after `leave`, the process may end."""
        ...

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Takes one message off the bus; never raises for what it holds."""
        ...

    def present(self, key: str, here: bool) -> None:
        """Told that the process of a watched token came (`here`) or went."""
        ...

    def tick(self, now_ns: int) -> list[Outgoing]:
        """Does one tick and returns what to publish, most urgent first."""
        ...

    def timed(self, duration_ns: int, missed: int) -> None:
        """Told after each tick how long it took, from draining to encoding, and how many it skipped."""
        ...

    def leave(self) -> None:
        """The process is to end: come to a safe state, then say `done`."""
        ...


def next_tick_ns(now_ns: int, period_ns: int, phase_ns: int) -> int:
    """The first tick after `now_ns`: ticks lie on one grid of the wall clock for every process."""
    return (now_ns - phase_ns) // period_ns * period_ns + period_ns + phase_ns


class Ticks:
    """When a node ticks, by its own clock: at deadlines on the grid, or later where a rule wants it.

    What drives a node waits until `due_ns`, asks `take` for the time to tell it, ticks it and calls `plan`.

    Args:
        now_ns: the node's clock now; its first deadline is the next of the grid.

    Attributes:
        due_ns: time of the next tick.
    """

    def __init__(self, node: Node, now_ns: int) -> None:
        self._plan: Final = node.plan
        self._period_ns, self._phase_ns = node.period_ns, node.phase_ns
        robot, role = key_expressions.robot_of_alive(node.alive_key) or (0, "")
        self._robot = robot
        self._stream = random_streams.stream(self._plan.seed, "tick", robot, role)
        self._changes = -1
        self._jittery = False
        self.plan(now_ns)

    @property
    def epoch_ns(self) -> int | None:
        """The mission's epoch, None while the node knows of none."""
        return self._plan.epoch_ns

    def plan(self, told_ns: int) -> None:
        """Finds the tick after one that was told `told_ns`."""
        self._deadline_ns = next_tick_ns(told_ns, self._period_ns, self._phase_ns)
        plan = self._plan
        if self._changes != plan.changes:
            self._changes = plan.changes
            self._jittery = any(rule.tick_jitter is not None for rule in plan.rules())
        self.due_ns = self._deadline_ns + (self._late_ns() if self._jittery else 0)

    def take(self, now_ns: int) -> tuple[int, int]:
        """The time that a tick is told which begins at `now_ns`, and the number of ticks that are skipped.

        The time is that which was planned, not `now_ns`: what is decided then does not depend on a
        scheduler. Deadlines that have passed meanwhile are skipped.
        """
        period_ns, told_ns = self._period_ns, self.due_ns
        if now_ns >= told_ns + period_ns:
            told_ns += (now_ns - told_ns) // period_ns * period_ns
        return told_ns, (told_ns - self._deadline_ns) // period_ns

    def _late_ns(self) -> int:
        """By how much the next tick comes late: a draw for its round, uniform up to the rule's limit."""
        plan = self._plan
        most_ns = plan.tick_jitter_ns(self._robot, self._deadline_ns)
        since_ns = self._deadline_ns - self._phase_ns - (plan.epoch_ns or 0)
        return int(most_ns * random_streams.uniform(self._stream, since_ns // self._period_ns))
