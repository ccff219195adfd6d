"""The bodies of a fleet in virtual time: simulated ones, and what stands for vehicles."""

from __future__ import annotations

from handfast.agent.fleet import plants
from handfast.agent.fleet.model import Fleet
from handfast.plant.backend import Begin, VirtualBody


class Bodies:
    """Makes the bodies of `fleet`, and makes them again for plants that start again."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._bodies: dict[int, VirtualBody] = {}

    def make(self, robot: int, now_ns: int) -> VirtualBody:
        """The body for a new plant of a robot, at `now_ns` by the robot's clock.

        The first is where the fleet file has it. After that a simulated body stands where it was, at rest; a
        simulated vehicle is the same one, which went on by itself, with a new bridge.
        """
        before = self._bodies.get(robot)
        at = None if before is None else (before.pose.x, before.pose.y, before.pose.heading)
        make = plants.attribute(self._fleet.robot(robot).kind.virtual)
        body: VirtualBody = make(self._fleet, robot, Begin(now_ns, at, before))
        self._bodies[robot] = body
        return body

    def there(self, robot: int) -> VirtualBody:
        """The body that a robot has."""
        return self._bodies[robot]
