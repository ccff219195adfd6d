"""Does `[process]` ask for what can be had of real time."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from handfast.agent.fleet.model import Fleet
from handfast.deploy.check.finding import Finding


def check_realtime(fleet: Fleet) -> Iterator[Finding]:
    """What has no effect."""
    if fleet.process.cpus and not fleet.process.realtime:
        yield Finding("info", "process.cpus", "nobody asks for it: process.realtime is false")


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
