"""The fleet file: one TOML text that says who drives where, and how; all processes of a fleet read the same.

`parse_fleet` turns the text into a `Fleet`, or raises one `FleetError` with every problem of the file, each
with its place. Fields, units and ranges are in the models of `agent.fleet.sections` and
`agent.fleet.fault_rules`, of which ``docs/fleet-file.md`` is made.

Lengths in m, times in s, angles in rad; frame W (ENU: x east, y north, heading counter-clockwise from x).
PURE but for `load_fleet`, which reads the file.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

from agent.common.schema import Problem, Reader, about, build, plain, printable, show
from agent.fleet.checks import check_fleet
from agent.fleet.fault_rules import FaultsSection
from agent.fleet.host_sections import HostSection, NetworkSection, RecordingSection
from agent.fleet.order_file import read_orders
from agent.fleet.order_sections import ORDER_FIELDS, OrderSection
from agent.fleet.safety_sections import AvoidanceSection, GeofenceSection, ObstacleSection, SupervisionSection
from agent.fleet.scenario import ScenarioError, parse_scenario
from agent.fleet.sections import (
    LAWS,
    LINK_FIELDS,
    TRAJECTORY_FIELDS,
    Body,
    ControlSection,
    DatumSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)
from agent.fleet.trajectory_checks import kinds_by_field

FILE_BYTES_MAX: Final = 1 << 20
LOOPBACK: Final = re.compile(r"127\.[0-9.]+|\[::1\]|localhost")
ANY_ADDRESS: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""Where everybody is listened to, and where a robot's own processes are then."""
_PROBLEMS_SHOWN_MAX: Final = 100


class FleetError(ValueError):
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
            "What the operator does during the drive, at given times. By hand: `handfast join`, `leave`, "
            "`replace`, `reshape`, `stop`, `resume`.",
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

        With `formation.assign` the file's edges join places: ask the fleet of `formation.resolved`.
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
        return f"{'tls' if self.is_secured else 'tcp'}/{address}:{port}"


# --- from text to models ----------------------------------------------------------------------


def load_fleet(
    path: str | Path,
    overrides: Sequence[str] = (),
    law: str | None = None,
    scenario: str | Path | None = None,
    orders: str | Path | None = None,
) -> Fleet:
    """Reads and parses a fleet file, with the faults of a scenario file and the orders of another one if they
    are given; see `parse_fleet`.

    Raises:
        FleetError: of one line when a file cannot be read.
    """
    return parse_fleet(
        read_text(path, "fleet file"),
        source=str(path),
        overrides=overrides,
        law=law,
        scenario=None if scenario is None else read_text(scenario, "scenario"),
        scenario_source=str(scenario),
        orders=None if orders is None else read_text(orders, "file of orders"),
        orders_source=str(orders),
    )


def read_text(path: str | Path, what: str) -> str:
    """The text of a file; `what` names it in messages. `FleetError` of one line when it cannot be read."""
    source = str(path)
    try:
        with open(path, "rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)  # not all of it: it may be endless
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise FleetError(source, [Problem("", f"cannot read the {what}: {reason}")]) from None
    except ValueError:  # a NUL in the path
        raise FleetError(source, [Problem("", f"cannot read the {what}: not a possible file name")]) from None
    if len(data) > FILE_BYTES_MAX:
        raise FleetError(source, [_too_large(what)])
    try:
        return data.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        message = f"a {what} must be text in UTF-8: byte 0x{data[error.start]:02x} on line {line} is not"
        raise FleetError(source, [Problem("", message)]) from None


def parse_fleet(
    text: str,
    *,
    source: str,
    overrides: Sequence[str] = (),
    law: str | None = None,
    scenario: str | None = None,
    scenario_source: str = "the scenario",
    orders: str | None = None,
    orders_source: str = "the orders",
) -> Fleet:
    """The fleet that a TOML text describes.

    `source` names the text in messages. `law` is a name of `LAWS`; `overrides` are ``table.field=value`` as
    typed after ``--set``. They win over the law, and the law over the text. `scenario` is the text of a file
    of faults: its rules come before the text's, its other settings win over them. `orders` is the text of one
    of orders, which are added to the text's. Raises `FleetError` with every problem at once (of a text that
    is not TOML, the one that its parser stops at), and nothing else.
    """
    raw = fleet_tables(text, source)
    if scenario is not None:
        add_scenario(raw, scenario, scenario_source)
    if orders is not None:
        _add_orders(raw, orders, orders_source)

    reader = Reader(Fleet)
    law_problems = _apply_law(raw, law)
    kind_before = _table(raw, "trajectory").get("kind", "hold")
    for override in overrides:
        reader.override(raw, override)
    _forget_old_kind(raw, kind_before, reader)
    values = reader.read(raw)
    check_fleet(values, raw, reader)
    problems = (*law_problems, *_with_ids(reader.problems, raw))
    if problems:
        raise FleetError(source, problems)
    return build(Fleet, values)


def fleet_tables(text: str, source: str) -> dict[str, Any]:
    """The tables of a TOML text, of which nothing is known yet. `FleetError` when it is not TOML."""
    if len(text) > FILE_BYTES_MAX:
        raise FleetError(source, [_too_large("fleet file")])
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise FleetError(source, [_syntax_problem(error)]) from None
    except RecursionError:
        too_deep = Problem("", "not valid TOML: arrays or tables nested too deeply")
        raise FleetError(source, [too_deep]) from None


def add_scenario(raw: dict[str, Any], text: str, source: str) -> None:
    """Puts the faults of a scenario into the tables of a fleet file.

    Raises:
        FleetError: of `source`, for what is wrong with the scenario.
    """
    added = fleet_tables(text, source)
    try:
        parse_scenario(text, _ids(raw))
    except ScenarioError as error:
        raise FleetError(source, error.problems) from None
    own = raw.setdefault("faults", {})
    if isinstance(own, dict):
        for key, value in added.get("faults", {}).items():
            before = own.get(key, [])
            own[key] = [*value, *before] if isinstance(value, list) and isinstance(before, list) else value


def _add_orders(raw: dict[str, Any], text: str, source: str) -> None:
    """Adds the orders of a file of orders to the tables of a fleet file; raises as `add_scenario`."""
    added = fleet_tables(text, source)
    try:
        read_orders(added, _ids(raw))
    except ScenarioError as error:
        raise FleetError(source, error.problems) from None
    own = raw.setdefault("order", [])
    if isinstance(own, list):
        own += added.get("order", [])


def _ids(raw: Mapping[str, Any]) -> list[int]:
    """Ids of the robots of a fleet file of which nothing is known yet."""
    rows = raw.get("robot")
    ids = [row.get("id") for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return [number for number in ids if isinstance(number, int)]


def _too_large(what: str) -> Problem:
    return Problem("", f"larger than {FILE_BYTES_MAX // 1024} KiB: this is not a {what}")


def _syntax_problem(error: ValueError) -> Problem:
    message = printable(str(error))
    match = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|(end of document))\)", message)
    if match is None:
        return Problem("", f"not valid TOML: {message[:200]}")
    place = match[4] or f"line {match[2]}, column {match[3]}"
    return Problem(place, f"not valid TOML: {match[1]}")


