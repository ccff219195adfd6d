"""Robots that drive, are not at their places, and do not come nearer (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

PATIENCE_S: Final = 3.0
"""Who has not come nearer for so long lags."""
NEARER: Final = 0.9
"""Share of its distance to which a robot has to have come to be nearer."""


class Lagging:
    """Watches how far robots are from their places."""

    def __init__(self) -> None:
        self._since: dict[int, tuple[float, float]] = {}
        """Since when (s) a robot has not come nearer, and how far it was then (m)."""

    def look(self, time_s: float, distances_m: Mapping[int, float], allowed_m: float) -> list[int]:
        """Those that lag, the farthest first.

        Args:
            distances_m: of each robot that drives from its place.
            allowed_m: who is nearer than this is there.
        """
        for robot in self._since.keys() - distances_m.keys():
            del self._since[robot]
        found = []
        for robot, distance_m in distances_m.items():
            since_s, was_m = self._since.get(robot, (time_s, distance_m))
            if distance_m <= allowed_m:
                self._since.pop(robot, None)
                continue
            if distance_m < NEARER * was_m:
                since_s, was_m = time_s, distance_m
            self._since[robot] = since_s, was_m
            if time_s - since_s > PATIENCE_S:
                found.append((-round(distance_m, 2), robot))
        return [robot for _, robot in sorted(found)]
