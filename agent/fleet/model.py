"""The fleet: who drives where, and how; all processes of a fleet hold the same (PURE).

Fields, units and ranges are in the models of `agent.fleet.sections` and its neighbours, of which
``docs/fleet-file.md`` is made; `agent.fleet.loading` makes a `Fleet` of a file.

Lengths in m, times in s, angles in rad; frame W (ENU: x east, y north, heading counter-clockwise from x).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from handfast.agent.common.errors import Error
from handfast.agent.common.reader import Problem
from handfast.agent.common.settings import about
from handfast.agent.common.wording import printable, show
from handfast.agent.fleet.fault_rules import FaultsSection
from handfast.agent.fleet.hosts import (
    CROWD,
    CROWD_LEASE_MS,
    LEASE_MS,
    MESH_ROBOTS_MAX,
    HostSection,
    NetworkSection,
    RecordingSection,
    RouterPlace,
    routers_of,
)
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.fleet.safety import (
    BEACON_HORIZONS,
    BEACON_HZ,
    BEACONS_HZ,
    BEACONS_MANY,
    AvoidanceSection,
    GeofenceSection,
    ObstacleSection,
    SupervisionSection,
)
from handfast.agent.fleet.sections import (
    SEND_ALONE_S,
    SEND_PERIODS,
    Body,
    ControlSection,
    DatumSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)

LOOPBACK: Final = re.compile(r"127\.[0-9.]+|\[::1\]|localhost")
"""Addresses that only this machine reaches."""

ANY_ADDRESS: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""Where everybody is listened to, and where a robot's own processes are then."""

LISTEN_BEACONS: Final = 2
"""So many times all others have said where they are before a robot joins in a drive."""

_PROBLEMS_SHOWN_MAX: Final = 100


