"""Hand points of a simulated fleet over time, straight from the bus and without files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import PlantState
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.simulate.simulation import Simulation

Floats = NDArray[np.float64]


class Trace(NamedTuple):
    """`times` (k,) s from the epoch; `hands` (k, n, 2) m, W, in the order of `Fleet.members`."""

    fleet: Fleet
    times: Floats
    hands: Floats

    def distances(self) -> Floats:
        """Length of every edge, (k, m), m."""
        i, j = resolve(self.fleet).edges.T
        delta = self.hands[:, i] - self.hands[:, j]
        return np.hypot(delta[..., 0], delta[..., 1])

    def settling_time(self) -> float | None:
        """Last time (s) that an edge was off its distance by more than 5 %; None if one is at the end."""
        wanted = resolve(self.fleet).distances
        off = (np.abs(self.distances() - wanted) > SETTLED * wanted).any(axis=1)
        if off[-1]:
            return None
        return float(self.times[np.flatnonzero(off)[-1]]) if off.any() else 0.0

    def tracking_error(self) -> Floats:
        """Distance of every hand from where it is wanted, (k, n), m."""
        geometry, trajectory = resolve(self.fleet), make_trajectory(self.fleet.trajectory)
        centre = np.array([trajectory.at(float(t))[:2] for t in self.times])
        error = self.hands - centre[:, None] - geometry.offsets
        return np.hypot(error[..., 0], error[..., 1])


class HandTrace:
    """A sink for `deploy.simulate.simulation.Simulation` that keeps where every hand really was."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.rows: dict[str, dict[int, tuple[float, float]]] = {}
        """Key of a plant's states -> time of the state (ns) -> hand point."""
        self._reach = {robot.id: robot.hand_offset_m for robot in fleet.robots}

    def __call__(self, _arrival_ns: int, key: str, payload: bytes) -> None:
        if "/plant/state" not in key and "/plant/truth" not in key:
            return
        state = decode(payload)
        assert isinstance(state, PlantState)
        pose = hand.Pose(state.x, state.y, state.heading, state.speed, state.yaw_rate)
        point = hand.hand(pose, self._reach[state.robot])
        self.rows.setdefault(key, {})[state.time_ns] = (point.x, point.y)

    def trace(self, epoch_ns: int, duration_s: float) -> Trace:
        """What was kept, from the epoch on for `duration_s`, at the plants' common times."""
        name = self._fleet.fleet.name
        columns = [
            self.rows.get(key_expressions.plant_truth(name, robot))
            or self.rows[key_expressions.plant_state(name, robot)]
            for robot in resolve(self._fleet).ids
        ]
        end_ns = epoch_ns + round(duration_s * NS_PER_S)
        common = set.intersection(*map(set, columns))
        stamps = sorted(stamp for stamp in common if epoch_ns <= stamp <= end_ns)
        hands = np.array([[column[stamp] for column in columns] for stamp in stamps])
        return Trace(self._fleet, (np.array(stamps) - epoch_ns) / NS_PER_S, hands)


def drive(fleet: Fleet) -> Trace:
    """The whole mission of a resolved fleet in virtual time."""
    kept = HandTrace(fleet)
    simulation = Simulation(fleet, kept)
    simulation.run()
    return kept.trace(simulation.epoch_ns, fleet.fleet.duration_s)


def drive_until_settled(fleet: Fleet, for_s: float) -> Trace:
    """A mission of a resolved fleet in virtual time, but no longer than until all edges have kept their
    distance, to 5 %, for as long as this: what a fleet at rest does for the rest of its mission is the same
    for any start."""
    kept = HandTrace(fleet)
    simulation = Simulation(fleet, kept)
    geometry = resolve(fleet)
    names = [key_expressions.plant_state(fleet.fleet.name, robot) for robot in geometry.ids]
    off_s = 0.0

    def is_settling(now_s: float) -> bool:
        nonlocal off_s
        hands = np.array([next(reversed(kept.rows[name].values()), (np.inf, 0.0)) for name in names])
        i, j = geometry.edges.T
        apart = np.hypot(*(hands[i] - hands[j]).T)
        if (np.abs(apart - geometry.distances) > SETTLED * geometry.distances).any():
            off_s = now_s
        return now_s < off_s + for_s

    simulation.run(is_settling)
    driven_s = (simulation.now_ns - simulation.epoch_ns) / NS_PER_S
    return kept.trace(simulation.epoch_ns, min(driven_s, fleet.fleet.duration_s))
