"""Does `[process]` ask for what can be had of real time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.process_section import ProcessSection
from handfast.deploy.check.finding import Finding

OF_KERNEL: Final = 50
"""Priority of the kernel's own threads that serve interrupts, where they are threads (PREEMPT_RT)."""


def check_realtime(fleet: Fleet) -> Iterator[Finding]:
    """What has no effect, and what goes before interrupts are served."""
    process, default = fleet.process, ProcessSection()
    if not process.realtime:
        for name in ("priority", "cpus"):
            if getattr(process, name) != getattr(default, name):
                yield Finding("info", f"process.{name}", "nobody asks for it: process.realtime is false")
    elif process.priority_max >= OF_KERNEL:
        most = OF_KERNEL - 1 - (process.priority_max - process.priority)
        yield Finding(
            "warning",
            "process.priority",
            f"{process.priority}: plants get {process.priority_max}, and go before the kernel's threads that "
            f"serve interrupts, which have {OF_KERNEL} (PREEMPT_RT); give at most {most}",
        )


def check_cores(fleet: Fleet, there: Collection[int]) -> Iterator[Finding]:
    """Which of the cores that robots are to have a computer has not.

    Args:
        there: numbers of those that it has.
    """
    wanted = set(fleet.process.cpus)
    if fleet.process.realtime and (missing := sorted(wanted - set(there))):
        from handfast.agent.runtime.realtime_granted import cores  # here: other fleets need none of it

        left = sorted(wanted & set(there))
        kept = f"would have {cores(left)} alone" if left else "would be kept to none"
        yield Finding(
            "warning",
            "process.cpus",
            f"this machine has no {cores(missing)}: robots on it {kept}; it has {cores(sorted(there))}",
        )
