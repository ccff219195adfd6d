"""Places of a fleet on this machine: ports of its processes, which no other run takes before its start, and
positions of simulated rovers."""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.common.errors import Error
from handfast.agent.fleet.hosts import PORT_MAX, NetworkSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import Robot
from handfast.agent.runtime.order_store import NotPrivateError, private_folder

BLOCK: Final = 128
"""Ports are reserved in blocks of this many."""


class NoPortsError(Error, RuntimeError):
    """No run of free ports is left."""


def _free(address: str, port: int) -> bool:
    """Whether nobody has the port, for TCP or UDP."""
    with socket.socket() as stream, socket.socket(type=socket.SOCK_DGRAM) as datagram:
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            stream.bind((address, port))
            datagram.bind((address, port))
        except OSError:
            return False
    return True


class Reservation:
    """`count` ports in a row on `address`, from `base` or the next free place after it.

    Between runs on one machine a lock on the block of ports decides, held until `close` or the
    end of the process; other programs are found by trying the ports.

    Raises:
        NoPortsError: when there is no room up to `PORT_MAX`.
    """

    def __init__(self, address: str, base: int, count: int) -> None:
        self._locks: list[int] = []
        first = base
        while base + count - 1 <= PORT_MAX:
            if self._lock(base, count):
                if all(_free(address, port) for port in range(base, base + count)):
                    self.base = base
                    return
                self.close()
            base += BLOCK
        raise NoPortsError(
            f"no {count} free ports in a row from {first} to {PORT_MAX} on {address}: "
            "end other runs, or set a lower [network] base_port"
        )

    def _lock(self, base: int, count: int) -> bool:
        try:
            folder = private_folder()
        except NotPrivateError as error:
            raise NoPortsError(str(error)) from None
        for block in range(base // BLOCK, (base + count - 1) // BLOCK + 1):
            handle = os.open(folder / f"ports-{block}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._locks.append(handle)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self.close()
                return False
        return True

    def close(self) -> None:
        """Gives the ports back."""
        for handle in self._locks:
            os.close(handle)
        self._locks.clear()


ADDRESS: Final = "127.0.0.1"
_ORDERS: Final = "orders"


def mark(fleet: Fleet) -> str:
    """Tells a running fleet from another of its name: by where its first agent is."""
    about = f"{fleet.fleet.name} {fleet.agent_endpoint(fleet.ids[0])}"
    return blake2b(about.encode(), digest_size=8).hexdigest()


def orders_folder(fleet: Fleet) -> Path:
    """Where the robots of a placed fleet keep operators' orders, and look for a stop, while it runs here
    (`held_orders`).

    Raises:
        handfast.agent.runtime.order_store.NotPrivateError: there is no folder for it.
    """
    return private_folder() / f"{_ORDERS}-{mark(fleet)}"


@contextmanager
def held_orders(fleet: Fleet) -> Iterator[None]:
    """Has the folder of a run's orders, empty at first, as long as the run lives. It is locked, so that the
    next run knows those of runs that were killed, and removes them.

    Raises:
        OSError: it cannot be made.
    """
    folder = orders_folder(fleet)
    for left in folder.parent.glob(f"{_ORDERS}-*"):
        _remove_if_left(left)
    # Under another name until it is locked.
    new = folder.with_name(f".{folder.name}-{os.getpid()}")
    for each in (folder, new):
        shutil.rmtree(each, ignore_errors=True)
    new.mkdir(mode=0o700)
    handle = os.open(new, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        new.rename(folder)
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(handle)


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One simulated rover, which the same machine runs beside its bridge.

    Attributes:
        robot: whose vehicle it is.
        arguments: the command line of `bridges.mavlink.simulator`.
        ground_station: where a ground station reaches it, as pymavlink writes it.
    """

    robot: int
    arguments: tuple[str, ...]
    ground_station: str

    def __str__(self) -> str:
        return f"robot {self.robot}'s simulated rover: ground stations connect to {self.ground_station}"


class Placed(NamedTuple):
    """A fleet on this machine: as its processes read it, its ports (reserved until given back), and its
    simulated rovers. Its routers are those of `Fleet.network`."""

    fleet: Fleet
    ports: Reservation
    vehicles: tuple[Vehicle, ...]


def place(fleet: Fleet) -> Placed:
    """`fleet` on this machine's loopback, on ports that are free, in its topology: with as many routers as it
    has, or one where it has none and needs one.

    Where a robot's connection is "simulator", the placed fleet names the port of a simulated rover instead,
    so a bridge knows of no simulators.

    Raises:
        handfast.deploy.processes.placement.NoPortsError: when there are none.
    """
    simulated = [robot.id for robot in fleet.robots if robot.is_simulated]
    of_processes = 2 * len(fleet.robots)
    of_routers = max(1, len(fleet.routers)) if fleet.is_routed else 0
    ports = Reservation(ADDRESS, fleet.network.base_port, of_processes + len(simulated) + of_routers)
    numbers = {robot: ports.base + of_processes + k for k, robot in enumerate(simulated)}
    first = ports.base + of_processes + len(simulated)
    routers = tuple(f"{ADDRESS}:{first + k}" for k in range(of_routers))
    placed = replace(
        fleet,
        network=NetworkSection(  # no other machine, no security
            address=ADDRESS,
            base_port=ports.base,
            topology=fleet.network.topology,
            routers=routers,
            link_timeout_s=fleet.network.link_timeout_s,
        ),
        hosts=(),
        robots=tuple(replace(connected(robot, numbers.get(robot.id)), host=None) for robot in fleet.robots),
    )
    return Placed(placed, ports, tuple(vehicle(fleet, robot, port) for robot, port in numbers.items()))


def connected(robot: Robot, port: int | None) -> Robot:
    """`robot` with its bridge listening on a port of this machine; as it is without one."""
    section = robot.section(MavlinkSection)
    if port is None or section is None:
        return robot
    return robot.with_section(replace(section, connection=f"udpin:{ADDRESS}:{port}"))


def vehicle(fleet: Fleet, robot: int, port: int) -> Vehicle:
    """The simulated rover of one robot of `fleet` (with a datum), where its robot starts.

    It sends to the bridge at UDP `port` of this machine, and takes a ground station on TCP `port`. So a
    bridge that starts again hears it at once, and a second one on the same vehicle finds the port taken.
    """
    # Here: a fleet without vehicles needs no geodesy.
    from handfast.bridges.mavlink.ardupilot.frames import yaw_degrees
    from handfast.bridges.mavlink.simulator.settings import settings_of

    settings = settings_of(fleet, robot)
    at, yaw_deg = settings.home, yaw_degrees(settings.yaw)
    ground_station = f"tcp:{ADDRESS}:{port}"
    return Vehicle(
        robot,
        (
            f"--connect=udp:{ADDRESS}:{port}",
            f"--listen={ground_station}",
            f"--system={settings.system}",
            f"--home={at.latitude_deg:.9f},{at.longitude_deg:.9f},{at.altitude_m:.3f},{yaw_deg:.6f}",
            f"--seed={settings.seed}",
            "--warm",
            "--hand-over",
        ),
        ground_station,
    )
