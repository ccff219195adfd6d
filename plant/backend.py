"""The contract of a plant: one body, simulated or real, behind one method."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from agent.hand import Pose


class Command(NamedTuple):
    """Force (N, along the heading) and torque (N m) asked of a body."""

    force: float
    torque: float


class Reading(NamedTuple):
    """What a plant knows of its body.

    `time_ns` (wall clock) is when `pose` was true, not when it was read. `force` (N) and `torque`
    (N m) act on the body from then on. `healthy` is False when the pose must not be used and
    `note` then says why. The pose of a simulated body is exact: `plant.measurement` adds what
    its sensors get wrong.
    """

    time_ns: int
    pose: Pose
    force: float
    torque: float
    healthy: bool = True
    note: str = ""


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
