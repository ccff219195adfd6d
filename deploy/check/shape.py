"""Does the formation fit together: graph, distances and offsets, rigidity, the places where robots start."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from handfast.agent.fleet.model import Fleet, FormationError
from handfast.agent.formation.geometry import Geometry, edge_indices, given_distances, given_offsets
from handfast.agent.formation.points import Floats, components, connected, edge_lengths
from handfast.agent.formation.realisation import DISTANCE_TOLERANCE
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.analysis.shapes import is_collinear, is_rigid, loose, rigidity_rank
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.safety import start_points
from handfast.deploy.console.wording import NAMES_SHOWN, robots, some

SAFE_SHARE: Final = 0.8
"""r_s / d above which phi' = 1 / (d - r_s) makes the constraint very stiff."""


def check_structure(fleet: Fleet) -> Iterator[Finding]:
    """What must hold before a formation can be resolved."""
    try:
        edges = edge_indices(fleet)
        offsets = given_offsets(fleet)
        distances = given_distances(fleet)
    except FormationError as error:
        yield Finding("error", "formation", str(error))
        return
    try:
        make_trajectory(fleet.trajectory)
    except ValueError as error:
        yield Finding("error", "trajectory", str(error).removeprefix("trajectory."))
    parts = components(len(fleet.members), edges)
    if len(parts) > 1:
        ids = [[fleet.members[k].id for k in part] for part in parts]
        shown = ", ".join("{" + some(part) + "}" for part in ids[:NAMES_SHOWN])
        more = f" and {len(ids) - NAMES_SHOWN} more" if len(ids) > NAMES_SHOWN else ""
        yield Finding(
            "info",
            "formation.edges",
            f"the graph is in {len(parts)} parts, {shown}{more}: robots of different parts keep no "
            "distance, but stay out of each other's way",
        )
    if offsets is not None and distances is not None:
        yield from _contradictions(fleet, edge_lengths(offsets, edges), distances)


def _contradictions(fleet: Fleet, lengths: Floats, distances: Floats) -> Iterator[Finding]:
    each = not isinstance(fleet.formation.distance_m, int | float)
    wrong = np.flatnonzero(np.abs(lengths - distances) > DISTANCE_TOLERANCE * distances)
    for k in wrong.tolist():
        i, j = fleet.formation.edges[k]
        yield Finding(
            "error",
            f"formation.distance_m[{k + 1}]" if each else "formation.distance_m",
            f"edge [{i}, {j}] is to be {distances[k]:.4g} m long, but its offsets are {lengths[k]:.4g} m "
            "apart: navigation and constraint would work against each other; leave distance_m out (it then "
            "comes from the offsets) or correct one of them",
        )


def unplaced(message: str) -> str:
    """The finding's text for a formation without places that meet its distances."""
    return (
        message.removeprefix("formation.distance_m: ")
        + "; correct the distances, leave an edge out, or give offsets"
    )


