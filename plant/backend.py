"""The contract of a plant: one body, simulated or real, behind one method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from agent.control.hand import Pose


class Command(NamedTuple):
    """Force (N, along the heading) and torque (N m) asked of a body."""

    force: float
    torque: float


class Reading(NamedTuple):
    """What a plant knows of its body.

    `time_ns` (wall clock) is when `pose` was true, not when it was read. `force` (N) and `torque`
    (N m) act on the body from then on. `healthy` is False when the pose must not be used; `obeying` is
    False when it may, but commands do not reach the body, because its operator has it. `note` says why.
    The pose of a simulated body is exact: `plant.measurement` adds what its sensors get wrong.
    """

    time_ns: int
    pose: Pose
    force: float
    torque: float
    healthy: bool = True
    note: str = ""
    obeying: bool = True


WAITING: Final = "waiting for "
"""How `Check.found` begins of what is blocking now and may become good by itself."""


class Check(NamedTuple):
    """One thing to know of a body before it drives: a line of `agent.messages.types.Checks`.

    `level` is one of `agent.messages.types.LEVELS`; `advice` says what to do, "" when there is nothing to do.
    """

    name: str
    level: str
    found: str
    advice: str = ""


class PlantBackend(Protocol):
    """A body. `PlantNode` calls `step` at a fixed rate and decides what is asked of the body."""

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """Brings the body to `now_ns`, then gives it `command`; None means: brake, and stay stopped.

        Never blocks and never raises: what fails makes the reading unhealthy.
        """
        ...

    def close(self) -> None:
        """Lets go of the body, which is left braking."""
        ...

    def clear_to_drive(self) -> None:
        """The fleet was told to drive: by a new mission, or by leave to resume.

        A body that its operator has taken away and given back obeys again only after this.
        """
        return None

    def checks(self, now_ns: int) -> Sequence[Check]:
        """What is to be said of the body before a drive; nothing of a simulated one."""
        return ()
