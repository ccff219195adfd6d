"""Who came too near to a vehicle of which nobody says where it is (PURE but for the simulation it looks at).

A recording has no pose of a vehicle whose bridge is dead, and so nobody is judged by it. It rolls on all the
same, and in virtual time it is known where to.
"""

from __future__ import annotations

from math import hypot
from typing import NamedTuple

from agent.common.time import NS_PER_S
from agent.control import hand
from agent.fleet.model import Fleet
from deploy.simulate.simulation import Simulation
from deploy.verdict.oracles_distance import SEPARATION
from deploy.verdict.violations import Violation


class _Closest(NamedTuple):
    distance_m: float
    t_s: float
    unseen: int
    other: int


class UnseenApproaches:
    """Distances of the hands of those whose plant is dead, or stands, to those that can get out of the way.

    Args:
        fleet: resolved. Pairs count from when they have been as far apart as is safe, as elsewhere.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.are_possible = any(robot.kind.rolls_on_s for robot in fleet.robots)
        """A body that stands while its plant is dead is where the recording has it last."""
        self._safe_m = fleet.formation.safe_distance_m
        self._ids = fleet.ids
        self._reach = [robot.hand_offset_m for robot in fleet.robots]
        self._apart: set[tuple[int, int]] = set()
        self._unsafe: dict[tuple[int, int], _Closest] = {}

    def look(self, simulation: Simulation) -> None:
        """Takes in where all are now."""
        commanded = [simulation.runs(robot, "plant") for robot in self._ids]
        able = [
            there and simulation.runs(robot, "agent")
            for there, robot in zip(commanded, self._ids, strict=True)
        ]
        poses = simulation.poses()
        hands = [hand.hand(pose, reach) for pose, reach in zip(poses, self._reach, strict=True)]
        t_s = (simulation.now_ns - simulation.epoch_ns) / NS_PER_S
        for i, here in enumerate(hands):
            for j, there in enumerate(hands):
                if i == j:
                    continue
                apart_m = hypot(here.x - there.x, here.y - there.y)
                if apart_m >= self._safe_m:
                    self._apart.add((i, j))
                elif not commanded[i] and able[j] and (i, j) in self._apart:
                    closest = _Closest(apart_m, t_s, self._ids[i], self._ids[j])
                    self._unsafe[i, j] = min(self._unsafe.get((i, j), closest), closest)

    def violations(self) -> list[Violation]:
        """One for each pair that came below the safe distance, the closest first."""
        return [
            Violation(
                SEPARATION,
                each.t_s,
                f"Robots {each.unseen} and {each.other} truly came within {each.distance_m:.3f} m of each "
                f"other at {each.t_s:.2f} s, while nothing commanded robot {each.unseen}; the safe distance "
                f"is {self._safe_m:.3f} m.",
            )
            for each in sorted(self._unsafe.values())
        ]
