"""The bodies of a fleet in virtual time: simulated unicycles, and simulated rovers with their bridges."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.fleet.model import Fleet
from plant.unicycle import Unicycle, from_fleet

if TYPE_CHECKING:
    from bridges.mavlink.simulator.in_memory import SimulatedRoverPlant


class Bodies:
    """Makes the bodies of `fleet`, and makes them again for plants that start again."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._unicycles: dict[int, Unicycle] = {}
        self._rovers: dict[int, SimulatedRoverPlant] = {}

    def make(self, robot: int, now_ns: int) -> Unicycle | SimulatedRoverPlant:
        """The body for a new plant of a robot, at `now_ns` by the robot's clock.

        The first is where the fleet file has it. After that a unicycle stands where it was, at rest; a rover
        is the same one, which went on by itself, with a new bridge.
        """
        if self._fleet.robot(robot).plant == "mavlink":
            # Here: other fleets need none of it.
            from bridges.mavlink.simulator.in_memory import SimulatedRoverPlant

            before = self._rovers.get(robot)
            rover = SimulatedRoverPlant(self._fleet, robot, now_ns, None if before is None else before.rover)
            self._rovers[robot] = rover
            return rover
        known = self._unicycles.get(robot)
        unicycle = from_fleet(self._fleet, robot, None if known is None else known.pose[:3])
        self._unicycles[robot] = unicycle
        return unicycle
