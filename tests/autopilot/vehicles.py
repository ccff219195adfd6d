"""Autopilots that are really there, each with the bridge to it in this process, in real time.

`HANDFAST_AUTOPILOTS` names them: connection strings, separated by commas. One as
``tcp:127.0.0.1:5760+tcp:127.0.0.1:5762`` has a second connection, at which the tests' operator sits; without,
the operator speaks on the bridge's.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import cos, radians, sin, sqrt
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.supervision.orders import AWAITED
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, world_to_geodetic
from handfast.bridges.mavlink.bridge.backend import MavlinkPlant, session
from handfast.bridges.mavlink.session.session import Session, SessionSettings
from handfast.bridges.mavlink.transport.transport import Transport, open_transport
from handfast.plant.backend import Command, Reading
from tests.ground_station import Operator

VARIABLE: Final = "HANDFAST_AUTOPILOTS"
BOOT_S: Final = 120.0
"""An autopilot has its origin 17 s after it was switched on, and is ready after 40 s; some take longer."""
BAUD: Final = 57_600
OPERATORS_RATE_HZ: Final = 4.0
DATUM_AWAY_M: Final = (60.0, -80.0)
"""East and north of the first vehicle's origin."""
PERIOD_NS: Final = NS_PER_S // 20
MASS, INERTIA, HAND_M = 20.0, 1.2, 0.4
_EARTH_M, _E2 = 6_378_137.0, 6.694_379_990_14e-3


class Place(NamedTuple):
    """One entry of `HANDFAST_AUTOPILOTS`."""

    bridge: str
    operator: str


def places() -> list[Place]:
    """All entries; none when the variable is not set."""
    entries = [entry.strip() for entry in os.environ.get(VARIABLE, "").split(",") if entry.strip()]
    return [Place(bridge, operator) for bridge, _, operator in (entry.partition("+") for entry in entries)]


class Tee:
    """The bridge's transport, which others can share."""

    def __init__(self, inner: Transport) -> None:
        self._inner = inner
        self._others: list[_Other] = []
        self.sent: deque[tuple[int, bytes]] = deque(maxlen=10_000)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def receive(self) -> list[tuple[int, bytes]]:
        came = self._inner.receive()
        for other in self._others:
            other.copies.extend(came)
        return came

    def send(self, data: bytes) -> None:
        self.sent.append((time.time_ns(), data))
        self._inner.send(data)

    def other(self) -> Transport:
        """For somebody else on this connection: gets a copy of what comes from now on, and sends besides."""
        found = _Other(self._inner)
        self._others.append(found)
        return found  # type: ignore[return-value]  # the rest of it is __getattr__'s

    def sent_names(self) -> list[tuple[int, list[str]]]:
        """The names of the messages that the bridge has sent, with the time."""
        parser = mavlink.MAVLink(None)
        return [(at_ns, [m.get_type() for m in parser.parse_buffer(data) or ()]) for at_ns, data in self.sent]


class _Other:
    def __init__(self, inner: Transport) -> None:
        self._inner = inner
        self.copies: deque[tuple[int, bytes]] = deque(maxlen=10_000)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def receive(self) -> list[tuple[int, bytes]]:
        came = list(self.copies)
        self.copies.clear()
        return came

    def send(self, data: bytes) -> None:
        self._inner.send(data)

    def close(self) -> None:
        pass


