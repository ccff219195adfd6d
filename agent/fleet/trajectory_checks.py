"""Checks across the fields of a trajectory: valid field by field, but not together (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import entries
from handfast.agent.common.wording import show
from handfast.agent.fleet.sections import TRAJECTORY_FIELDS, TrajectorySection


def check_trajectory(
    trajectory: Mapping[str, Any], raw: Mapping[str, Any], reader: Reader, place: str = "trajectory"
) -> None:
    """Adds to `reader` what is wrong with a trajectory's values, which were read from the table `raw`."""
    kind = trajectory.get("kind")
    if kind is None:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in needed:
        if key not in raw:
            example = entries(TrajectorySection)[key].setting.example
            reader.add(
                f"{place}.{key}", f'is missing: kind = "{kind}" needs it, for example {key} = {example}'
            )
    for key, kinds in kinds_by_field().items():
        if key in raw and key not in (*needed, *taken):
            users = " and ".join(f'kind = "{name}"' for name in kinds)
            reader.add(f"{place}.{key}", f'is used by {users} only, but here kind = "{kind}": leave it out')
    if kind == "waypoints" and trajectory.get("waypoints_m") is not None:
        points = trajectory["waypoints_m"]
        if len(points) < 2:
            reader.add(f"{place}.waypoints_m", f"must have at least 2 points, got {len(points)}")
        for number in range(1, len(points)):
            if points[number] is not None and points[number] == points[number - 1]:
                reader.add(
                    f"{place}.waypoints_m[{number + 1}]",
                    f"{show(points[number])} is the point before it again",
                )


def kinds_by_field() -> dict[str, list[str]]:
    """Kinds of trajectory that have a field, by its name."""
    kinds: dict[str, list[str]] = {}
    for kind, (needed, taken) in TRAJECTORY_FIELDS.items():
        for key in (*needed, *taken):
            kinds.setdefault(key, []).append(kind)
    return kinds
