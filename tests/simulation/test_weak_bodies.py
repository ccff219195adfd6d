"""Robots that brake slowly for the speed they may have come to rest at their places all the same."""

from __future__ import annotations

from math import cos, pi, sin

import pytest

from handfast.agent.common.quantities import Vector
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.sweep.run import drive
from handfast.deploy.verdict.run_result import RunResult
from tests.chaos.text import scenario_text

RING = [(1.5 * cos(k * pi / 3.0), 1.5 * sin(k * pi / 3.0)) for k in range(6)]
TRIANGLE = [(0.0, 0.0), (-1.5, 0.7), (-1.5, -0.7)]
FAR = [(5.0, 0.0), (2.0, 0.7), (2.0, -0.7)]
ACROSS = [(-1.2 * x + 0.04 * k, -1.2 * y) for k, (x, y) in enumerate(RING)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("places", "starts", "speed_mps", "acceleration"),
    [
        pytest.param(TRIANGLE, FAR, 5.0, 1.0, id="three from afar"),
        pytest.param(RING, ACROSS, 2.0, 0.5, id="six across a ring"),
    ],
)
def test_they_form_up(
    places: list[Vector], starts: list[Vector], speed_mps: float, acceleration: float
) -> None:
    """Without the bound of `speed_max` they swing 14 to 30 m past their places, further each time."""
    count = len(places)
    tables = {
        "fleet": {"name": "weak", "rate_hz": 20, "duration_s": 60},
        "formation": {
            "edges": [[k, k % count + 1] for k in range(1, count + 1)],
            "safe_distance_m": 0.22,
            "offsets": [list(place) for place in places],
            "assign": False,
        },
        "control": {"max_speed_mps": speed_mps, "max_acceleration": acceleration},
        "trajectory": {"kind": "hold"},
        "robot": [{"id": k, "x_m": x, "y_m": y} for k, (x, y) in enumerate(starts, 1)],
    }
    result = RunResult(drive(resolved(parse_fleet(scenario_text(tables), source="scene"))))
    assert result.passed, result.reasons
