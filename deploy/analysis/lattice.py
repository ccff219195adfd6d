"""A fleet file of a triangular lattice of any size: what large fleets are studied with (pure)."""

from __future__ import annotations

from collections.abc import Iterable
from math import hypot, sqrt
from random import Random
from textwrap import fill
from typing import Final

ROBOTS_MIN: Final = 3
ROBOTS_MAX: Final = 1000
SIDE_M: Final = 1.0
REACH_M: Final = 1.1 * SIDE_M
"""Robots are joined by an edge whose places are nearer: the six next to each, and no others."""
ASPECT: Final = 0.93
"""Columns of a patch that is as wide as high are so many times the root of the robots."""
SCATTER_M: Final = 0.15
SEED: Final = 1
RATE_HZ: Final = 10.0
DURATION_S: Final = 60.0
TIMEOUT_S: Final = 0.2
TIMEOUT_PERIODS: Final = 3.0
"""Agent and plant wait so long for each other, and so many periods at least."""
FALLING_HZ: Final = 8.0
"""From this rate on the fleet can fall to half of it (4 Hz is the lowest to which any can,
`agent.control.limits`). Many robots of one machine need that: where it is late, and the fleet cannot fall to
a lower rate, all stand."""
FALLING_PERIODS: Final = 4.5
"""Then agent and plant wait so many periods for each other: two of the lower rate, and a little more."""
SPEED_M: Final = 0.15
"""Robots go so far in a period of the lowest rate at most: those that may be faster listen to each other from
further away."""
KP: Final = 1.0
KP_BY_HZ: Final = 0.125
"""Slower robots are pulled into shape less: else they may fold it (docs/theory.md)."""


def places(robots: int) -> list[tuple[float, float]]:
    """The places (x, y) of a patch that is about as wide as high, row by row from the top, around (0, 0)."""
    columns = max(1, round(ASPECT * sqrt(robots)))
    rough = []
    for k in range(robots):
        row, column = divmod(k, columns)
        # Of a last row that is not full, even its first robot hangs on two of the row above.
        shift = 0.5 if row % 2 else float(robots - row * columns < columns)
        rough.append((SIDE_M * (column + shift), -SIDE_M * sqrt(0.75) * row))
    middle_x, middle_y = (sum(values) / robots for values in zip(*rough, strict=True))
    return [(round(x - middle_x, 4), round(y - middle_y, 4)) for x, y in rough]


def edges(spots: list[tuple[float, float]]) -> list[tuple[int, int]]:
    """Numbers (from 1) of those whose places are next to each other."""
    return [
        (i + 1, j + 1)
        for i, (x, y) in enumerate(spots)
        for j, (u, v) in enumerate(spots[i + 1 :], i + 1)
        if hypot(x - u, y - v) < REACH_M
    ]


def lattice(
    name: str, robots: int, *, rate_hz: float = RATE_HZ, duration_s: float = DURATION_S, seed: int = SEED
) -> str:
    """The text of a fleet file: `robots` in a lattice of 1 m that drives round a circle.

    Each starts within `SCATTER_M` of its place in x and in y, drawn from `seed`, and heads east.
    """
    spots, random = places(robots), Random(seed)
    joined = edges(spots)
    falls = rate_hz >= FALLING_HZ
    lowest_hz = 0.5 * rate_hz if falls else rate_hz
    timeout_s = max(TIMEOUT_S, (FALLING_PERIODS if falls else TIMEOUT_PERIODS) / rate_hz)
    limits = f"\nrate_min_hz = {lowest_hz:g}" if falls else ""
    limits += f"\nmax_speed_mps = {SPEED_M * lowest_hz:g}" if lowest_hz < RATE_HZ else ""
    rows = []
    for number, (x, y) in enumerate(spots, 1):
        at = x + random.uniform(-SCATTER_M, SCATTER_M), y + random.uniform(-SCATTER_M, SCATTER_M)
        rows.append(f"    {{ id = {number}, x_m = {at[0]:.3f}, y_m = {at[1]:.3f} }},")
    return f"""\
# {robots} robots in a triangular lattice of {SIDE_M:g} m, each tied to those next to it, on a circle.
#
#     handfast check {name}.toml       what is wrong with it, what it will do, and what it costs
#     handfast simulate {name}.toml    drive it in virtual time, however many there are
#     handfast run {name}.toml         drive it as processes on this machine
#
# Every field is described in docs/fleet-file.md.

# One line per robot, to keep the file short: the same as {robots} [[robot]] tables.
robot = [
{chr(10).join(rows)}
]

[fleet]
name = "{name}"
description = "{robots} robots in a triangular lattice, on a circle"
rate_hz = {rate_hz:g}
duration_s = {duration_s:g}

[formation]
safe_distance_m = 0.22
distance_m = {SIDE_M:g}
offsets = [
{_lines(f"[{x}, {y}]" for x, y in spots)}
]
edges = [
{_lines(f"[{i}, {j}]" for i, j in joined)}
]

[control]
coupling = "joint"
kp = {min(KP, KP_BY_HZ * rate_hz):g}
plant_timeout_s = {timeout_s:g}
wrench_timeout_s = {timeout_s:g}{limits}

[trajectory]
kind = "circle"
centre_m = [0.0, 4.0]
radius_m = 4.0
speed_mps = 0.3
phase_rad = "-90deg"  # starts at the origin, amid the robots

[robot_defaults]
hand_offset_m = 0.15  # one that is nearer to the axle would turn too fast for low rates
"""


def _lines(items: Iterable[str]) -> str:
    """Items of an array, as many on a line as are read at a glance."""
    text = ", ".join(item.replace(" ", "\0") for item in items) + ","
    return fill(text, 100, initial_indent="    ", subsequent_indent="    ").replace("\0", " ")