def check_shape(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """The formation itself: safe distance, rigidity."""
    ids, offsets, edges, distances = geometry.ids, geometry.offsets, geometry.edges, geometry.distances
    safe = fleet.formation.safe_distance_m
    if len(distances):
        k = int(np.argmin(distances))
        least = float(distances[k])
        i, j = (ids[end] for end in edges[k].tolist())
        if least <= safe:
            yield Finding(
                "error",
                "formation.safe_distance_m",
                f"{safe:.4g} m, but edge [{i}, {j}] is to be {least:.4g} m long: phi (7) needs a safe "
                f"distance below every distance, at best below {SAFE_SHARE * least:.3g} m",
            )
        elif safe > SAFE_SHARE * least:
            yield Finding(
                "warning",
                "formation.safe_distance_m",
                f"{safe:.4g} m is {safe / least:.0%} of the shortest edge, [{i}, {j}] with {least:.4g} m: "
                f"phi' = 1/(d - r_s) = {1.0 / (least - safe):.3g} 1/m there, a very stiff constraint that "
                f"small errors excite; take at most {SAFE_SHARE * least:.3g} m, or longer edges",
            )
    joined = {frozenset(edge) for edge in edges.tolist()}
    both = "they cannot both stand there" if fleet.avoidance.enabled else "no constraint keeps them apart"
    for i, j, apart in _closer(offsets, safe):
        if frozenset((i, j)) in joined:
            continue
        yield Finding(
            "error",
            "formation.offsets" if fleet.formation.offsets is not None else "formation.distance_m",
            f"robots {ids[i]} and {ids[j]} share no edge and their places are {apart:.3g} m apart, below the "
            f"safe distance {safe:.4g} m: {both}; move the places or join them by an edge",
        )
    if fleet.formation.offsets is None and len(distances):
        lengths = edge_lengths(offsets, edges)
        misfit = np.abs(lengths / distances - 1.0)
        if misfit.max() > 1e-4:
            k = int(np.argmax(misfit))
            i, j = (ids[end] for end in edges[k].tolist())
            yield Finding(
                "info",
                "formation.distance_m",
                f"the distances do not quite fit together: edge [{i}, {j}] is to be {distances[k]:.6g} m "
                f"long and comes to {lengths[k]:.6g} m; the rest stays as a small error, unless they are "
                "given more precisely",
            )
    yield from _rigidity(geometry)


def _rigidity(geometry: Geometry) -> Iterator[Finding]:
    n = len(geometry.ids)
    if n < 2 or is_rigid(geometry.offsets, geometry.edges):
        return
    if not connected(n, geometry.edges):
        return  # `check_structure` says it
    ids = [geometry.ids[k] for k in loose(geometry.offsets, geometry.edges)]
    shift = f"{robots(ids)} can shift, seen from the others, with every distance kept"
    rank = rigidity_rank(geometry.offsets, geometry.edges)
    if is_collinear(geometry.offsets):
        yield Finding(
            "warning",
            "formation.edges",
            f"all places are in one line, which no set of edges makes rigid: to first order {shift}. "
            "Across the line only navigation (c1, c2) holds the robots; place one robot off the line for a "
            "rigid shape",
        )
        return
    yield Finding(
        "warning",
        "formation.edges",
        f"the distances do not fix the shape (rank {rank} of {2 * n - 3}): {shift}; there only navigation "
        f"(c1, c2) holds the shape. At least {2 * n - 3 - rank} more "
        f"edge{'s' if 2 * n - 3 - rank > 1 else ''} to these robots would fix it",
    )


def check_starts(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Hand points at the start that are closer than the safe distance."""
    safe = fleet.formation.safe_distance_m
    joined = {frozenset((geometry.ids[i], geometry.ids[j])) for i, j in geometry.edges.tolist()}
    for i, j, apart in _closer(start_points(fleet), safe):
        a, b = fleet.ids[i], fleet.ids[j]
        edge = frozenset((a, b)) in joined
        where = f"robots {a} and {b} start with their hand points {apart:.3g} m apart"
        if edge:
            yield Finding(
                "error",
                f"robot[{j + 1}]",
                f"{where}; they share an edge and must start more than the safe distance {safe:.4g} m "
                "apart: below it phi has the wrong sign. Move or turn one of them (the hand point is "
                "hand_offset_m ahead)",
            )
        else:
            parted = (
                "and avoidance has to part them first"
                if fleet.avoidance.enabled
                else "so the law does not part them"
            )
            yield Finding(
                "warning",
                f"robot[{j + 1}]",
                f"{where}, less than the safe distance {safe:.4g} m; they share no edge, {parted}: move one "
                "of them",
            )


def _closer(points: Floats, limit: float) -> Iterator[tuple[int, int, float]]:
    """Pairs of points at most `limit` apart, and their distance."""
    i, j = np.triu_indices(len(points), 1)
    apart = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
    for k in np.flatnonzero(apart <= limit).tolist():
        yield int(i[k]), int(j[k]), float(apart[k])
