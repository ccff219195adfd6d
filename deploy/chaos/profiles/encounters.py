"""Who rolls at whom while robots come together: when to take a vehicle's bridge away, and from whom to cut
everybody else off, so that it matters (PURE). Lengths in m, W.

Robots are taken to make straight for their places, as fast as they may: near enough to aim by. Few of the
moments that are drawn at random matter: of 160 scenarios with such faults none did, where a stranger had
found 8 of 32 by aiming.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import permutations
from math import dist, hypot
from typing import Final, NamedTuple

from agent.common.quantities import Vector

STEP_S: Final = 0.1
DIES: Final = tuple(range(5, 71, 3))
"""In steps: when it dies..."""
CUT_LATER: Final = (2, 5, 8, 11)
"""...and how much later the other one is cut off."""
ROLLS: Final = tuple(range(10, 36))
"""It rolls so long, and is met after a second at least: those that are met before could not have made way."""
MEETS_M: Final = 1.0
GAIN: Final = 0.6
"""1/s: how fast a robot makes for its place, by how far that is."""


class Encounter(NamedTuple):
    """`rolls` dies at `at_s` and rolls at `other`, `apart_m` away then, which may be cut off at `cut_s`."""

    rolls: int
    other: int
    at_s: float
    cut_s: float
    apart_m: float


def encounters(starts: Mapping[int, Vector], places: Mapping[int, Vector], speed: float) -> list[Encounter]:
    """All such, of robots that make from `starts` for `places`, m, at `speed` (m/s) at most."""
    steps = max(DIES) + max(CUT_LATER) + 1
    ways = {robot: list(_way(starts[robot], places[robot], speed, steps)) for robot in starts}
    found = []
    for rolls, other in permutations(ways, 2):
        for at in DIES:
            (x, y), (x1, y1) = ways[rolls][at : at + 2]
            for later in CUT_LATER:
                stands = ways[other][at + later]
                rolled = ((x + k * (x1 - x), y + k * (y1 - y)) for k in ROLLS)
                if dist((x, y), stands) > MEETS_M and any(dist(each, stands) < MEETS_M for each in rolled):
                    times = round(at * STEP_S, 1), round((at + later) * STEP_S, 1)
                    found.append(Encounter(rolls, other, *times, dist((x, y), ways[other][at])))
    return found


def _way(start: Vector, place: Vector, speed: float, steps: int) -> Iterator[Vector]:
    x, y = start
    for _ in range(steps + 1):
        yield x, y
        dx, dy = place[0] - x, place[1] - y
        share = min(GAIN, speed / max(hypot(dx, dy), 1e-9)) * STEP_S
        x, y = x + share * dx, y + share * dy
