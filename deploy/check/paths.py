"""Where robots are to be, in a fleet's own file: which way leads past or through what."""

from __future__ import annotations

from math import pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.points import Floats
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.analysis.shapes import distances

_CELLS: Final = 256
"""Pieces that a drive is cut into at first."""
_NEAR_M: Final = 0.01
"""Ways are looked at until nothing deeper than this can be missed."""
_CELLS_MAX: Final = 200_000
_BISECTIONS: Final = 20


class Paths:
    """Where each member of a fleet is to be, over the whole drive; later orders are not looked at.

    Raises:
        ValueError: a trajectory that `agent.formation.trajectory` cannot make.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        section = fleet.trajectory
        self.ids, self._offsets = geometry.ids, geometry.offsets
        self._trajectory = make_trajectory(section)
        self._speed = trajectory.maximum_speed(section)
        ends = trajectory.duration(section)
        self.end = min(fleet.fleet.duration_s, ends) if ends is not None else fleet.fleet.duration_s
        if section.kind == "circle" and section.radius_m is not None and self._speed > 0.0:
            self.end = min(self.end, 2.0 * pi * section.radius_m / self._speed)  # it comes round again

    def below(self, boundary: Circle | Polygon, limit: float) -> list[tuple[int, float]]:
        """Ids of members that are to be nearer than `limit` (m) to it at some time, each with the first one.

        Times in s. Between two looks a distance changes by no more than the way driven: so what may be missed
        is looked at again, until it is less than `_NEAR_M`.
        """
        half = 0.5 * self.end / _CELLS
        times = np.append((np.arange(_CELLS) + 0.5) * 2.0 * half, (0.0, self.end))
        who = np.repeat(np.arange(len(self.ids)), len(times))
        when = np.tile(times, len(self.ids))
        first = np.full(len(self.ids), np.inf)
        while len(when):
            away = distances(boundary, self._at(who, when))
            is_below = away < limit
            np.minimum.at(first, who[is_below], when[is_below])
            reach = self._speed * half
            again = ~is_below & (away - reach < limit)
            if reach <= _NEAR_M or 2 * np.count_nonzero(again) > _CELLS_MAX:
                break
            half *= 0.5
            who, when = np.repeat(who[again], 2), np.repeat(when[again], 2)
            when[::2] -= half
            when[1::2] += half
            when = np.clip(when, 0.0, self.end)
        rows = np.flatnonzero(np.isfinite(first))
        last, first = first[rows], np.maximum(first[rows] - self.end / _CELLS, 0.0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (first + last)
            is_below = distances(boundary, self._at(rows, middle)) < limit
            first, last = np.where(is_below, first, middle), np.where(is_below, middle, last)
        return [(self.ids[row], t) for row, t in zip(rows.tolist(), last.tolist(), strict=True)]

    def ends_below(self, boundary: Circle | Polygon, limit: float) -> list[int]:
        """Members whose last place is nearer than `limit` to the boundary."""
        rows = np.arange(len(self.ids))
        away = distances(boundary, self._at(rows, np.full(len(rows), self.end)))
        return [self.ids[row] for row in np.flatnonzero(away < limit).tolist()]

    def _at(self, who: NDArray[np.intp], when: Floats) -> Floats:
        times, back = np.unique(when, return_inverse=True)
        centre = np.array([self._trajectory.at(t)[:2] for t in times.tolist()]).reshape(-1, 2)
        places: Floats = centre[back] + self._offsets[who]
        return places
