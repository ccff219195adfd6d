"""What a fleet has driven until now, for pages that come later (PURE)."""

from __future__ import annotations

from typing import Final

import numpy as np

from handfast.agent.formation.points import Floats

BYTES_MAX: Final = 16_000_000
"""Some ten minutes of 6 robots in full; what is longer is thinned."""


class History:
    """Rows of numbers over time: all of them, or, when these would be too many, every second, fourth, ...

    Args:
        width: numbers of a row.
        bytes_max: the most that all rows take, float32.
    """

    def __init__(self, width: int, bytes_max: int = BYTES_MAX) -> None:
        self._most = max(2, bytes_max // (4 * (width + 1)))
        self._rows = np.empty((min(self._most, 1024), width + 1), dtype="<f4")
        self._count = self._offered = 0
        self.stride = 1
        """Every so many rows that were offered, one is kept."""

    def __len__(self) -> int:
        return self._count

    def add(self, t_s: float, row: Floats) -> None:
        """Takes a row (width,) and its time, s; times ascend."""
        self._offered += 1
        if (self._offered - 1) % self.stride:
            return
        if self._count == self._most:
            self._thin()
            if (self._offered - 1) % self.stride:
                return
        if self._count == len(self._rows):
            more = np.empty((min(self._most, 2 * self._count), self._rows.shape[1]), dtype="<f4")
            more[: self._count] = self._rows[: self._count]
            self._rows = more
        self._rows[self._count, 0] = t_s
        self._rows[self._count, 1:] = row
        self._count += 1

    def _thin(self) -> None:
        kept = self._rows[: self._count : 2].copy()
        self._rows[: len(kept)] = kept
        self._count = len(kept)
        self.stride *= 2

    def clear(self) -> None:
        """Another drive begins."""
        self._count = self._offered = 0
        self.stride = 1

    def content(self) -> bytes:
        """All rows as little-endian float32, the time (s) before each."""
        return self._rows[: self._count].tobytes()
