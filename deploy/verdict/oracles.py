"""Oracles: what must hold in every run, whatever happens, and what of it did not.

An oracle looks at a whole recording and gives each violation of its rule. One that has nothing to look at
(no obstacle, no process that was killed) does not apply: None.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict import oracles_distance, oracles_drive, oracles_reaction
from handfast.deploy.verdict.violations import Violation


class Oracle(NamedTuple):
    """One of `ORACLES`; `says` is what it holds a run to, in words."""

    name: str
    says: str
    look: Callable[[Recording, Analysis, Fleet], list[Violation] | None]


ORACLES: Final[tuple[Oracle, ...]] = (
    Oracle(
        oracles_distance.SEPARATION,
        "No two hands come nearer to each other than the safe distance.",
        oracles_distance.separation,
    ),
    Oracle(
        "clearance", "No hand comes nearer to an obstacle than the clearance.", oracles_distance.clearance
    ),
    Oracle("geofence", "A robot outside the geofence holds, as soon as it can.", oracles_distance.geofence),
    Oracle(
        "agent_dead",
        "A plant brakes within the wrench timeout when its agent is gone.",
        oracles_reaction.agent_dead,
    ),
    Oracle(
        "plant_dead",
        "An agent is in fault within the plant timeout when its plant is gone.",
        oracles_reaction.plant_dead,
    ),
    Oracle("stopped", "After a stop nothing drives until a resume.", oracles_reaction.stopped),
    Oracle(
        "one_mission",
        "All agents end up with the same mission, and the same last stop or resume.",
        oracles_reaction.one_mission,
    ),
    Oracle("limits", "Speeds, forces and torques stay within the fleet file's.", oracles_drive.limits),
    Oracle(
        "recovery",
        f"{oracles_drive.RECOVERED_S:g} s after the last fault or change, and as long as the way takes that "
        "is left, all are in formation again; beside an agent that is gone for good, who is not says why.",
        oracles_drive.recovery,
    ),
    Oracle(
        "formed",
        "A fleet to which nothing happens is in formation in the end, and where its course has it.",
        oracles_drive.formed,
    ),
    Oracle("errors", "Failing links alone leave no error behind.", oracles_drive.errors),
)


def examine(recording: Recording, analysis: Analysis, fleet: Fleet) -> dict[str, list[Violation] | None]:
    """What every oracle found, in the order of `ORACLES`; None where it does not apply."""
    return {oracle.name: oracle.look(recording, analysis, fleet) for oracle in ORACLES}
