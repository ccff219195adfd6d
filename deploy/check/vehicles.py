"""What would go wrong with real vehicles (`plant = "mavlink"`): connections, limits, timeouts, bodies.

Many vehicles share what is found: one finding names them all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import inf, sqrt
from typing import Final, NamedTuple

from handfast.agent.control.limits import acceleration_max, speed_max
from handfast.agent.control.peers.rolling import STOPS_S, room_to_know
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import SIMULATOR, MavlinkSection
from handfast.agent.fleet.sections import Robot
from handfast.agent.formation import trajectory
from handfast.agent.formation.geometry import Geometry
from handfast.bridges.mavlink.transport.connection_string import BY_ID, Connection, parse_connection
from handfast.deploy.check.finding import Finding, Level
from handfast.deploy.console.wording import robots

RATE_MAX_HZ: Final = 50.0
"""ArduPilot Rover's own loop: it takes nothing faster."""
PLANT_TIMEOUT_MIN_S: Final = 0.3
"""Telemetry of 25 Hz over a radio or WiFi has gaps this long now and then."""
WRENCH_TIMEOUT_MAX_S: Final = 0.3
"""From the last wrench of an agent that is gone to the brake, at most."""
HAND_OFFSET_MIN_M: Final = 0.2
"""A heading that is 0.1 s late by the vehicle's own lags swings with a shorter one."""
GYRATION_M: Final = (0.05, 2.0)
"""Radius of gyration, sqrt(J / m), of what drives on wheels."""
SPEED_SHARE: Final = 0.8
"""Share of a vehicle's speed that the trajectory may take: the rest is to form up with."""
HERE: Final = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine reaches."""
SIMULATOR_DATUM: Final = (-35.36326, 149.16523)
"""Where ArduPilot's own simulator starts, degrees."""


class _Vehicle(NamedTuple):
    row: int
    robot: Robot
    link: MavlinkSection
    connection: Connection | None
    """None of one that is simulated."""

    @property
    def real(self) -> bool:
        """Whether it is no simulation on this machine."""
        return self.connection is not None and self.connection.host not in HERE

    @property
    def networked(self) -> bool:
        """Whether others on a network may reach it."""
        return self.real and self.connection is not None and self.connection.kind != "serial"


def check_vehicles(fleet: Fleet, geometry: Geometry | None) -> list[Finding]:
    """All findings; none for a fleet without vehicles. `geometry`: None where it has none."""
    vehicles = []
    for row, robot in enumerate(fleet.robots, 1):
        link = robot.section(MavlinkSection)
        if link is not None and link.connection is not None:
            at = None if link.connection == SIMULATOR else parse_connection(link.connection)
            vehicles.append(_Vehicle(row, robot, link, at))
    if not vehicles:
        return []
    return [
        *_links(fleet, vehicles),
        *_limits(fleet, vehicles),
        *_bodies(fleet, vehicles),
        *_times(fleet),
        *_rolling(fleet, geometry, vehicles),
    ]


def _shared(
    level: Level, field: str, vehicles: list[_Vehicle], wrong: Callable[[_Vehicle], bool], text: str
) -> Iterator[Finding]:
    """One finding for all vehicles that have the same thing wrong; `{who}` in `text` names them."""
    found = [vehicle for vehicle in vehicles if wrong(vehicle)]
    if found:
        who = robots([vehicle.robot.id for vehicle in found])
        yield Finding(level, f"robot[{found[0].row}].{field}", text.replace("{who}", who))


def _again(
    vehicles: list[_Vehicle], found: Callable[[_Vehicle], object]
) -> Iterator[tuple[_Vehicle, object, _Vehicle]]:
    """Vehicles that have the same as one before, if anything: what that is, and which has it first."""
    firsts: dict[object, _Vehicle] = {}
    for vehicle in vehicles:
        it = found(vehicle)
        if it is not None and firsts.setdefault(it, vehicle) is not vehicle:
            yield vehicle, it, firsts[it]


