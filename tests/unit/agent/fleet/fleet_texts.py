"""A small fleet file, and what is wrong with it when a test changes it."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet, FleetError

SMALL = """
[fleet]
name = "small"

[formation]
edges = [[3, 7], [7, 5]]
distance_m = 1.0
safe_distance_m = 0.2
offsets = [[0, 0], [1, 0], [2, 0]]

[robot_defaults]
mass_kg = 8

[[robot]]
id = 3
x_m = 0
y_m = 0

[[robot]]
id = 7
x_m = 1
y_m = 0
mass_kg = 9

[[robot]]
id = 5
x_m = 2
y_m = 0
"""


DATUM = "[datum]\nlatitude_deg = -35.363261\nlongitude_deg = 149.165230\n"
# Robot 3 is a vehicle, the others are simulated.
MIXED = (
    SMALL.replace("id = 3\n", 'id = 3\nplant = "mavlink"\nmavlink = { connection = "udpin:0.0.0.0:14550" }\n')
    + DATUM
)
ROVERS = (
    SMALL.replace(
        "mass_kg = 8", 'mass_kg = 8\nplant = "mavlink"\nmavlink = { connection = "simulator", arm = true }'
    )
    + DATUM
)


def small(*overrides: str, law: str | None = None, text: str = SMALL) -> Fleet:
    return parse_fleet(text, source="small.toml", overrides=overrides, law=law)


def problems(*overrides: str, law: str | None = None, text: str = SMALL) -> list[str]:
    with pytest.raises(FleetError) as caught:
        small(*overrides, law=law, text=text)
    return [str(problem) for problem in caught.value.problems]
