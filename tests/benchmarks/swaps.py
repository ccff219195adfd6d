"""6, 20 and 45 robots on a circle that all go to the very opposite point, beside ORCA on the same starts.

Their ways all meet in the middle. Without edges, as ORCA knows none, and with edges along the circle, which
pull at robots that cross. The whole chain (plants, messages, agents) in virtual time, on all cores.
"""

from __future__ import annotations

from functools import partial
from math import cos, pi, sin
from typing import Final

import numpy as np

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from tests.benchmarks.arrival import HEADING, Runs, drive, has_orca, line, orca
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.rows import results

SWAPS: Final = ((6, 2.0, 60.0), (20, 4.0, 90.0), (45, 6.0, 150.0))
"""Robots, radius of the circle in m, and for how long they are driven at most, s."""
COUNT: Final = 50
COUNT_QUICK: Final = 3
JITTER: Final = 0.15
"""Share of the way from one robot to the next by which a start is off its even place at most."""
FLEET: Final = """
fleet = {{ name = "swap", duration_s = {duration_s}, seed = {seed} }}
formation = {{ edges = [{edges}], offsets = [{places}], safe_distance_m = 0.22 }}
trajectory = {{ kind = "hold" }}
robot = [{robots}]
"""
REACH: Final = 0.1


def swap(robots: int, radius_m: float, duration_s: float, edges: bool, seed: int) -> Fleet:
    """The fleet of one swap, resolved: hands on the circle, headings at random."""
    draw = np.random.default_rng([seed, robots])
    ids = range(1, robots + 1)
    step = 2.0 * pi / robots
    turns = draw.uniform(0.0, 2.0 * pi) + step * (np.arange(robots) + draw.uniform(-JITTER, JITTER, robots))
    starts = [(radius_m * cos(turn), radius_m * sin(turn)) for turn in turns.tolist()]
    rows = [
        f"{{ id = {n}, x_m = {x - REACH * cos(heading)!r}, y_m = {y - REACH * sin(heading)!r},"
        f" heading_rad = {heading!r}, hand_offset_m = {REACH} }}"
        for n, (x, y), heading in zip(ids, starts, draw.uniform(-pi, pi, robots).tolist(), strict=True)
    ]
    text = FLEET.format(
        duration_s=duration_s,
        seed=seed,
        edges=", ".join(f"[{n}, {n % robots + 1}]" for n in ids) if edges else "",
        places=", ".join(f"[{-x!r}, {-y!r}]" for x, y in starts),
        robots=", ".join(rows),
    )
    return resolved(parse_fleet(text, source="swap.toml"))


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    result, lines = Result(), []
    for robots, radius_m, duration_s in SWAPS:
        for edges in (False, True):
            name = f"{robots} robots{', edges' if edges else ''}"
            fleet = partial(swap, robots, radius_m, duration_s, edges)
            found = results(name, Runs(fleet, drive), count)
            lines.append(line(name, found))
            arrived = sum(each.seconds is not None for each in found)
            closest = min(each.pair_m for each in found)
            result.figures += [
                Figure(f"{name}: swaps that arrive", 100.0 * arrived / count, "%", 100.0, at_most=False),
                Figure(f"{name}: closest pair", closest, "m", 0.22, at_most=False),
            ]
        if has_orca():
            fleet = partial(swap, robots, radius_m, duration_s, False)
            lines.append(line(f"{robots} robots, ORCA", results("ORCA", Runs(fleet, orca), count)))
    result.details += table(("swap", *HEADING), lines)
    result.details.append(f"{count} starts each" + ("" if has_orca() else "; no pyrvo here, so without ORCA"))
    return result
