"""Joins a bridge and a simulated rover in memory, for virtual time: no socket, no thread, no clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.bridges.mavlink.ardupilot import frames
from handfast.bridges.mavlink.bridge.backend import MavlinkPlant, session
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.bridges.mavlink.simulator.settings import settings_of
from handfast.plant.backend import Begin, Check, Command, Reading, Said, VirtualBody

LATENCY_NS: Final = 2_000_000
"""One way, between bridge and vehicle: as over a network on one machine."""
STEP_NS: Final = NS_PER_S // 200
"""The vehicle is looked at this often, so that what it sends arrives when it was sent."""


class MemoryTransport:
    """A `bridges.mavlink.transport.transport.Transport` to a `Rover`'s first port, which it drives.

    Args:
        now_ns: the present, wall time.

    Attributes:
        cut: nothing passes while it is True.
    """

    def __init__(self, rover: Rover, now_ns: int) -> None:
        self._rover = rover
        rover.advance(now_ns)  # what it said while no bridge was there is lost
        self._now_ns = now_ns
        self._to_bridge: deque[tuple[int, bytes]] = deque()
        self._to_rover: deque[tuple[int, bytes]] = deque()
        self.trouble = self.note = ""
        self.transient = True
        self.epoch, self.dropped = 1, 0
        self.cut = False

    def advance(self, now_ns: int) -> None:
        """Lets time pass: the rover moves, and messages travel."""
        while self._now_ns < now_ns:
            self._now_ns = min(now_ns, self._now_ns + STEP_NS)
            while self._to_rover and self._to_rover[0][0] <= self._now_ns:
                self._rover.receive(0, self._to_rover.popleft()[1], self._now_ns)
            for port, data in self._rover.advance(self._now_ns):
                if port == 0 and not self.cut:
                    self._to_bridge.append((self._now_ns + LATENCY_NS, data))

    def receive(self) -> list[tuple[int, bytes]]:
        """See `Transport.receive`."""
        came = []
        while self._to_bridge and self._to_bridge[0][0] <= self._now_ns:
            came.append(self._to_bridge.popleft())
        return came

    def send(self, data: bytes) -> None:
        """See `Transport.send`."""
        if not self.cut:
            self._to_rover.append((self._now_ns + LATENCY_NS, data))

    def close(self) -> None:
        """See `Transport.close`."""


class SimulatedRoverPlant(VirtualBody):
    """The bridge of one robot with the rover that it is joined to, as one body.

    Attributes:
        rover: goes on when its bridge is made anew.
    """

    def __init__(self, fleet: Fleet, robot: int, now_ns: int, rover: Rover | None = None) -> None:
        self.rover: Final = rover if rover is not None else Rover(settings_of(fleet, robot), now_ns)
        self._datum = frames.datum_of(fleet)
        self.transport: Final = MemoryTransport(self.rover, now_ns)
        self.log: list[str] = []
        link = session(fleet, robot, signing=None, token=robot)
        self.plant: Final = MavlinkPlant(fleet, robot, link, self.transport, self.log.append)

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        self.transport.advance(now_ns)
        return self.plant.step(now_ns, command)

    @property
    def pose(self) -> Pose:
        """Where the rover really is, W."""
        rover = self.rover
        x, y = frames.geodetic_to_world(self._datum, rover.place)
        return Pose(x, y, frames.heading_from_yaw(rover.yaw), rover.speed, frames.yaw_rate(rover.yaw_rate))

    def alone(self, now_ns: int) -> bool:
        """See `VirtualBody.alone`."""
        self.transport.advance(now_ns)
        return True

    def clear_to_drive(self) -> None:
        """See `PlantBackend.clear_to_drive`."""
        self.plant.clear_to_drive()

    def checks(self, now_ns: int) -> tuple[Check, ...]:
        """See `PlantBackend.checks`."""
        return self.plant.checks(now_ns)

    def status_texts(self) -> Sequence[Said]:
        """See `PlantBackend.status_texts`."""
        return self.plant.status_texts()

    def close(self) -> None:
        """See `PlantBackend.close`."""
        self.plant.close()


def begin(fleet: Fleet, robot: int, how: Begin) -> SimulatedRoverPlant:
    """The rover that a robot had with a new bridge, or the first; see `agent.fleet.plants.Kind.virtual`."""
    rover = how.before.rover if isinstance(how.before, SimulatedRoverPlant) else None
    return SimulatedRoverPlant(fleet, robot, how.now_ns, rover)
