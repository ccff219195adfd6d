"""Small fleets for tests with real processes: enough robots for what is tested, and no more."""

from __future__ import annotations

import secrets

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved

TRIANGLE = """
[fleet]
name = "triangle"
duration_s = 60
[formation]
edges = [[1, 2], [1, 3], [2, 3]]
distance_m = 1.0
safe_distance_m = 0.22
offsets = [[-0.5, 0.0], [0.5, 0.0], [0.0, 0.866]]
[trajectory]
kind = "line"
velocity_mps = [0.0, 0.25]
[[robot]]
id = 1
x_m = -0.6
y_m = -0.1
heading_rad = "90deg"
[[robot]]
id = 2
x_m = 0.5
y_m = -0.1
heading_rad = "90deg"
[[robot]]
id = 3
x_m = 0.1
y_m = 0.8
heading_rad = "90deg"
[[robot]]
id = 4
x_m = 1.6
y_m = 1.0
heading_rad = "90deg"
reserve = true
"""
"""Three robots that go on along a line, and a fourth in reserve beside them."""


def triangle(*overrides: str) -> Fleet:
    """`TRIANGLE` under a name of its own, resolved."""
    name = f'fleet.name="t-{secrets.token_hex(4)}"'
    return resolved(parse_fleet(TRIANGLE, source="triangle", overrides=[name, *overrides]))
