"""Fleets of simulated rovers in virtual time, over their bridges: where they truly are."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation
from handfast.plant.unicycle import Unicycle
from tests.rover_drive import Driven, driven

ROVERS = FLEETS / "rovers.toml"
SETTLED_S = 13.0
SETTLED_TURNING_S = 15.0
"""They start up to 9 m from their places, which move away at 0.34 m/s, and drive at no more than 0.9 m/s: who
has to turn round first takes longer."""


def rovers(*settings: str) -> Fleet:
    return resolved(load_fleet(ROVERS, settings))


def check(found: Driven, late: float, settled: float = SETTLED_S) -> None:
    assert found.settled <= settled, found.verdict
    assert found.late <= late, found.verdict
    assert found.pairs.min() > 1.0, found.verdict


@pytest.mark.slow
def test_six_rovers_take_up_their_formation():
    check(driven(rovers()), 0.05)


@pytest.mark.slow
def test_under_delay_and_loss():
    check(driven(rovers("faults.delay=200ms", "faults.loss=30%")), 0.10)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("heading_deg", [45.0, 225.0, 135.0])
def test_from_other_headings(heading_deg: float):
    """Along the way, backwards and across it: a hand that is pulled backwards turns its rover around."""
    fleet = load_fleet(ROVERS)
    robots = tuple(replace(robot, heading_rad=radians(heading_deg)) for robot in fleet.robots)
    check(driven(resolved(replace(fleet, robots=robots))), 0.05, SETTLED_TURNING_S)


@pytest.mark.slow
def test_rovers_and_unicycles_together():
    fleet = rovers("robot.2.plant=unicycle", "robot.4.plant=unicycle", "robot.6.plant=unicycle")
    simulation = Simulation(fleet)
    assert sum(isinstance(node._backend, Unicycle) for node in simulation.plants) == 3
    check(driven(fleet), 0.05)