class Vehicle:
    """One autopilot with its bridge and its operator.

    `command` is what the agent would ask for now; `reading` what the bridge said last.
    """

    def __init__(self, fleet: Fleet, robot: int, place: Place, transport: Tee) -> None:
        self.robot, self.place, self.tee = robot, place, transport
        self.log: list[str] = []
        self.link = session(fleet, robot, None, robot)
        self.plant = MavlinkPlant(fleet, robot, self.link, transport, self.log.append)
        self.reading: Reading | None = None
        self.command: Callable[[Reading], Command | None] = lambda _: None
        second = open_transport(place.operator, BAUD, time.time_ns) if place.operator else transport.other()
        self.operator = Operator(second, place.bridge)

    def ask_operators_streams(self) -> None:
        """Has it send what the bridge is judged by; on the bridge's connection ATTITUDE comes anyway."""
        wanted = [mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT]
        if self.place.operator:
            wanted.append(mavlink.MAVLINK_MSG_ID_ATTITUDE)
        for message in wanted:
            self.operator.command(constants.CMD_SET_MESSAGE_INTERVAL, message, 1e6 / OPERATORS_RATE_HZ)

    def step(self, now_ns: int) -> None:
        command = None if self.reading is None else self.command(self.reading)
        self.reading = self.plant.step(now_ns, command)
        self.operator.poll()

    @property
    def pose(self) -> Pose:
        assert self.reading is not None
        return self.reading.pose

    @property
    def standing(self) -> bool:
        return abs(self.pose.speed) < 0.06 and abs(self.pose.yaw_rate) < 0.1

    def told(self) -> str:
        """All that may say why it does not do what was expected."""
        return "\n".join(
            [f"{self.place.bridge}: {self.reading}", *self.log[-20:], *map(str, self.operator.texts)]
            + [str(check) for check in self.plant.checks(time.time_ns()) if check.level != "ok"]
        )

    def globally(self) -> tuple[float, float]:
        """Latitude and longitude (degrees) by GLOBAL_POSITION_INT, which the bridge has no use for."""
        found = self.operator.latest["GLOBAL_POSITION_INT"]
        return found.lat * 1e-7, found.lon * 1e-7