def _listens_at(vehicle: _Vehicle) -> int | None:
    at = vehicle.connection
    return at.port if at is not None and at.kind == "udpin" else None


def _links(fleet: Fleet, vehicles: list[_Vehicle]) -> Iterator[Finding]:
    for vehicle, port, first in _again(vehicles, _listens_at):
        yield Finding(
            "error",
            f"robot[{vehicle.row}].mavlink.connection",
            f"waits on UDP port {port}, as robot {first.robot.id} does: each vehicle needs a port of its own",
        )
    for vehicle, system, first in _again(vehicles, lambda each: each.connection and each.link.system):
        yield Finding(
            "warning",
            f"robot[{vehicle.row}].mavlink.system",
            f"is {system}, as that of robot {first.robot.id}: ground stations and routers tell vehicles "
            "apart by it; give each its own (SYSID_THISMAV or MAV_SYSID of the vehicle)",
        )
    yield from _shared(
        "warning",
        "mavlink.connection",
        vehicles,
        lambda vehicle: vehicle.connection is not None and not vehicle.connection.by_id,
        "the serial port of {who} is not named by its id: after the next start it may be another vehicle's; "
        f"take the name below {BY_ID} (ls -l {BY_ID})",
    )
    yield from _shared(
        "warning",
        "mavlink.signing_key",
        vehicles,
        lambda vehicle: vehicle.networked and vehicle.link.signing_key is None,
        "{who}: messages over the network are not signed: whoever reaches the vehicle can drive it "
        "(docs/rovers.md)",
    )
    yield from _shared(
        "error",
        "mavlink.signing_key",
        vehicles,
        lambda vehicle: vehicle.connection is None and vehicle.link.signing_key is not None,
        "{who}: simulated rovers are started without a key, and what is not signed would be refused: leave "
        "signing_key out",
    )
    yield from _shared(
        "warning",
        "mavlink.arm",
        vehicles,
        lambda vehicle: vehicle.link.arm,
        "the bridge arms {who} by itself: they may move as soon as a run begins, with nobody at them having "
        "said so",
    )
    datum = fleet.datum
    if (
        any(vehicle.real for vehicle in vehicles)
        and datum is not None
        and abs(datum.latitude_deg - SIMULATOR_DATUM[0]) < 1e-4
        and abs(datum.longitude_deg - SIMULATOR_DATUM[1]) < 1e-4
    ):
        yield Finding(
            "warning",
            "datum",
            "lies where ArduPilot's own simulator starts: is that meant? Real vehicles need the place on "
            "their own field that x = 0, y = 0 stands for",
        )


def _limits(fleet: Fleet, vehicles: list[_Vehicle]) -> Iterator[Finding]:
    most = fleet.control.max_acceleration
    weakest = min(vehicles, key=lambda vehicle: vehicle.link.max_acceleration)
    if most > weakest.link.max_acceleration:
        yield Finding(
            "warning",
            "control.max_acceleration",
            f"{most:.4g} m/s2 is more than the bridge asks of robot {weakest.robot.id}, "
            f"{weakest.link.max_acceleration:.4g} m/s2: the law counts on what does not come; take at "
            f"most {weakest.link.max_acceleration:.4g}",
        )
    try:
        speed = trajectory.maximum_speed(fleet.trajectory)
    except ValueError:
        return  # `deploy.check.shape` says so
    slowest = min(vehicles, key=lambda vehicle: vehicle.link.max_speed_mps)
    limit = slowest.link.max_speed_mps
    if speed >= SPEED_SHARE * limit:
        yield Finding(
            "error" if speed >= limit else "warning",
            f"robot[{slowest.row}].mavlink.max_speed_mps",
            f"the trajectory takes {speed:.3g} m/s of robot {slowest.robot.id}'s {limit:.3g} m/s: "
            + ("it cannot follow" if speed >= limit else "little is left to form up with")
            + f"; drive at {SPEED_SHARE * limit:.3g} m/s or less, or allow it more",
        )


