"""The table of a fleet file about how a robot's processes run on their computer (PURE).

Robots need not agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from handfast.agent.common.settings import setting

ABOVE_LINKS: Final = {"agent": 1, "plant": 2}
"""How far above that of the threads that carry its messages the priority of a process's own loop is. A plant
is above its agent: it is what brakes where the agent is late."""


@dataclass(frozen=True, slots=True)
class ProcessSection:
    """``[process]``: how agents, plants and bridges run on their computers."""

    realtime: bool = setting(
        False,
        "Agents, plants and bridges run before everything else on their computer: under SCHED_FIFO, with "
        "their memory locked (Linux). What a computer refuses is said, and they run on without it "
        "(docs/operating.md).",
    )
    priority: int = setting(
        40,
        "`realtime`: priority of the threads that carry messages; an agent's loop has one more, a plant's "
        "two. Below 50, which the kernel's own threads have that serve interrupts (PREEMPT_RT).",
        ge=1,
        le=99 - max(ABOVE_LINKS.values()),
    )
    cpus: tuple[int, ...] = setting(
        (),
        "`realtime`: cores on which they run, by the kernel's numbers. Left out: all that there are.",
        ge=0,
        le=1023,
        example="[2, 3]",
    )

    def priority_of(self, role: str) -> int:
        """The priority that the loop of an ``agent`` or ``plant`` is to have."""
        return self.priority + ABOVE_LINKS[role]

    @property
    def priority_max(self) -> int:
        """The highest priority of any of its threads: what a computer has to grant."""
        return self.priority + max(ABOVE_LINKS.values())
