"""The paper's delta and a square: places and edges."""

from __future__ import annotations

from math import sqrt

H = sqrt(3.0) / 2.0

DELTA_EDGES = ((1, 2), (1, 3), (2, 3), (2, 4), (2, 5), (3, 5), (3, 6), (4, 5), (5, 6))

DELTA = ((0.0, -2 * H), (-0.5, -H), (0.5, -H), (-1.0, 0.0), (0.0, 0.0), (1.0, 0.0))

SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))

RING = ((0, 1), (1, 2), (2, 3), (3, 0))
