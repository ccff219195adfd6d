"""CPU and memory of one robot in a fleet of 24 against one of 6, with as many neighbours each.

The formation is a ring: robot k's neighbours are the two before and the two after it, so everyone
has four in a fleet of any size, and what grows is the fleet alone. Both sizes run at a rate that
the machine bears with the larger one, in turns.
"""

from __future__ import annotations

import tempfile
from math import cos, pi, sin
from pathlib import Path
from statistics import median
from typing import Final

from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import ROLES, Cost, measure, start_handfast

SIZES: Final = (6, 24)
TARGET: Final = 1.2
RATE_HZ: Final = 20
SIDE_M: Final = 1.0
REACH: Final = 2
"""Neighbours on each side."""


def ring(robots: int, rate_hz: float = RATE_HZ) -> Fleet:
    """`robots` on a circle, `SIDE_M` apart, each tied to the next two on both sides; starts in place."""
    radius = 0.5 * SIDE_M / sin(pi / robots)
    angles = [2.0 * pi * k / robots for k in range(robots)]
    offsets = [(radius * cos(angle), radius * sin(angle)) for angle in angles]
    edges = [[k + 1, (k + step) % robots + 1] for step in range(1, REACH + 1) for k in range(robots)]
    lines = [
        f'[fleet]\nname = "ring{robots}"\nrate_hz = {rate_hz}\nduration_s = 600',
        "[formation]\nsafe_distance_m = 0.22",
        f"offsets = {[list(offset) for offset in offsets]}",
        f"edges = {edges}",
        '[trajectory]\nkind = "hold"',
    ]
    # A little off its place, so that the law has something to do.
    lines += [f"[[robot]]\nid = {k + 1}\nx_m = {x + 0.05}\ny_m = {y}" for k, (x, y) in enumerate(offsets)]
    return resolved(parse_fleet("\n".join(lines), source=f"ring{robots}"))


def run(options: Options) -> Result:
    times = {"settle_s": 2.0, "window_s": 10.0 if options.quick else 20.0}
    costs: dict[int, list[Cost]] = {size: [] for size in SIZES}
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        for number in range(1 if options.quick else 4):
            for size in SIZES if number % 2 == 0 else SIZES[::-1]:
                place = Path(folder) / f"{size}-{number}"
                costs[size].append(measure(ring(size), place, start_handfast, drive=True, **times))
    small, large = (costs[size] for size in SIZES)
    result = Result()
    ratios = [b.robot / a.robot for a, b in zip(small, large, strict=True)]
    result.figures.append(
        Figure(
            f"CPU per robot, fleet of {SIZES[1]} / {SIZES[0]}",
            median(ratios),
            "",
            TARGET,
            note=f"rounds {' '.join(f'{ratio:.2f}' for ratio in ratios)}",
        )
    )
    for role in ROLES:
        memory = median(b.pss[role] for b in large) / median(a.pss[role] for a in small)
        result.figures.append(Figure(f"memory per {role}, fleet of {SIZES[1]} / {SIZES[0]}", memory))
    rows = []
    for size, found in costs.items():
        ticks = sum(2 * size * RATE_HZ * times["window_s"] for _ in found)
        missed = sum(cost.traffic.agents_missed + cost.traffic.plants_missed for cost in found)
        rows.append(
            [
                f"{size} robots, {2 * REACH} neighbours each",
                *(spread([100.0 * cost.cpu[role] for cost in found]) for role in ROLES),
                *(spread([cost.pss[role] for cost in found]) for role in ROLES),
                f"{100.0 * missed / ticks:.3f}",
                spread([cost.load for cost in found]),
            ]
        )
    heading = [f"at {RATE_HZ} Hz", "agent CPU %", "plant CPU %", "agent MB", "plant MB", "missed %", "load"]
    result.details += table(heading, rows)
    return result
