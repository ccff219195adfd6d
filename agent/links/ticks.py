"""When a node ticks, by its own clock: on the fleet's grid, or late where a fault rule wants it (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from agent.common import random_streams
from agent.links.fault_plan import FaultPlan
from agent.messages import key_expressions


def next_tick_ns(now_ns: int, period_ns: int, phase_ns: int) -> int:
    """The first tick after `now_ns`: ticks lie on one grid of the wall clock for every process."""
    return (now_ns - phase_ns) // period_ns * period_ns + period_ns + phase_ns


class Ticked(Protocol):
    """The part of a node that `Ticks` needs; members as those of `agent.node.Node`."""

    @property
    def plan(self) -> FaultPlan: ...

    @property
    def period_ns(self) -> int: ...

    @property
    def phase_ns(self) -> int: ...

    @property
    def alive_keys(self) -> Sequence[str]: ...


class Deadlines(Protocol):
    """When whatever a loop drives ticks; members as those of `Ticks`."""

    due_ns: int

    @property
    def epoch_ns(self) -> int | None: ...

    def take(self, now_ns: int) -> tuple[int, int, int]: ...

    def plan(self, tick_ns: int) -> None: ...


class Ticks:
    """When a node ticks, by its own clock: at deadlines on the grid, or later where a rule wants it.

    What drives a node waits until `due_ns`, asks `take` which time to tick it with, ticks it, calls `plan`.

    Args:
        node: of one robot.
        now_ns: the node's clock now; its first deadline is the next of the grid.

    Attributes:
        due_ns: time of the next tick.
    """

    def __init__(self, node: Ticked, now_ns: int) -> None:
        self._plan: Final = node.plan
        self._node, self._period_ns, self._phase_ns = node, node.period_ns, node.phase_ns
        self._round_ns: Final = node.period_ns
        robot, role = key_expressions.robot_of_alive(node.alive_keys[0]) or (0, "")
        self._robot = robot
        self._stream = random_streams.stream(self._plan.seed, "tick", robot, role)
        self._chosen = random_streams.stream(self._plan.seed, "tick share", robot, role)
        self._changes = -1
        self._jittery = False
        self.plan(now_ns)

    @property
    def epoch_ns(self) -> int | None:
        """The mission's epoch, None before the node has a mission."""
        return self._plan.epoch_ns

    def plan(self, tick_ns: int) -> None:
        """Plans the tick after the one at `tick_ns`."""
        self._period_ns, self._phase_ns = self._node.period_ns, self._node.phase_ns
        self._deadline_ns = next_tick_ns(tick_ns, self._period_ns, self._phase_ns)
        plan = self._plan
        if self._changes != plan.changes:
            self._changes = plan.changes
            self._jittery = any(rule.tick_jitter is not None for rule in plan.rules())
        self.due_ns = self._deadline_ns + (self._late_ns() if self._jittery else 0)

    def take(self, now_ns: int) -> tuple[int, int, int]:
        """The time to give a tick that begins at `now_ns`, the number of ticks that are skipped, and by how
        much it is late, ns: later than planned, or by the ticks that are skipped if that is more.

        The time is that which was planned, not `now_ns`: what is decided then does not depend on a
        scheduler. Deadlines that have passed meanwhile are skipped.
        """
        period_ns, tick_ns = self._period_ns, self.due_ns
        late_ns = now_ns - tick_ns
        if late_ns >= period_ns:
            tick_ns += late_ns // period_ns * period_ns
        missed = (tick_ns - self._deadline_ns) // period_ns
        return tick_ns, missed, max(late_ns, missed * period_ns)

    def _late_ns(self) -> int:
        """By how much the next tick comes late: a draw for its round, uniform up to the rule's limit, for as
        many as the rule wants late."""
        plan = self._plan
        most_ns, share = plan.tick_jitter(self._robot, self._deadline_ns)
        number = (self._deadline_ns - self._phase_ns - (plan.epoch_ns or 0)) // self._round_ns
        if share < 1.0 and random_streams.uniform(self._chosen, number) >= share:
            return 0
        return int(most_ns * random_streams.uniform(self._stream, number))
