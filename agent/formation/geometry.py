"""Formation: where every robot's place is and which pairs hold a distance, resolved from the fleet file.

Pure (numpy only). Positions and offsets are in W (world ENU), m; arrays hold one robot or one edge
a row, in the order of the fleet file.

Robot k's place in the file is slot k. With ``assign = true`` robots take slots by the least
total squared distance between their hand points at the start and the slots' places at t = 0.
The formation graph belongs to the slots: edge [1, 2] of the file then joins whichever robots
take the first and the second robot's slot. So the shape and its graph are always the file's,
and only who stands where changes. `resolve` gives offsets in the order of robots and edges
between robots; order and distances of the edges stay the file's.

Without offsets the places are found from the edges and their distances (`agent.formation.realisation`).
The shape is then free to be turned, mirrored and moved: it is centred on the reference point
and turned (mirrored) so that the robots have the least to drive (Procrustes).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, sin
from typing import Any

import numpy as np

from handfast.agent.common.quantities import Vector
from handfast.agent.fleet.model import Fleet, FormationError
from handfast.agent.fleet.sections import Robot
from handfast.agent.formation.points import (
    Floats,
    Indices,
    assign_slots,
    best_turn,
    edge_lengths,
    square_distances,
)
from handfast.agent.formation.realisation import DISTANCE_TOLERANCE, Realisation, realise, worst_edge
from handfast.agent.formation.trajectory import make_trajectory


@dataclass(frozen=True, eq=False)
class Geometry:
    """A resolved formation: robots with the places that they take. Arrays are read-only.

    Attributes:
        ids: members' ids, in the order of the fleet file.
        offsets: (n, 2), place of each robot relative to the reference point c(t), W, m.
        edges: (m, 2), rows of the robots that each edge joins, in the file's order of edges.
        distances: (m,), wanted distance of each edge, m.
    """

    ids: tuple[int, ...]
    offsets: Floats
    edges: Indices
    distances: Floats


_last: tuple[Fleet, Geometry] | None = None
"""What was resolved last in this process: all robots of a fleet in virtual time have the same. By identity,
so that it is of nothing else."""


def resolve(fleet: Fleet) -> Geometry:
    """The formation that the fleet drives: offsets found, distances written out, slots assigned.

    Offsets and distances that the file gives are taken as they are, also where they contradict each
    other (`deploy.check.check` says so); what it does not give comes from the other.

    Raises:
        FormationError: fields that do not fit together (an edge names an unknown robot or joins a robot
            with itself or twice the same pair, numbers of offsets or distances that differ from the
            numbers of robots or edges, neither offsets nor distances, not finite, distances not
            above zero), or distances that no placement in the plane meets within `DISTANCE_TOLERANCE`.
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """
    global _last
    known = _last
    if known is None or known[0] is not fleet:
        known = _last = fleet, _resolve(fleet)
    return known[1]


def _resolve(fleet: Fleet) -> Geometry:
    ids = tuple(robot.id for robot in fleet.members)
    edges = edge_indices(fleet)
    offsets = given_offsets(fleet)
    distances = given_distances(fleet)
    hands = start_hands(fleet)
    x, y = make_trajectory(fleet.trajectory).at(0.0)[:2]
    starts = hands - (x, y)  # as seen from the reference; sums of squares do not depend on it
    slots = np.arange(len(ids))
    if offsets is not None:
        if distances is None:
            distances = edge_lengths(offsets, edges)
        if fleet.formation.assign:
            slots = np.array(assign_slots(square_distances(starts, offsets)), np.intp)
    elif distances is not None:
        shape = realise(len(ids), edges, distances, fleet.formation.safe_distance_m)
        _refuse_misfit(fleet, shape, distances)
        offsets, slots = _place(shape.offsets, starts, fleet.formation.assign)
    else:
        raise FormationError("formation needs offsets, distance_m, or both: neither is given")
    robot_of_slot = np.empty(len(ids), np.intp)
    robot_of_slot[slots] = np.arange(len(ids))
    return Geometry(
        ids, _frozen(offsets[slots]), _frozen(robot_of_slot[edges]), _frozen(np.array(distances, np.float64))
    )


def resolved(fleet: Fleet) -> Fleet:
    """The same fleet with its formation written out, so that robots need not resolve it again.

    Offsets in the order of robots, edges by the robots that take their slots, one distance an edge,
    ``assign = false``. Nothing is rounded: `resolve` of the result is the same geometry.

    Raises:
        FormationError, ValueError: as `resolve`.
    """
    geometry = resolve(fleet)
    ids = geometry.ids
    formation = replace(
        fleet.formation,
        offsets=tuple((float(x), float(y)) for x, y in geometry.offsets),
        edges=tuple((ids[i], ids[j]) for i, j in geometry.edges.tolist()),
        distance_m=tuple(geometry.distances.tolist()),
        assign=False,
    )
    return replace(fleet, formation=formation)


def edge_indices(fleet: Fleet) -> Indices:
    """Edges of the file as rows of [[robot]], (m, 2), before any assignment.

    Raises:
        FormationError: ids not unique, an edge with an unknown robot, with itself, or listed twice.
    """
    members = fleet.members
    row = {robot.id: k for k, robot in enumerate(members)}
    if not members:
        raise FormationError("the fleet has no [[robot]] that is not in reserve")
    if len(row) != len(members):
        raise FormationError("robot.id must be unique")
    seen: set[frozenset[int]] = set()
    for i, j in fleet.formation.edges:
        for robot in (i, j):
            if robot not in row:
                raise FormationError(
                    f"formation.edges: [{i}, {j}] names robot {robot}, which does not exist, or is in reserve"
                )
        if i == j:
            raise FormationError(f"formation.edges: [{i}, {j}] joins a robot with itself")
        if frozenset((i, j)) in seen:
            raise FormationError(f"formation.edges: [{i}, {j}] is listed twice")
        seen.add(frozenset((i, j)))
    return np.array([(row[i], row[j]) for i, j in fleet.formation.edges], np.intp).reshape(-1, 2)


def given_offsets(fleet: Fleet) -> Floats | None:
    """The file's offsets, (n, 2), m, slot by slot; None when it gives none (a single robot's is zero)."""
    if fleet.formation.offsets is None:
        return np.zeros((1, 2)) if len(fleet.members) == 1 else None
    offsets = np.array(fleet.formation.offsets, np.float64).reshape(-1, 2)
    if len(offsets) != len(fleet.members):
        raise FormationError(f"formation.offsets has {len(offsets)} places for {len(fleet.members)} robots")
    if not np.isfinite(offsets).all():
        raise FormationError("formation.offsets must be finite")
    return offsets


def given_distances(fleet: Fleet) -> Floats | None:
    """The file's distances, (m,), m, one an edge; None when it gives none."""
    wanted = fleet.formation.distance_m
    if wanted is None:
        return None
    edges = len(fleet.formation.edges)
    distances = np.full(edges, wanted) if isinstance(wanted, int | float) else np.array(wanted, np.float64)
    if distances.shape != (edges,):
        raise FormationError(f"formation.distance_m has {len(distances)} distances for {edges} edges")
    if not (np.isfinite(distances).all() and (distances > 0.0).all()):
        raise FormationError(f"formation.distance_m must be above zero, not {wanted}")
    return distances


