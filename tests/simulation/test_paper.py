"""The paper's own simulation (section 4): six robots, its law, against an independent continuous solution."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import cos, sin

import numpy as np
import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep import run
from handfast.deploy.verdict.run_result import RunResult
from tests.hand_trace import Floats, Trace, drive
from tests.simulation import closed_loop

DELTA = FLEETS / "delta.toml"
DURATION_S = 20
GRID_S = 0.02


def delta(rate_hz: int, *overrides: str) -> Fleet:
    settings = [f"fleet.rate_hz={rate_hz}", f"fleet.duration_s={DURATION_S}", *overrides]
    return resolved(load_fleet(DELTA, settings, "paper"))


@cache
def driven(rate_hz: int) -> Trace:
    """At the instants of GRID_S, which the plants of every rate here share."""
    trace = drive(delta(rate_hz))
    every = round(GRID_S * rate_hz)
    return trace._replace(times=trace.times[::every], hands=trace.hands[::every])


@cache
def continuous() -> Floats:
    return closed_loop.solve(delta(50), np.arange(round(DURATION_S / GRID_S) + 1) * GRID_S)


def error(rate_hz: int) -> Floats:
    """Distance of every hand from the continuous solution, (k, n), m."""
    difference = driven(rate_hz).hands - continuous()
    return np.hypot(difference[..., 0], difference[..., 1])


@pytest.mark.slow
def test_agents_and_plants_follow_the_papers_equations():
    trace = driven(200)
    assert trace.times == pytest.approx(np.arange(round(DURATION_S / GRID_S) + 1) * GRID_S)
    assert error(200).max() < 2e-3


@pytest.mark.slow
def test_closest_pair_of_an_edge_is_the_one_at_the_start():
    # Robots 3 and 6 start (-0.2, 0.3) and (-0.18, 0): 0.3007 m, and no edge is ever shorter.
    distances = driven(200).distances()
    assert distances.min() == pytest.approx(0.300, abs=1e-3)
    assert distances[0].min() == pytest.approx(np.hypot(0.02, 0.3), abs=1e-9)
    safe = delta(200).formation.safe_distance_m
    assert distances.min() > safe


def test_the_verdict_names_the_pair_without_an_edge_that_the_law_lets_collide():
    fleet = delta(50)
    result = RunResult(run.drive(replace(fleet, fleet=replace(fleet.fleet, duration_s=3))))
    assert result.reasons[0].startswith("Robots 1 and 6, which share no edge, came within 0.018 m")
    assert result.metrics["min_distance_m"]["any"] == pytest.approx(0.018, abs=1e-3)
    assert result.metrics["min_distance_m"]["edge"] == pytest.approx(0.301, abs=1e-3)


@pytest.mark.slow
def test_sampled_loop_is_of_second_order_in_the_period():
    errors = {rate_hz: float(error(rate_hz).max()) for rate_hz in (50, 100, 200)}
    print({f"{rate_hz} Hz": f"{1e3 * value:.2f} mm" for rate_hz, value in errors.items()})  # pytest -rP
    assert errors[100] / errors[200] > 3.0
    assert errors[50] / errors[100] > 3.0


@pytest.mark.slow
def test_headings_at_the_start_do_not_matter_to_the_hands():
    # Feedback linearisation (39): the hand is a double integrator whichever way its body looks.
    fleet = delta(200)
    robots = []
    for k, robot in enumerate(fleet.robots):
        heading, reach = 2.5 * k - 6.0, robot.hand_offset_m
        x, y = robot.x_m + reach * (1.0 - cos(heading)), robot.y_m - reach * sin(heading)
        robots.append(replace(robot, x_m=x, y_m=y, heading_rad=heading))
    turned = replace(fleet, fleet=replace(fleet.fleet, duration_s=5), robots=tuple(robots))
    trace = drive(turned)
    hands = trace.hands[::4]
    difference = hands - continuous()[: len(hands)]
    assert len(hands) == 251
    assert np.hypot(difference[..., 0], difference[..., 1]).max() < 2e-3
