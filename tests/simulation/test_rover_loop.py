"""Fleets of simulated rovers in virtual time, over their bridges: where they truly are."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from typing import NamedTuple

import numpy as np
import pytest

from agent.common.time import NS_PER_S
from agent.control import hand
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve, resolved
from agent.formation.points import Floats
from deploy.console.data_files import FLEETS
from deploy.simulate.simulation import Simulation
from plant.unicycle import Unicycle

ROVERS = FLEETS / "rovers.toml"
SETTLED_M = 0.15
SETTLED_S = 20.0
SETTLED_TURNING_S = 30.0
"""They start up to 9 m from their places, which move away at 0.34 m/s, and drive at no more than 0.9 m/s: who
has to turn round first takes longer."""
LATE_S = 15.0


class Driven(NamedTuple):
    """`times` (k,) s from the epoch; errors of the edges' lengths and distances of all pairs (k, m), m."""

    times: Floats
    errors: Floats
    pairs: Floats
    verdict: list[str]

    @property
    def settled(self) -> float:
        """When every edge is within 0.15 m for good, s."""
        off = self.times[(self.errors > SETTLED_M).any(axis=1)]
        return float(off[-1]) if len(off) else 0.0

    @property
    def late(self) -> float:
        """Worst edge error in the end, m."""
        return float(self.errors[self.times > self.times[-1] - LATE_S].max())


def driven(fleet: Fleet) -> Driven:
    """A whole mission; the hands are the true ones, ten times a second."""
    simulation = Simulation(fleet)
    reach = [robot.hand_offset_m for robot in fleet.robots]
    times: list[float] = []
    hands: list[list[tuple[float, float]]] = []
    duration_ns = round(fleet.fleet.duration_s * NS_PER_S)
    assert simulation.start(duration_ns), simulation.reasons
    while simulation.now_ns < simulation.epoch_ns + duration_ns:
        simulation.run_until(simulation.now_ns + NS_PER_S // 10)
        poses = [node._backend.pose for node in simulation.plants]
        hands.append([hand.hand(pose, offset)[:2] for pose, offset in zip(poses, reach, strict=True)])
        times.append((simulation.now_ns - simulation.epoch_ns) / NS_PER_S)
    geometry = resolve(fleet)
    at, points = np.array(times), np.array(hands)
    points, at = points[at >= 0.0], at[at >= 0.0]
    i, j = geometry.edges.T
    lengths = np.hypot(*np.moveaxis(points[:, i] - points[:, j], -1, 0))
    first, second = np.triu_indices(len(reach), 1)
    pairs = np.hypot(*np.moveaxis(points[:, first] - points[:, second], -1, 0))
    states = [f"{agent.robot}: {agent.state.value} {agent.reason}" for agent in simulation.agents]
    return Driven(at, np.abs(lengths - geometry.distances), pairs, simulation.reasons + states)


def rovers(*settings: str) -> Fleet:
    return resolved(load_fleet(ROVERS, settings))


def check(found: Driven, late: float, settled: float = SETTLED_S) -> None:
    assert found.settled <= settled, found.verdict
    assert found.late <= late, found.verdict
    assert found.pairs.min() > 1.0, found.verdict


def test_six_rovers_take_up_their_formation():
    check(driven(rovers()), 0.05)


@pytest.mark.slow
def test_under_delay_and_loss():
    check(driven(rovers("faults.delay=200ms", "faults.loss=30%")), 0.10)


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