class FleetError(Error, ValueError):
    """A fleet file that cannot be used. `problems` is never empty; `str()` lists them, one to a line."""

    def __init__(self, source: str, problems: Sequence[Problem]) -> None:
        self.source = source
        self.problems: tuple[Problem, ...] = tuple(problems)
        super().__init__(source, self.problems)

    def __str__(self) -> str:
        source = printable(self.source)
        if len(self.problems) == 1 and not self.problems[0].place:
            return f"{source}: {self.problems[0].message}"
        count = len(self.problems)
        lines = [f"{source}: {count} problem{'s' if count != 1 else ''}"]
        lines += [f"  {problem}" for problem in self.problems[:_PROBLEMS_SHOWN_MAX]]
        if count > _PROBLEMS_SHOWN_MAX:
            lines.append(f"  ... and {count - _PROBLEMS_SHOWN_MAX} more")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class Fleet:
    """A whole fleet file, valid in itself. Methods are for start-up: they search, and cache nothing."""

    fleet: FleetSection = field(metadata=about("The run."))
    formation: FormationSection = field(metadata=about("Who keeps which distance from whom."))
    control: ControlSection = field(
        metadata=about("The control law and its limits; `--law` presets some of them.")
    )
    trajectory: TrajectorySection = field(metadata=about("Where the formation as a whole goes."))
    robots: tuple[Robot, ...] = field(
        metadata=about(
            "One entry per robot. It may hold any field of `[robot_defaults]` as well.",
            key="robot",
            shared=("robot_defaults", Body),
        )
    )
    avoidance: AvoidanceSection = field(
        default_factory=AvoidanceSection,
        metadata=about("What robots keep away from beside the neighbours that they share an edge with."),
    )
    obstacles: tuple[ObstacleSection, ...] = field(
        default=(),
        metadata=about(
            "Things that stand in the way: each a circle (`centre_m`, `radius_m`) or a polygon (`points_m`).",
            key="obstacle",
        ),
    )
    geofence: GeofenceSection | None = field(
        default=None, metadata=about("Where robots may be. Left out: everywhere.")
    )
    supervision: SupervisionSection = field(
        default_factory=SupervisionSection, metadata=about("When robots slow down, hold, or go on without.")
    )
    orders: tuple[OrderSection, ...] = field(
        default=(),
        metadata=about(
            "What the operator does during the drive, at given times. By hand: `handfast change`, `stop`, "
            "`resume`.",
            key="order",
        ),
    )
    network: NetworkSection = field(
        default_factory=NetworkSection,
        metadata=about("How processes reach each other. Not part of the digest."),
    )
    hosts: tuple[HostSection, ...] = field(
        default=(),
        metadata=about(
            "A computer on which robots' processes run (`[robot] host`), and how `handfast up` logs in "
            "there. What is left out is as your ssh configuration has it. Not part of the digest.",
            key="host",
            named="name",
        ),
    )
    recording: RecordingSection = field(
        default_factory=RecordingSection,
        metadata=about("What robots' computers record. Not part of the digest."),
    )
    datum: DatumSection | None = field(
        default=None,
        metadata=about(
            "Where x = 0, y = 0 lies on the earth. Needed as soon as a robot is a real vehicle: all of them "
            "drive about this one point."
        ),
    )
    faults: FaultsSection = field(
        default_factory=FaultsSection,
        metadata=about(
            "What goes wrong on purpose. `[faults]` itself holds for every link between agents, "
            "`[[faults.rule]]` for some links, robots or times. For each effect the first rule that gives it "
            "wins (docs/faults.md)."
        ),
    )

    @property
    def beacon_rounds(self) -> int:
        """Control periods between two beacons of one robot."""
        return max(1, round(self.fleet.rate_hz / BEACON_HZ))

    @property
    def beacon_rounds_max(self) -> int:
        """The most control periods between two beacons of one robot that nothing is new of; a multiple of
        `beacon_rounds`."""
        longest_s, robots = self.avoidance.beacon_interval_max_s, len(self.robots)
        if longest_s is None:
            longest_s = robots / BEACONS_HZ if robots > BEACONS_MANY else 0.0
        longest_s = min(longest_s, BEACON_HORIZONS * self.control.prediction_horizon_s)
        turns = int(longest_s * self.fleet.rate_hz / self.beacon_rounds + 1e-9)
        return max(1, turns) * self.beacon_rounds

    @property
    def is_large(self) -> bool:
        """Whether there are so many robots that each tells seldom what is no news, and works out little at a
        time about those that it does not hear."""
        return self.beacon_rounds_max > self.beacon_rounds

    @property
    def hands_within_ns(self) -> int:
        """Within so long a robot sends two hand states, whatever happens, ns."""
        control, period_ns = self.control, self.period_ns
        if control.send == "periodic":
            return period_ns
        most_s = min(SEND_PERIODS / self.fleet.rate_hz, 0.5 * control.prediction_horizon_s)
        if self.is_large:
            most_s = min(most_s, SEND_ALONE_S)
        return max(period_ns, round(most_s * 1e9))

    @property
    def listening_rounds(self) -> int:
        """Control periods in which a robot hears `LISTEN_BEACONS` beacons of every other, or the one that
        comes seldom."""
        return LISTEN_BEACONS * self.beacon_rounds + self.beacon_rounds_max - self.beacon_rounds

    @property
    def period_ns(self) -> int:
        """One control period, in ns."""
        return round(1e9 / self.fleet.rate_hz)

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of all robots in the file's order, those in reserve too."""
        return tuple(robot.id for robot in self.robots)

    @property
    def members(self) -> tuple[Robot, ...]:
        """Robots that have a place from the start, in the file's order: the order of `formation.offsets`."""
        return tuple(robot for robot in self.robots if not robot.reserve)

    @property
    def is_resolved(self) -> bool:
        """Whether the formation is written out, as `agent.formation.geometry.resolved` does it."""
        formation = self.formation
        return (
            formation.offsets is not None and isinstance(formation.distance_m, tuple) and not formation.assign
        )

    def index(self, robot_id: int) -> int:
        """Position of a robot in the file, from 0. `FleetError` when there is no such robot."""
        for index, robot in enumerate(self.robots):
            if robot.id == robot_id:
                return index
        there_are = show(self.ids, 200)[1:-1]
        message = f"there is no robot {show(robot_id)}; ids are {there_are}"
        raise FleetError(f"fleet {self.fleet.name}", [Problem("", message)])

    def robot(self, robot_id: int) -> Robot:
        """The robot of that id. `FleetError` when there is none."""
        return self.robots[self.index(robot_id)]

    def neighbours(self, robot_id: int) -> tuple[int, ...]:
        """Ids at the other end of a robot's edges, ascending. `FleetError` when there is no such robot.

        With `formation.assign` the file's edges join places: ask the fleet that
        `agent.formation.geometry.resolved` returns.
        """
        self.index(robot_id)
        return tuple(sorted(i if j == robot_id else j for i, j in self.formation.edges if robot_id in (i, j)))

    def degree(self, robot_id: int) -> int:
        """Number of a robot's edges. `FleetError` when there is no such robot."""
        return len(self.neighbours(robot_id))

    @property
    def is_secured(self) -> bool:
        """Whether links are encrypted and authenticated, and orders signed."""
        if self.network.security is not None:
            return self.network.security != "off"
        return any(robot.host is not None for robot in self.robots)

    @property
    def is_routed(self) -> bool:
        """Whether robots are to be linked to routers instead of to each other."""
        network = self.network
        if network.topology is not None:
            return network.topology == "routed"
        return bool(network.routers) or len(self.robots) > MESH_ROBOTS_MAX

    @property
    def is_crowded(self) -> bool:
        """Whether a machine has more than `CROWD` of its robots."""
        hosts = [robot.host for robot in self.robots]
        return len(hosts) > CROWD and max(map(hosts.count, set(hosts))) > CROWD

    @property
    def lease_ms(self) -> int:
        """A process from which nothing comes on a link for so long is gone, ms."""
        return CROWD_LEASE_MS if self.is_crowded else LEASE_MS

    @property
    def batches_beacons(self) -> bool:
        """Whether its routers pass beacons on in batches, as all robots hear all of them."""
        return self.is_routed and self.is_large

    @property
    def batches_hands(self) -> bool:
        """Whether they pass on hand states in batches, too: where all robots share a machine. There a message
        costs more than what is in it; over a network nobody is to get what he does not listen to."""
        return self.batches_beacons and self.is_crowded and len({robot.host for robot in self.robots}) == 1

    @property
    def routers(self) -> tuple[RouterPlace, ...]:
        """The routers that robots are linked to, in the order in which they try them; none in a mesh, nor
        where only who runs the whole fleet can start some (`deploy.processes.placement`)."""
        return routers_of(self.network, self.hosts, self.robots) if self.is_routed else ()

    @property
    def router_endpoints(self) -> tuple[str, ...]:
        """Where its routers are reached, as Zenoh writes it."""
        return tuple(f"{self._scheme}/{router.where}" for router in self.routers)

    def router_on(self, host: str) -> RouterPlace | None:
        """The router that `handfast up` starts on a host, None where there is none."""
        return next((router for router in self.routers if router.host == host), None)

    def host_of(self, robot_id: int) -> HostSection | None:
        """The computer of a robot, None where it has none. `FleetError` when there is no such robot."""
        name = self.robot(robot_id).host
        return next((host for host in self.hosts if host.name == name), None)

    def agent_endpoint(self, robot_id: int) -> str:
        """Where others reach a robot's agent, as Zenoh writes it. `FleetError` when there is no such one."""
        return self._endpoint(robot_id, 0)

    def plant_endpoint(self, robot_id: int) -> str:
        """Where others reach a robot's plant, as Zenoh writes it. `FleetError` when there is no such one."""
        return self._endpoint(robot_id, 1)

    def agent_listens(self, robot_id: int) -> tuple[str, ...]:
        """Where a robot's agent listens, as Zenoh writes it. `FleetError` when there is no such robot."""
        return self._listens(robot_id, 0)

    def plant_listens(self, robot_id: int) -> tuple[str, ...]:
        """Where a robot's plant listens, as Zenoh writes it. `FleetError` when there is no such robot."""
        return self._listens(robot_id, 1)

    def agent_near(self, robot_id: int) -> str:
        """Where a robot's own processes reach its agent, which does not go with an address of its computer.

        `FleetError` when there is no such robot.
        """
        return self._endpoint(robot_id, 0, self._near(robot_id))

    def plant_near(self, robot_id: int) -> str:
        """As `agent_near`, of its plant."""
        return self._endpoint(robot_id, 1, self._near(robot_id))

    def _listens(self, robot_id: int, which: int) -> tuple[str, ...]:
        address, near = self._listening(robot_id), self._near(robot_id)
        addresses = (address,) if address == near or address in ANY_ADDRESS else (address, near)
        return tuple(self._endpoint(robot_id, which, each) for each in addresses)

    def _listening(self, robot_id: int) -> str:
        host = self.host_of(robot_id)
        return self.network.address if host is None else host.listen or host.address or host.name

    def _near(self, robot_id: int) -> str:
        address = self._listening(robot_id)
        if self.host_of(robot_id) is None or LOOPBACK.fullmatch(address):
            return address
        return ANY_ADDRESS.get(address, "127.0.0.1")

    def _endpoint(self, robot_id: int, which: int, address: str | None = None) -> str:
        port = self.network.base_port + 2 * self.index(robot_id) + which
        host = self.host_of(robot_id)
        if address is None:
            address = self.network.address if host is None else host.address or host.name
        return f"{self._scheme}/{address}:{port}"

    @property
    def _scheme(self) -> str:
        return "tls" if self.is_secured else "tcp"


class FormationError(FleetError):
    """The file's formation is not one: the message names the field, the values and what is wrong."""

    def __init__(self, message: str) -> None:
        super().__init__("[formation]", [Problem("", message)])
        self.message = message

    def __str__(self) -> str:
        return self.message
