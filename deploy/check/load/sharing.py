"""Which simulated bodies of a fleet on this machine share a process (`plant.pool`).

Each robot's agent is a process, and in a small fleet each body is one, too: it can be killed, frozen and
looked at by itself. Of a large one the bodies take a fifth of what the machine has while each has a process,
a place on the bus and turns on a processor, and a twentieth where they share them (docs/architecture.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Final

from handfast.agent.fleet.fault_rules import ACTION_FIELDS, CLOCK_FIELDS
from handfast.agent.fleet.hosts import MESH_ROBOTS_MAX
from handfast.agent.fleet.model import Fleet

STEPS_HZ: Final = 500.0
"""So many steps a second does one process at most: all bodies of a process tick at once, and the last of them
must not be late. A step takes some 0.1 ms."""


def sharing(fleet: Fleet) -> list[tuple[int, ...]]:
    """The robots whose bodies share a process, those of each process together; each of the others has one of
    its own. None do in a fleet that is no larger than a mesh may be, nor in a mesh: what they share listens
    nowhere, and is heard through a router.

    A body that a rule of the file kills, freezes or gives another clock has its own process, as have those
    that are plugins or real.
    """
    if not fleet.is_routed or len(fleet.robots) <= MESH_ROBOTS_MAX:
        return []
    own = _by_rule(fleet)
    simulated = [
        robot.id
        for robot in fleet.robots
        if robot.id not in own and robot.kind.body and not (robot.kind.vehicle or robot.kind.is_plugin)
    ]
    count = ceil(len(simulated) / max(1, int(STEPS_HZ / fleet.fleet.rate_hz)))
    size = ceil(len(simulated) / max(1, count))
    parts = [tuple(simulated[k : k + size]) for k in range(0, len(simulated), max(1, size))]
    return [part for part in parts if len(part) > 1]


def _by_rule(fleet: Fleet) -> set[int]:
    """Robots whose plant's process a rule of the file does something to."""
    found: set[int] = set()
    for rule in fleet.faults.rules:
        named: Sequence[int] = fleet.ids if rule.robots is None else rule.robots
        actions = [getattr(rule, field) for field in rule.given(ACTION_FIELDS)]
        if rule.given(CLOCK_FIELDS) or any(role != "agent" for role in actions):
            found.update(named)
    return found
