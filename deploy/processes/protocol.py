"""The processes of a fleet, as who drives it sees them: children of its own, or others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

from handfast.agent.control.hand import Pose
from handfast.agent.runtime.realtime_granted import Granted
from handfast.deploy.faults.process_actions import Action, Process


class Ended(Protocol):
    """A process that has ended of its own."""

    name: str

    def last_lines(self) -> list[str]:
        """The end of its output."""
        ...


class FleetProcesses(Protocol):
    """The processes of a fleet, as who drives it sees them.

    Attributes:
        names: all agents and plants, and how each is called.
        count: of how many processes they are.
        ours: whether they end with the drive: then one that dies ends it, and it ends with a stop in any
            case. Others' are left as they were found when no mission was given.
        begun_s: since when they are started, or waited for (monotonic clock, s).
    """

    @property
    def names(self) -> Mapping[Process, str]: ...

    @property
    def count(self) -> int: ...

    @property
    def ours(self) -> bool: ...

    @property
    def begun_s(self) -> float: ...

    def up(self, robot: int, role: str) -> bool:
        """Whether a process should run."""
        ...

    def look(self, present: Collection[Process], time_s: float | None) -> list[str]:
        """Takes which processes have liveliness tokens, and the fleet time (s; None before the epoch is set);
        gives sentences about processes that came or went."""
        ...

    def deaths(self) -> Sequence[tuple[Ended, str]]:
        """Processes that have ended since the last call without a rule's order, and how."""
        ...

    def lacking(self, members: Collection[int]) -> list[str]:
        """Sentences for the verdict on a drive that ends now: who is not there of those that have a place."""
        ...

    def carry_out(self, action: Action, pose: Pose | None) -> bool:
        """Does what a rule orders; False when nothing was done. `pose`: where the robot's body was seen."""
        ...

    def granted(self) -> Mapping[Process, Granted | None]:
        """What processes have been granted of real time, of those that can be looked at from here."""
        ...

    def resume_all(self) -> None:
        """Lets the processes go on that rules have paused."""
        ...