def _table(raw: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = raw.get(key)
    return value if isinstance(value, dict) else {}


def _apply_law(raw: dict[str, Any], law: str | None) -> tuple[Problem, ...]:
    if law is None:
        return ()
    if law not in LAWS:
        return (Problem("--law", f"must be one of {', '.join(LAWS)}, got {show(law)}"),)
    for table, preset in LAWS[law].items():
        given = raw.setdefault(table, {})
        if isinstance(given, dict):
            given.update(preset)
    return ()


def _forget_old_kind(raw: dict[str, Any], before: object, reader: Reader) -> None:
    """Drops the file's velocity when ``--set trajectory.kind=hold`` turns its line into another kind."""
    trajectory = _table(raw, "trajectory")
    kind = trajectory.get("kind")
    if kind == before or not isinstance(kind, str) or kind not in TRAJECTORY_FIELDS:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in set(kinds_by_field()) - {*needed, *taken}:
        if not reader.overridden(f"trajectory.{key}"):
            trajectory.pop(key, None)


def _with_ids(problems: Sequence[Problem], raw: Mapping[str, Any]) -> Iterator[Problem]:
    """``robot[3]`` counts entries: says the id as well where that is another number."""
    rows = raw.get("robot")
    for problem in problems:
        match = re.match(r"robot\[(\d+)\]", problem.place)
        if match is not None and isinstance(rows, list):
            row = rows[int(match[1]) - 1]
            number = row.get("id") if isinstance(row, dict) else None
            if type(number) is int and number != int(match[1]):
                yield Problem(problem.place, f"{problem.message} (the robot with id {show(number)})")
                continue
        yield problem


# --- from models back -------------------------------------------------------------------------


def law_name(control: ControlSection) -> str:
    """The name in `LAWS` whose coupling and kp these are, else "custom"."""
    for name, preset in LAWS.items():
        if all(getattr(control, key) == value for key, value in preset["control"].items()):
            return name
    return "custom"


def to_dict(fleet: Fleet) -> dict[str, Any]:
    """A complete table for a TOML writer: ``parse_fleet`` of what it writes gives an equal `Fleet`."""
    table = plain(fleet)
    table["trajectory"] = _of_kind(table["trajectory"], TRAJECTORY_FIELDS)
    table["order"] = [{"at": row["at"], **_of_kind(row, ORDER_FIELDS)} for row in table["order"]]
    for row in table["order"]:
        if "trajectory" in row:
            row["trajectory"] = _of_kind(row["trajectory"], TRAJECTORY_FIELDS)
    return table


def _of_kind(
    row: Mapping[str, Any], fields: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]
) -> dict[str, Any]:
    """A table without the fields that its kind does not take: to read them would be an error."""
    needed, taken = fields[row["kind"]]
    return {key: value for key, value in row.items() if key in ("kind", *needed, *taken)}


def digest(fleet: Fleet) -> str:
    """16 hex digits over what all robots must agree on.

    That is everything but where processes run and how they reach each other, the description, what is
    recorded, and how a vehicle's own computer reaches it.
    """
    table = to_dict(fleet)
    for key in ("network", "host", "recording"):
        table.pop(key, None)
    del table["fleet"]["description"]
    for robot in table["robot"]:
        robot.pop("host", None)
        for key in LINK_FIELDS:
            robot.get("mavlink", {}).pop(key, None)
    canonical = json.dumps(table, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return blake2b(canonical.encode(), digest_size=8).hexdigest()
