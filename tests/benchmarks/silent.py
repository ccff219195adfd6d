"""What a tick costs among robots that are not heard: bodies near the delta, which died as the drive began.

*Bodies* have no place and stand; *drivers* had places and edges among themselves, so they may be driving on,
and each has a lane to be heeded. Ticks count from when all have been given up; the time without any silent
robot, in the same drive without them, stands beside it.
"""

from __future__ import annotations

from math import cos, pi, sin
from statistics import median
from typing import Any, Final

import tomli_w

from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path, fleet_text
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.tick import probe

COUNTS: Final = (0, 5, 20)
GIVEN_UP_S: Final = 5.0
RADII_M: Final = (2.2, 3.0)
"""Of two rings round the delta, within the sensing distance of its robots."""


def fleet_among(count: int, *, drivers: bool, duration_s: float) -> Fleet:
    """The delta at rest, and so many robots round it that die at once."""
    delta = parse_fleet(fleet_text(fleet_path("delta")), source="delta")
    geometry = resolved(delta).formation
    offsets = [list(offset) for offset in geometry.offsets or ()]
    edges = [list(edge) for edge in geometry.edges]
    robots: list[dict[str, Any]] = [
        {"id": robot.id, "x_m": x - 0.1, "y_m": y}
        for robot, (x, y) in zip(delta.robots, offsets, strict=True)
    ]
    for k in range(count):
        angle = 2.0 * pi * k / count
        x, y = RADII_M[k % 2] * cos(angle), RADII_M[k % 2] * sin(angle)
        robots.append({"id": 100 + k, "x_m": x - 0.1, "y_m": y, "reserve": not drivers})
        if drivers:
            offsets.append([x, y])
            if k % 2:
                edges.append([99 + k, 100 + k])
    tables = {
        "fleet": {"name": "among", "rate_hz": 50, "duration_s": duration_s},
        "formation": {"edges": edges, "offsets": offsets, "safe_distance_m": 0.22},
        "trajectory": {"kind": "hold"},
        "robot": robots,
        "faults": {"rule": [{"robot": 100 + k, "kill": "agent", "at": 0.1} for k in range(count)]},
    }
    return parse_fleet(tomli_w.dumps(tables), source="among")


def run(options: Options) -> Result:
    duration_s = GIVEN_UP_S + (5.0 if options.quick else 20.0)
    result, rows = Result([]), []
    for drivers in (False, True):
        for count in COUNTS:
            fleet = fleet_among(count, drivers=drivers, duration_s=duration_s)
            timed = probe(duration_s, fleet=fleet)
            ticks = timed.ticks_us[round(GIVEN_UP_S * fleet.fleet.rate_hz) :]
            what = "drivers" if drivers else "bodies"
            rows.append(
                [what, str(count), f"{median(ticks):.1f}", f"{sorted(ticks)[-len(ticks) // 100]:.1f}"]
            )
            result.figures.append(Figure(f"tick among {count} silent {what}", median(ticks), "us"))
    result.details += table(["", "silent", "median us", "p99 us"], rows)
    return result
