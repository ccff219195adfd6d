"""The plants of several robots in one process, sans-IO: each as it would be in one of its own (PURE).

A simulator of many robots is one process: bodies that share one are stepped from warm caches, and take one
place on the bus, and one turn on a processor, for all of them. On the bus nothing tells it from as many
processes: every robot's plant has its own keys, its own token and its own watchdog.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from handfast.agent.common.time import MachineClock
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.ticks import Ticks
from handfast.agent.messages.types import Outgoing
from handfast.agent.node import INBOX_SIZE, TOLD_SHARE
from handfast.plant.node import PlantNode


class Pooled:
    """One plant of a pool, and what waits for its next tick; `log` writes a line of its log."""

    def __init__(self, node: PlantNode, log: Callable[[str], None]) -> None:
        self.node: Final = node
        self._log = log
        self._said = ""
        self._inbox: Final = {key: deque[bytes](maxlen=INBOX_SIZE) for key in node.subscriptions}

    def put(self, key: str, payload: bytes) -> None:
        """Has a message wait for the tick, with the newest of its key."""
        self._inbox[key].append(payload)

    def tick(self, now_ns: int, late_ns: int) -> list[Outgoing]:
        """Takes its messages, by key in the order of its subscriptions as a bus drains them, and ticks; by
        what `Ticks.take` gave."""
        node = self.node
        if late_ns * TOLD_SHARE > node.period_ns:
            node.late(now_ns, late_ns)
        for key, waiting in self._inbox.items():
            while waiting:
                node.receive(now_ns, key, waiting.popleft())
        out = node.tick(now_ns)
        state, why = node.condition
        if state != self._said:  # reasons alone may change often
            self._said = state
            self._log(f"{state}: {why}" if why else state)
        return out


Turn = tuple[Pooled, int, int]
"""A plant that ticks, and what `Ticks.take` gave for it: the time, and how late it is."""


class PlantPool:
    """The plants `nodes` as one `agent.node.Node`. `PoolTicks` has to drive it.

    Its lasting orders are those that all of its plants have taken.

    Args:
        logs: of each, writes a line of its log: one for each change of what it does.
    """

    def __init__(self, nodes: Sequence[PlantNode], logs: Sequence[Callable[[str], None]]) -> None:
        self.pooled: Final = [Pooled(node, log) for node, log in zip(nodes, logs, strict=True)]
        self._takers: Final[dict[str, list[Pooled]]] = {}
        for each in self.pooled:
            for key in each.node.subscriptions:
                self._takers.setdefault(key, []).append(each)
        self._turns: Sequence[Turn] = []
        self.plan: Final[FaultPlan] = nodes[0].plan
        self.period_ns: Final = nodes[0].period_ns
        self.phase_ns: Final = 0
        self.alive_keys: Final = tuple(key for node in nodes for key in node.alive_keys)
        self.subscriptions: Final = tuple(self._takers)
        self.publications: Final = tuple(key for node in nodes for key in node.publications)
        self.watched: Final[tuple[str, ...]] = ()
        self._lasting: tuple[bytes, ...] = ()
        self.condition: Final = ("serving", f"the plants of {len(nodes)} robots")

    @property
    def lasting(self) -> tuple[bytes, ...]:
        """See `agent.node.Node`."""
        first = self.pooled[0].node.lasting
        if first is not self._lasting and all(each.node.lasting == first for each in self.pooled):
            self._lasting = first
        return self._lasting

    @property
    def rejected(self) -> Mapping[str, int]:
        """Of all of them together."""
        found: Counter[str] = Counter()
        for each in self.pooled:
            found.update(each.node.rejected)
        return found

    @property
    def done(self) -> bool:
        """Whether all are."""
        return all(each.node.done for each in self.pooled)

    def end(self) -> None:
        """Has all of them brake from now on."""
        for each in self.pooled:
            each.node.end()

    def runs_by(self, clock: MachineClock) -> None:
        """Takes the clock of the process."""
        for each in self.pooled:
            each.node.runs_by(clock)

    def recall(self, now_ns: int, orders: Sequence[bytes]) -> None:
        """Gives each plant what was kept."""
        for each in self.pooled:
            each.node.recall(now_ns, orders)

    def kept(self, orders: tuple[bytes, ...], trouble: str) -> None:
        """Nothing, as of a plant."""

    def present(self, key: str, here: bool) -> None:
        """Nothing: a plant watches nobody's presence."""

    def deaf_to(self, now_ns: int) -> Sequence[int]:
        """Nobody, as of a plant."""
        return ()

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """Nothing: the log says it."""

    def late(self, now_ns: int, late_ns: int) -> None:
        """Nothing: each plant is told with its own tick."""

    def timed(self, duration_ns: int, missed: int) -> None:
        """Nothing: the loop counts what is missed, and says it at the end."""

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        """Has a message wait for the next tick of each plant that listens to its key."""
        for each in self._takers.get(key, ()):
            each.put(key, payload)

    def take(self, turns: Sequence[Turn]) -> None:
        """Which plants tick with the next `tick`."""
        self._turns = turns

    def tick(self, now_ns: int) -> list[Outgoing]:
        """Ticks those whose turn it is, each with the time that was planned for it."""
        out: list[Outgoing] = []
        for plant, tick_ns, late_ns in self._turns:
            out += plant.tick(tick_ns, late_ns)
        return out


class PoolTicks:
    """When a pool ticks: whenever one of its plants does, by `Ticks` of its own. As `Ticks` to a loop, with
    the same arguments."""

    def __init__(self, pool: PlantPool, now_ns: int, slot_ns: int = 0) -> None:
        self._pool = pool
        self._each: Final = [(plant, Ticks(plant.node, now_ns, slot_ns)) for plant in pool.pooled]
        self._taken: list[tuple[Ticks, int]] = []
        self._find_next()

    @property
    def epoch_ns(self) -> int | None:
        """The mission's epoch, None before there is a mission."""
        return self._each[0][1].epoch_ns

    def take(self, now_ns: int) -> tuple[int, int, int]:
        """As `Ticks.take`, of the plant that was to tick first; tells the pool who ticks now."""
        turns: list[Turn] = []
        taken: list[tuple[int, int, int]] = []
        self._taken = []
        for plant, ticks in self._each:
            if ticks.due_ns <= max(now_ns, self.due_ns):
                found = tick_ns, _, late_ns = ticks.take(now_ns)
                taken.append(found)
                turns.append((plant, tick_ns, late_ns))
                self._taken.append((ticks, tick_ns))
        self._pool.take(turns)
        return min(taken)

    def plan(self, tick_ns: int) -> None:
        """Plans the next tick of those that have ticked."""
        for ticks, taken_ns in self._taken:
            ticks.plan(taken_ns)
        self._find_next()

    def _find_next(self) -> None:
        self.due_ns = min(ticks.due_ns for _, ticks in self._each)
