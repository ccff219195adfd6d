"""The table of a fleet file about how a robot's processes run on their computer (PURE).

Robots need not agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from handfast.agent.common.settings import setting

LINKS_PRIORITY: Final = 40
"""SCHED_FIFO priority of the threads that carry messages. The kernel's own threads that serve interrupts have
50 (PREEMPT_RT)."""
PRIORITIES: Final = {"agent": LINKS_PRIORITY + 1, "plant": LINKS_PRIORITY + 2}
"""SCHED_FIFO priority of a process's own loop. A plant is above its agent, since it brakes where that is
late."""


@dataclass(frozen=True, slots=True)
class ProcessSection:
    """``[process]``: how agents, plants and bridges run on their computers."""

    realtime: bool = setting(
        False,
        "Agents, plants and bridges run before everything else on their computer: under SCHED_FIFO, with "
        "their memory locked (Linux). What a computer refuses is said, and they run on without it "
        "(docs/operating.md).",
    )
    cpus: tuple[int, ...] = setting(
        (),
        "`realtime`: cores on which they run, by the kernel's numbers. Left out: all that there are.",
        ge=0,
        le=1023,
        example="[2, 3]",
    )
