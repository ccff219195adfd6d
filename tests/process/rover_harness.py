"""Fleets of simulated rovers as real processes, and a router before one."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Checks, Resume
from handfast.bridges.mavlink.transport.transport import open_transport
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.processes.local import VEHICLE
from handfast.deploy.processes.placement import Reservation, Vehicle, place, vehicle
from tests.ground_station import Operator
from tests.process.fleet_harness import Robots
from tests.process.harness import ADDRESS, PATIENCE_S

BASE_PORT: Final = 24_320
"""Clear of the ports of the fleets in `tests.process.fleet_harness`."""
PAIR: Final = (
    "formation.edges=[[1,2]]",
    "formation.offsets=[[0.0,-1.5],[0.0,1.5]]",
    "trajectory.start_m=[0.0,0.0]",
    "robot.1.x_m=-0.5",
    "robot.1.y_m=-1.6",
    "robot.2.x_m=-0.4",
    "robot.2.y_m=1.5",
    f"network.base_port={BASE_PORT}",
)
"""Two of the rovers, 3 m apart and near their places from the start."""


def pair_of_rovers(*overrides: str) -> Fleet:
    """The first two of the bundled fleet of rovers, resolved, under a name of their own."""
    text = (FLEETS / "rovers.toml").read_text(encoding="utf-8")
    text = "[[robot]]".join(text.split("[[robot]]")[:3])
    name = f'fleet.name="t-{time.time_ns() % 10**12}"'
    return resolved(parse_fleet(text, source="here", overrides=[name, *PAIR, *overrides]))


class Router:
    """Copies every datagram of each place to all the others, as a MAVLink router does.

    Args:
        port: where the vehicle sends.
        to: ports of those that wait for it.

    Attributes:
        setpoints: counts by sender the setpoints that went to the vehicle.
    """

    def __init__(self, port: int, to: Sequence[int]) -> None:
        self.setpoints: Counter[tuple[int, int]] = Counter()
        self._near = socket.socket(type=socket.SOCK_DGRAM)
        self._near.bind((ADDRESS, port))
        self._far = [(socket.socket(type=socket.SOCK_DGRAM), (ADDRESS, each)) for each in to]
        for each, _ in self._far:
            each.bind((ADDRESS, 0))
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        peer: Any = None
        codec = mavlink.MAVLink(None)
        codec.robust_parsing = True
        while True:
            sockets = [self._near, self._woken, *(each for each, _ in self._far)]
            ready, _, _ = select.select(sockets, (), ())
            if self._woken in ready:
                return
            for here in ready:
                try:
                    data, sender = here.recvfrom(65_536)
                except ConnectionRefusedError:
                    continue  # nobody was there for the last one
                if here is self._near:
                    peer = sender
                elif peer is not None:
                    self._near.sendto(data, peer)
                    for message in codec.parse_buffer(data) or ():
                        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                            self.setpoints[message.get_srcSystem(), message.get_srcComponent()] += 1
                for each, place_of in self._far:
                    if each is not here:
                        each.sendto(data, place_of)

    def close(self) -> None:
        self._wake.send(b"x")
        self._thread.join(5.0)
        for each in (self._near, self._wake, self._woken, *(each for each, _ in self._far)):
            each.close()


class Rovers(Robots):
    """Agents, bridges and simulated rovers of a fleet as processes.

    `start(robot, "vehicle")` starts a rover, `start(robot, "plant")` the bridge to it.
    """

    def __init__(self, fleet: Fleet, folder: Path, vehicles: dict[int, Vehicle]) -> None:
        super().__init__(fleet, folder)
        self.vehicles = vehicles

    def start(self, robot: int, role: str, *more: str) -> None:
        if role == VEHICLE:
            self.run(robot, role, self.fleet.robot(robot).kind.simulator, *self.vehicles[robot].arguments)
        else:
            module = self.fleet.robot(robot).kind.program if role == "plant" else f"handfast.{role}"
            self.run(robot, role, module, "--fleet", str(self.fleet_file), "--robot", str(robot), *more)

    def start_all(self) -> None:
        for robot in self.fleet.ids:
            self.start(robot, VEHICLE)
        super().start_all()

    def operator(self, robot: int) -> Operator:
        connection = self.vehicles[robot].ground_station
        return Operator(open_transport(connection, 115_200, time.time_ns), connection)

    def resume(self, *robots: int) -> None:
        now_ns = time.time_ns()
        key = key_expressions.resume(self.name)
        self.bus.declare(key)
        self.bus.publish(key, encode(Resume(now_ns // 1_000, now_ns, robots)))

    def checks(self, robot: int) -> dict[str, tuple[str, str]]:
        """Level and found, by the name of the line."""
        found = self.latest.get(key_expressions.checks(self.name, robot))
        return (
            {name: (level, text) for name, level, text, _ in found.lines} if isinstance(found, Checks) else {}
        )

    def wait_with(
        self, operator: Operator, look: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S
    ) -> Any:
        """As `wait`, with a ground station at work."""

        def poll_and_look() -> Any:
            operator.poll()
            return look()

        return self.wait(poll_and_look, what, timeout_s)

    def moving(self, robot: int) -> bool:
        state = self.plant(robot)
        return state is not None and state.driving and abs(state.speed) > 0.15

    def standing(self, robot: int) -> bool:
        state = self.plant(robot)
        return state is not None and state.healthy and not state.driving and abs(state.speed) < 0.06


@contextmanager
def rovers(
    folder: Path, *overrides: str, routed: int | None = None, others: int = 0
) -> Iterator[tuple[Rovers, Router | None, list[int]]]:
    """All processes of a pair of rovers, ready for a mission.

    Args:
        routed: robot whose vehicle reaches its bridge by a `Router`.
        others: number of other programs that may join that router; their ports come last.
    """
    placed = place(pair_of_rovers(*overrides))
    fleet, router, extra, ports = placed.fleet, None, None, []
    vehicles = {each.robot: each for each in placed.vehicles}
    try:
        if routed is not None:
            extra = Reservation(ADDRESS, BASE_PORT + 2048, 1 + others)
            section = fleet.robot(routed).section(MavlinkSection)
            assert section is not None
            assert section.connection is not None
            ports = [extra.base + 1 + number for number in range(others)]
            router = Router(extra.base, [int(section.connection.rpartition(":")[2]), *ports])
            vehicles[routed] = vehicle(fleet, routed, extra.base)
        with Rovers(fleet, folder, vehicles) as all_rovers:
            all_rovers.start_all()
            all_rovers.wait_until_all("ready")
            yield all_rovers, router, ports
    finally:
        if router is not None:
            router.close()
        if extra is not None:
            extra.close()
        placed.ports.close()
