"""Drives fleets of rovers in virtual time, over their bridges, and says where they truly were."""

from __future__ import annotations

from typing import Final, NamedTuple, cast

import numpy as np

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.points import Floats
from handfast.deploy.simulate.simulation import Simulation
from handfast.plant.backend import VirtualBody

SETTLED_M: Final = 0.15
LATE_S: Final = 15.0


class Driven(NamedTuple):
    """`times` (k,) s from the epoch; errors of the edges' lengths and distances of all pairs (k, m), m."""

    times: Floats
    errors: Floats
    pairs: Floats
    verdict: list[str]

    @property
    def settled(self) -> float:
        """When every edge is within 0.15 m for good, s; the end of the drive where that is never."""
        off = self.times[(self.errors > SETTLED_M).any(axis=1)]
        return float(off[-1]) if len(off) else 0.0

    @property
    def stays(self) -> bool:
        """Whether it had settled before the end."""
        return self.settled < float(self.times[-1])

    @property
    def late(self) -> float:
        """Worst edge error in the end, m."""
        return float(self.errors[self.times > self.times[-1] - LATE_S].max())


def true_pose(body: VirtualBody, now_ns: int) -> Pose:
    """Where a body is by now. A vehicle whose bridge is dead or stands goes on: nobody steps it."""
    body.alone(now_ns)
    return body.pose


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
        poses = [true_pose(cast(VirtualBody, node._backend), simulation.now_ns) for node in simulation.plants]
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