def metres(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    """East and north from one latitude and longitude to another near by: by the radii of curvature of WGS 84,
    without the bridge's geodesy."""
    (latitude, longitude), (latitude2, longitude2) = start, end
    middle = radians(0.5 * (latitude + latitude2))
    flat = 1.0 - _E2 * sin(middle) ** 2
    east = radians(longitude2 - longitude) * _EARTH_M / sqrt(flat) * cos(middle)
    return east, radians(latitude2 - latitude) * _EARTH_M * (1.0 - _E2) / flat**1.5


class Field:
    """All of them, and the clock that they run by: nothing happens outside of `tick` and what calls it."""

    def __init__(self, all_places: Sequence[Place]) -> None:
        transports = [Tee(open_transport(place.bridge, BAUD, time.time_ns)) for place in all_places]
        self._due_ns = time.time_ns()
        try:
            origin = self._survey(transports[0], all_places[0])
            self.datum = world_to_geodetic(origin, *DATUM_AWAY_M)  # so that no offset is nothing
        except BaseException:
            for transport in transports:
                transport.close()
            raise
        self.fleet = fleet_of(all_places, self.datum)
        self.vehicles = [
            Vehicle(self.fleet, robot, place, transport)
            for robot, (place, transport) in enumerate(zip(all_places, transports, strict=True), 1)
        ]

    def _survey(self, transport: Tee, place: Place) -> Geodetic:
        """Where the first one has the origin of its EKF."""
        link = Session(SessionSettings())
        deadline = time.monotonic() + BOOT_S
        while link.origin is None or link.system is None:
            now_ns = self.wait()
            if link.epoch < transport.epoch:
                link.restart()
            for arrival_ns, data in transport.receive():
                link.receive(arrival_ns, data)
            transport.send(link.tick(now_ns))
            assert time.monotonic() < deadline, (
                f"{place.bridge}: {transport.trouble or link.absence(now_ns) or 'no EKF origin'} "
                f"within {BOOT_S:g} s"
            )
        return link.origin

    def wait(self) -> int:
        """Waits for the next period; returns when it began, ns."""
        self._due_ns = max(self._due_ns + PERIOD_NS, time.time_ns() - PERIOD_NS)
        time.sleep(max(0.0, (self._due_ns - time.time_ns()) / NS_PER_S))
        return time.time_ns()

    def tick(self) -> int:
        """Waits for the next period and lets every bridge have its tick; returns when it was, ns."""
        now_ns = self.wait()
        for vehicle in self.vehicles:
            vehicle.step(now_ns)
        return now_ns

    def run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.tick()

    def until(self, look: Callable[[], Any], what: str, most_s: float) -> float:
        """Ticks until something is true; returns how long that took, s."""
        begun = time.monotonic()
        while not look():
            assert time.monotonic() < begun + most_s, f"{what}: not within {most_s:g} s\n" + "\n".join(
                vehicle.told() for vehicle in self.vehicles
            )
            self.tick()
        return time.monotonic() - begun

    def operate(self, vehicle: Vehicle, ask: Callable[[Operator], None]) -> None:
        """The operator of a vehicle does something, while all bridges go on."""
        vehicle.operator.meanwhile = self.tick
        try:
            ask(vehicle.operator)
        finally:
            vehicle.operator.meanwhile = lambda: None

    def ready(self, *vehicles: Vehicle) -> None:
        """Waits until the bridges have these vehicles, and says that they may drive."""
        for vehicle in vehicles or self.vehicles:
            vehicle.command = lambda _: None
            self.until(lambda v=vehicle: v.operator.system is not None, "heard by its operator", BOOT_S)
            vehicle.ask_operators_streams()
            self.until(lambda v=vehicle: v.reading is not None and v.reading.healthy, "healthy", BOOT_S)
            if AWAITED in vehicle.plant.authority.why:
                vehicle.plant.clear_to_drive()
            self.until(lambda v=vehicle: v.reading.obeying and v.standing, "armed, in GUIDED, standing", 60.0)
            vehicle.plant.clear_to_drive()

    def close(self) -> None:
        """All stand, those that were armed here are disarmed, and connections are given back."""
        for vehicle in self.vehicles:
            vehicle.command = lambda _: None
        if all(vehicle.reading is not None for vehicle in self.vehicles):
            end = time.monotonic() + 5.0
            while time.monotonic() < end and not all(vehicle.standing for vehicle in self.vehicles):
                self.tick()
        for vehicle in self.vehicles:
            vehicle.plant.close()
            vehicle.operator.close()


def fleet_of(
    all_places: Sequence[Place],
    datum: Geodetic,
    formation: str = "",
    starts: Sequence[tuple[float, float]] = (),
) -> Fleet:
    """A fleet file of them; `arm = true`, since nobody sits at a transmitter here.

    Args:
        formation: the tables [formation], [control] and [trajectory]; none: one that nobody drives.
        starts: x, y (m, W) of each.
    """
    n = len(all_places)
    ids = range(1, n + 1)
    starts = starts or [(-DATUM_AWAY_M[0] + 3.0 * (robot - 1), -DATUM_AWAY_M[1]) for robot in ids]
    # A fleet has two robots at least: alone, a vehicle gets a second one that nobody runs.
    phantom = "" if n > 1 else f'[[robot]]\nid = 2\nplant = "unicycle"\nx_m = {starts[0][0] + 3.0}\ny_m = 0.0'
    count = max(n, 2)
    formation = formation or (
        f"[formation]\nedges = {[[i, i + 1] for i in range(1, count)]}\nsafe_distance_m = 1.0\n"
        f"offsets = {[[3.0 * k, 0.0] for k in range(count)]}"
    )
    robots = [
        f'[[robot]]\nid = {robot}\nx_m = {x!r}\ny_m = {y!r}\n[robot.mavlink]\nconnection = "{place.bridge}"'
        for robot, (x, y), place in zip(ids, starts, all_places, strict=True)
    ]
    text = f"""
[fleet]
name = "autopilots"
rate_hz = {NS_PER_S // PERIOD_NS}
[datum]
latitude_deg = {datum.latitude_deg!r}
longitude_deg = {datum.longitude_deg!r}
altitude_m = {datum.altitude_m!r}
[robot_defaults]
plant = "mavlink"
mass_kg = {MASS}
inertia_kgm2 = {INERTIA}
hand_offset_m = {HAND_M}
[robot_defaults.mavlink]
arm = true
baud = {BAUD}
"""
    return resolved(parse_fleet("\n".join([text, formation, *robots, phantom]), source=VARIABLE))