def start_hands(fleet: Fleet) -> Floats:
    """Hand points of the members at the start, (n, 2), W, m."""
    return np.array([start_hand(robot) for robot in fleet.members]).reshape(-1, 2)


def start_hand(robot: Robot) -> Vector:
    """Hand point of a robot at the start, W, m: x + L cos, y + L sin, (2)-(3)."""
    reach, heading = robot.hand_offset_m, robot.heading_rad
    return robot.x_m + reach * cos(heading), robot.y_m + reach * sin(heading)


def _refuse_misfit(fleet: Fleet, shape: Realisation, distances: Floats) -> None:
    if not len(distances):
        return
    worst = worst_edge(shape, distances)
    if abs(shape.error[worst]) <= DISTANCE_TOLERANCE * distances[worst]:
        return
    i, j = fleet.formation.edges[worst]
    raise FormationError(
        f"formation.distance_m: found no places in the plane that meet all {len(distances)} distances; in "
        f"the nearest [{i}, {j}] is {distances[worst] + shape.error[worst]:.4g} m long instead of "
        f"{distances[worst]:.4g} m "
        f"(root mean square over all edges {np.sqrt(np.mean(shape.error**2)):.3g} m)"
    )


def _place(shape: Floats, starts: Floats, assign: bool) -> tuple[Floats, Indices]:
    """Turn (and mirror) a centred shape so that the robots have the least to drive; and their slots.

    With `assign`, turning and assigning take turns until nothing changes, which lowers the total
    squared distance each time; from several angles, as it ends in a local minimum.
    """
    n = len(shape)
    slots = np.arange(n)
    if not assign:
        return best_turn(shape, starts), slots
    best, best_cost = (best_turn(shape, starts), slots), np.inf
    angles = max(1, min(8, 160 // max(n, 1)))
    for start in range(2 * angles):
        angle = np.pi * 2.0 * (start // 2) / angles
        turned = shape @ np.array([[cos(angle), sin(angle)], [-sin(angle), cos(angle)]])
        if start % 2:
            turned[:, 0] *= -1.0
        for _ in range(20):
            new = np.array(assign_slots(square_distances(starts, turned)), np.intp)
            moved = np.empty_like(starts)
            moved[new] = starts
            turned = best_turn(shape, moved)
            cost = float(np.sum((moved - turned) ** 2))
            if cost < best_cost * (1.0 - 1e-12):
                best, best_cost = (turned, new), cost
            if np.array_equal(new, slots):
                break
            slots = new
    return best


def _frozen(array: Any) -> Any:
    array.setflags(write=False)
    return array
