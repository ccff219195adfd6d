"""What a fleet was to do over the time of a run: places, edges and distances of the missions in force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.mission_plan import PlanError, plan_of
from handfast.agent.formation.points import Floats
from handfast.agent.formation.reference import Reference
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.messages.types import Mission
from handfast.deploy.recording.recording import Recording


class MissionChange(NamedTuple):
    """From `t_s` (fleet time) on another mission held: its version, and in words what it changed."""

    t_s: float
    version: int
    note: str


@dataclass(frozen=True)
class Desired:
    """For k times, n robots (all of the recording) and m edges (all that were ever in force).

    places: (k, n, 2) m, NaN for a robot that has no place. edges: (m, 2) rows of robots. wanted: (k, m) m,
    NaN where the edge is not in force. whole: (k, m), where it is neither coming nor going. mission_version:
    that of the last mission, 0 without one.
    """

    places: Floats
    edges: NDArray[np.int64]
    wanted: Floats
    whole: NDArray[np.bool_]
    changes: tuple[MissionChange, ...] = ()
    mission_version: int = 0


def desired(recording: Recording, geometry: Geometry, grid: Floats) -> Desired:
    """What the fleet was to do at `grid` (k,) s, if it heard what the recording holds.

    A mission that cannot be driven is left out, as agents leave it.
    """
    missions = recording.held_missions
    version = missions[-1].version if missions else 0
    if any(mission.robots or mission.edges or mission.trajectory for mission in missions):
        return _by_course(recording, geometry, grid, missions)
    rows = np.array([recording.ids.index(robot) for robot in geometry.ids], dtype=np.int64)
    trajectory = make_trajectory(recording.fleet.trajectory)
    centre = np.array([trajectory.at(float(t))[:2] for t in grid])
    places = np.full((len(grid), len(recording.ids), 2), np.nan)
    places[:, rows] = centre[:, None, :] + np.asarray(geometry.offsets, dtype=np.float64)[None, :, :]
    edges = rows[np.asarray(geometry.edges, dtype=np.int64).reshape(-1, 2)]
    distances = np.asarray(geometry.distances, dtype=np.float64)
    wanted = np.broadcast_to(distances, (len(grid), len(edges)))
    return Desired(places, edges, wanted, np.ones(wanted.shape, dtype=np.bool_), (), version)


def _by_course(
    recording: Recording, geometry: Geometry, grid: Floats, missions: Sequence[Mission]
) -> Desired:
    fleet, ids, epoch_ns = recording.fleet, recording.ids, recording.epoch_ns or 0
    row = {robot: index for index, robot in enumerate(ids)}
    reference = Reference(fleet, geometry)
    pending = [*reversed(missions)]
    changes: list[MissionChange] = []
    version = 0
    places = np.full((len(grid), len(ids), 2), np.nan)
    columns: dict[tuple[int, int], int] = {}
    cells: list[tuple[int, int, float, bool]] = []
    for k, t in enumerate(grid.tolist()):
        time_ns = epoch_ns + round(t * 1e9)
        while pending and pending[-1].time_ns <= time_ns:
            mission = pending.pop()
            try:
                plan = plan_of(mission, fleet, geometry)
            except PlanError:
                continue
            reference.take(plan)
            if version:
                changes.append(
                    MissionChange(recording.fleet_time_s(plan.from_ns), mission.version, mission.note)
                )
            version = mission.version
        for robot, index in row.items():
            motion = reference.motion(robot, time_ns)
            if motion is not None:
                places[k, index] = motion[:2]
            for edge in reference.edges(robot, time_ns):
                if robot < edge.other:
                    column = columns.setdefault((index, row[edge.other]), len(columns))
                    cells.append((k, column, edge.distance, edge.weight >= 1.0))
    wanted = np.full((len(grid), len(columns)), np.nan)
    whole = np.zeros(wanted.shape, dtype=np.bool_)
    for k, column, distance, is_whole in cells:
        wanted[k, column], whole[k, column] = distance, is_whole
    edges = np.array(list(columns), dtype=np.int64).reshape(-1, 2)
    return Desired(places, edges, wanted, whole, tuple(changes), version)
