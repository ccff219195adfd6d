"""When a node ticks, by its own clock: on the fleet's grid, or late where a fault rule wants it (PURE).

All ticks of a round have the same time. Where a machine has many agents their loops do not wake in the same
instant: each has its slot of a part of the period. The last of so many would else begin as many ticks late,
and a fleet whose ticks begin late falls to a lower rate. What a tick decides is the same, for it goes by its
time, and a message of this round waits for the next (`agent.control.peers.peers.Peers.accept`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from handfast.agent.common import random_streams
from handfast.agent.fleet.hosts import CROWD
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages import key_expressions

AGENTS_SHARE: Final = 0.5
"""The slots of agents lie in so large a part of the period after a round's time."""
AGENTS_NS_MAX: Final = 100_000_000
"""And in no more than this: what comes until a loop wakes is not to look as if it came from the future
(`agent.messages.types.FUTURE_NS_MAX`)."""
PLANTS_SHARE: Final = 0.25
"""Plants wake so large a part of the period after their time, half a period after the agents': so the wrench
of the last slot is there."""


def next_tick_ns(now_ns: int, period_ns: int, phase_ns: int) -> int:
    """The first tick after `now_ns`: ticks lie on one grid of the wall clock for every process."""
    return (now_ns - phase_ns) // period_ns * period_ns + period_ns + phase_ns


def agent_slot_ns(fleet: Fleet, robot: int) -> int:
    """How long after a round's time the loop of the agent of `robot` wakes, ns. `FleetError` when there is no
    such robot."""
    beside = _crowd(fleet, robot)
    if not beside:
        return 0
    last_ns = min(AGENTS_SHARE * fleet.period_ns, AGENTS_NS_MAX)
    return round(last_ns * beside.index(robot) / len(beside))


def plant_slot_ns(fleet: Fleet, robot: int) -> int:
    """The same of its plant, or of the process that its plant shares with others, ns."""
    return round(PLANTS_SHARE * fleet.period_ns) if _crowd(fleet, robot) else 0


def _crowd(fleet: Fleet, robot: int) -> list[int]:
    """The robots of its machine, if they are that many."""
    host = fleet.robot(robot).host
    beside = [each.id for each in fleet.robots if each.host == host]
    return beside if len(beside) > CROWD else []


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
        slot_ns: so long after its time a tick begins, ns.

    Attributes:
        due_ns: when the next tick begins.
    """

    def __init__(self, node: Ticked, now_ns: int, slot_ns: int = 0) -> None:
        self._slot_ns: Final = slot_ns
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
        self.due_ns = self._deadline_ns + self._slot_ns + (self._late_ns() if self._jittery else 0)

    def take(self, now_ns: int) -> tuple[int, int, int]:
        """The time to give a tick that begins at `now_ns`, the number of ticks that are skipped, and by how
        much it is late, ns: later than planned, or by the ticks that are skipped if that is more.

        The time is that which was planned, not `now_ns`: what is decided then does not depend on a
        scheduler. Deadlines that have passed meanwhile are skipped.
        """
        period_ns, tick_ns = self._period_ns, self.due_ns - self._slot_ns
        late_ns = now_ns - self.due_ns
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