def _bodies(fleet: Fleet, vehicles: list[_Vehicle]) -> Iterator[Finding]:
    safe = fleet.formation.safe_distance_m
    longest = max(vehicles, key=lambda vehicle: vehicle.robot.hand_offset_m)
    if safe < 2.0 * longest.robot.hand_offset_m:
        yield Finding(
            "warning",
            "formation.safe_distance_m",
            f"{safe:.4g} m is kept between hand points, which are up to {longest.robot.hand_offset_m:.4g} m "
            "ahead of the axles: two vehicles back to back may touch; take more than "
            f"{2.0 * longest.robot.hand_offset_m:.4g} m and the length of a vehicle",
        )
    yield from _shared(
        "warning",
        "hand_offset_m",
        vehicles,
        lambda vehicle: vehicle.robot.hand_offset_m < HAND_OFFSET_MIN_M,
        f"of {{who}} is below {HAND_OFFSET_MIN_M:g} m: a real vehicle's heading, late by its lags, swings "
        "with so short a lever; 0.4 m is measured to be good",
    )
    least, largest = GYRATION_M
    yield from _shared(
        "warning",
        "inertia_kgm2",
        vehicles,
        lambda vehicle: not least < sqrt(vehicle.robot.inertia_kgm2 / vehicle.robot.mass_kg) < largest,
        "mass_kg and inertia_kgm2 of {who} do not belong to one body: about m (a^2 + b^2) / 12 is right for "
        "a vehicle a long and b wide",
    )
    yield from _shared(
        "warning",
        "position_noise_m",
        vehicles,
        lambda vehicle: max(vehicle.robot.position_noise_m, vehicle.robot.heading_noise_rad) > 0.0,
        "{who}: noise is added on purpose to what a vehicle measures, on top of its own; leave *_noise_* out",
    )


def _times(fleet: Fleet) -> Iterator[Finding]:
    control, rate = fleet.control, fleet.fleet.rate_hz
    if rate > RATE_MAX_HZ:
        yield Finding(
            "warning",
            "fleet.rate_hz",
            f"{rate:.4g} Hz is faster than a vehicle's own loop, {RATE_MAX_HZ:g} Hz, and its telemetry: 20 "
            "Hz is measured to be good",
        )
    if control.plant_timeout_s < PLANT_TIMEOUT_MIN_S:
        yield Finding(
            "warning",
            "control.plant_timeout_s",
            f"{control.plant_timeout_s:.4g} s: telemetry has gaps this long now and then, and each would "
            f"stop the robot; take {PLANT_TIMEOUT_MIN_S:g} s or more",
        )
    # Noticed at the next tick: a period comes on top.
    most = WRENCH_TIMEOUT_MAX_S - 1.0 / rate
    if control.wrench_timeout_s > most + 1e-9:
        yield Finding(
            "warning",
            "control.wrench_timeout_s",
            f"{control.wrench_timeout_s:.4g} s, and up to a period more: for so long a vehicle drives on by "
            f"itself when its agent is gone; take {max(most, 2.0 / rate):.3g} s",
        )


def _rolling(fleet: Fleet, geometry: Geometry | None, vehicles: list[_Vehicle]) -> Iterator[Finding]:
    """Whether one that nothing commands any more can roll as far as to another."""
    rolls_s = max(vehicle.robot.kind.rolls_on_s for vehicle in vehicles)
    speed = speed_max(fleet)
    way = (rolls_s + STOPS_S) * speed
    keep = fleet.formation.safe_distance_m + fleet.avoidance.margin_m
    room = room_to_know(rolls_s, speed, fleet.control.plant_timeout_s, acceleration_max(fleet), keep)
    shortest = inf if geometry is None else float(geometry.distances.min(initial=inf))
    if shortest < room:
        yield Finding(
            "info",
            "control.max_speed_mps",
            f"a vehicle whose bridge or link is lost goes on for {rolls_s:g} s by itself, up to {way:.2g} m "
            f"at {speed:g} m/s: the others keep away from that way, but who is nearer than {room:.2g} m, and "
            f"drives at it as fast, may not get out of it in time, and edges are {shortest:.3g} m",
        )
