"""The fleet file: one TOML text that says who drives where, and how; all processes of a fleet read the same.

`parse_fleet` turns the text into a `Fleet`, or raises one `FleetError` with every problem of the file, each
with its place. Fields, units and ranges are in the models' metadata; ``docs/fleet-file.md`` is made of them.

Lengths in m, times in s, angles in rad; frame W (ENU: x east, y north, heading counter-clockwise from x).
PURE but for `load_fleet`, which reads the file.
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, Literal

from agent.fault_checks import check_faults
from agent.fault_settings import FaultsSection
from agent.messages import NEIGHBOURS_MAX
from agent.scenario import ScenarioError, parse_scenario
from agent.schema import Problem, Reader, about, build, entries, plain, printable, setting, show

Pair = tuple[float, float]
Coupling = Literal["edge", "joint", "penalty"]

FILE_BYTES_MAX: Final = 1 << 20
PORT_MIN: Final = 1024
PORT_MAX: Final = 32767  # Linux gives ports from 32768 up to outgoing connections
_FAR_M: Final = 1e6  # further away than any robot: squares of it stay far from overflow
_PROBLEMS_SHOWN_MAX: Final = 100

LAWS: Final[Mapping[str, Mapping[str, object]]] = {
    "paper": {"coupling": "edge", "kp": 0.0, "relaxation": 0.001},
    "edge": {"coupling": "edge", "kp": 1.0, "relaxation": 0.2},
    "joint": {"coupling": "joint", "kp": 1.0, "relaxation": 0.2},
    "penalty": {"coupling": "penalty", "kp": 1.0, "relaxation": 0.2},
}
"""What ``--law NAME`` sets in ``[control]``."""

TRAJECTORY_FIELDS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "hold": ((), ("start_m",)),
    "line": (("velocity_mps",), ("start_m",)),
    "circle": (("centre_m", "radius_m", "speed_mps"), ("phase_rad", "clockwise")),
    "waypoints": (("waypoints_m", "speed_mps"), ("corner_acceleration",)),
}
"""Fields that each kind of trajectory needs, and those that it takes besides; others are errors with it."""


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
class FleetSection:
    """``[fleet]``."""

    name: str = field(
        metadata=about(
            "The fleet's name: the first segment of every key on the bus, and in the name of a run's folder.",
            pattern=r"[A-Za-z0-9_-]{1,40}",
            pattern_says="1 to 40 letters, digits, - or _",
            example='"delta"',
        )
    )
    rate_hz: float = setting(50.0, "How often every agent runs its control law.", unit="Hz", ge=1, le=1000)
    duration_s: float = setting(30.0, "How long a run drives, from the common start.", unit="s", gt=0, le=1e6)
    seed: int = setting(
        0, "Seed of everything random: noise, link faults. Same seed, same run.", ge=0, le=2**63 - 1
    )
    description: str = setting(
        "", "A sentence for people; nothing depends on it.", example='"Six robots in a triangle"'
    )


@dataclass(frozen=True, slots=True)
class FormationSection:
    """``[formation]``."""

    edges: tuple[tuple[int, int], ...] = field(
        metadata=about(
            "The formation graph: pairs of robot ids that keep their distance and talk to each other.",
            example="[[1, 2], [2, 3]]",
        )
    )
    safe_distance_m: float = field(
        metadata=about(
            "r_s: two robots of an edge never come this close. Below the distance of every edge.",
            unit="m",
            gt=0,
            le=_FAR_M,
            example="0.22",
        )
    )
    offsets: tuple[Pair, ...] | None = setting(
        None,
        "Where each robot stands relative to the trajectory, one pair per `[[robot]]` in their order. "
        "This or `distance_m` must be given.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
        example="[[0.0, 0.5], [0.0, -0.5]]",
    )
    distance_m: float | tuple[float, ...] | None = setting(
        None,
        "Desired distance of every edge, or an array with one per edge. Left out: taken from `offsets`.",
        unit="m",
        gt=0,
        le=_FAR_M,
        example="1.0",
    )
    assign: bool = setting(
        False,
        "Robots take the places by least total squared distance from their starts, not in their order. "
        "Edges belong to the places: they then join the robots that took them.",
    )


@dataclass(frozen=True, slots=True)
class ControlSection:
    """``[control]``."""

    coupling: Coupling = setting(
        "joint",
        "How multipliers are found: `edge` by edge (the paper's), `joint` with those of the edges around, "
        "or `penalty`: a potential field, no multipliers.",
    )
    c1: float = setting(0.4, "Navigation: gain on the position error.", unit="1/s2", gt=0, le=1e4)
    c2: float = setting(0.6, "Navigation: gain on the velocity error.", unit="1/s", gt=0, le=1e4)
    kd: float = setting(1.8, "Damping of an edge's constraint.", unit="1/s", ge=0, le=1e4)
    k2: float = setting(5.0, "Softness of an edge's constraint.", unit="1/m2", gt=0, le=1e6)
    kp: float = setting(
        1.0, "Stiffness of an edge's constraint; 0 is the paper's law.", unit="1/s2", ge=0, le=1e4
    )
    relaxation: float = setting(
        0.2,
        "Below this share of the way from the safe distance to the wanted one the constraint goes on along "
        "its tangent, instead of to its pole at the safe distance.",
        unit="ratio",
        ge=0.001,
        lt=1,
    )
    max_acceleration: float = setting(
        5.0, "Largest commanded acceleration of the hand point.", unit="m/s2", gt=0, le=1e3
    )
    prediction: bool = setting(
        True,
        "Carries a neighbour's state forward over the age of its message; false: takes it as it came.",
    )
    prediction_horizon_s: float = setting(
        2.0,
        "A neighbour's last state is carried forward this long at most; one that is silent for longer makes "
        "the robot hold. At least two periods.",
        unit="s",
        gt=0,
        le=60,
    )
    plant_timeout_s: float = setting(
        0.2, "An agent whose plant is silent for so long stops. At least two periods.", unit="s", gt=0, le=60
    )
    wrench_timeout_s: float = setting(
        0.2, "A plant whose agent is silent for so long brakes. At least two periods.", unit="s", gt=0, le=60
    )

    clock_skew_max_s: float = setting(
        0.05,
        "A neighbour whose clock is found to be further off than this is warned of. Clocks are compared by "
        "the stamps of messages, within about one period.",
        unit="s",
        gt=0,
        le=60,
    )


@dataclass(frozen=True, slots=True)
class TrajectorySection:
    """``[trajectory]``: fields that its kind does not use keep their defaults."""

    kind: Literal["line", "waypoints", "circle", "hold"] = setting(
        "hold", "What the formation's reference point does. Fields of other kinds are errors."
    )
    start_m: Pair = setting(
        (0.0, 0.0),
        "`line`: where the reference is at the start; `hold`: where it stays.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
    )
    velocity_mps: Pair | None = setting(
        None, "`line`: constant velocity.", unit="m/s", ge=-100, le=100, example="[0.2, 0.2]"
    )
    waypoints_m: tuple[Pair, ...] | None = setting(
        None,
        "`waypoints`: at least two points, driven in order; the first is the start, the last is held.",
        unit="m",
        ge=-_FAR_M,
        le=_FAR_M,
        example="[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]",
    )
    speed_mps: float | None = setting(
        None, "`waypoints`, `circle`: speed of the reference.", unit="m/s", gt=0, le=100, example="0.3"
    )
    corner_acceleration: float = setting(
        0.3, "`waypoints`: acceleration with which corners are rounded.", unit="m/s2", gt=0, le=100
    )
    centre_m: Pair | None = setting(
        None, "`circle`: its centre.", unit="m", ge=-_FAR_M, le=_FAR_M, example="[0.0, 0.0]"
    )
    radius_m: float | None = setting(None, "`circle`: its radius.", unit="m", gt=0, le=_FAR_M, example="3.0")
    phase_rad: float = setting(
        0.0,
        "`circle`: angle of the start, seen from the centre.",
        unit="rad",
        ge=-math.tau,
        le=math.tau,
        example='"90deg"',
    )
    clockwise: bool = setting(False, "`circle`: the way round.")


@dataclass(frozen=True, slots=True)
class Body:
    """``[robot_defaults]``: what drives, and how it is measured."""

    mass_kg: float = setting(10.0, "Mass m.", unit="kg", gt=0, le=1e5)
    inertia_kgm2: float = setting(
        0.13, "Moment of inertia J about the vertical axis.", unit="kg m2", gt=0, le=1e5
    )
    hand_offset_m: float = setting(
        0.1,
        "L: the hand point, which is what is controlled, lies so far ahead of the axle.",
        unit="m",
        gt=0,
        le=100,
    )
    plant: Literal["unicycle"] = setting("unicycle", "What drives: `unicycle` is simulated.")
    max_force_n: float | None = setting(
        None, "Largest driving force; left out: no limit.", unit="N", gt=0, le=1e6, example="50.0"
    )
    max_torque_nm: float | None = setting(
        None, "Largest turning torque; left out: no limit.", unit="N m", gt=0, le=1e6, example="5.0"
    )
    actuator_lag_s: float = setting(
        0.0, "Time constant between commanded and real force and torque.", unit="s", ge=0, le=10
    )
    position_noise_m: float = setting(
        0.0, "Standard deviation of measured positions.", unit="m", ge=0, le=100
    )
    heading_noise_rad: float = setting(
        0.0, "Standard deviation of the measured heading.", unit="rad", ge=0, le=math.pi
    )
    speed_noise_mps: float = setting(
        0.0, "Standard deviation of the measured speed.", unit="m/s", ge=0, le=100
    )
    yaw_rate_noise_radps: float = setting(
        0.0, "Standard deviation of the measured yaw rate.", unit="rad/s", ge=0, le=100
    )


@dataclass(frozen=True, slots=True)
class Robot(Body):
    """One ``[[robot]]``."""

    # The file must give these; the defaults here only let them follow Body's.
    id: int = setting(0, "The robot's number, which `edges` use.", ge=1, le=9999, required=True)
    x_m: float = setting(
        0.0, "Where its centre starts, east.", unit="m", ge=-_FAR_M, le=_FAR_M, required=True, example="-1.0"
    )
    y_m: float = setting(
        0.0, "Where its centre starts, north.", unit="m", ge=-_FAR_M, le=_FAR_M, required=True, example="1.4"
    )
    heading_rad: float = setting(
        0.0,
        "Where it looks at the start, counter-clockwise from east.",
        unit="rad",
        ge=-math.tau,
        le=math.tau,
        example='"90deg"',
    )


@dataclass(frozen=True, slots=True)
class NetworkSection:
    """``[network]``."""

    address: str = setting(
        "127.0.0.1",
        "Host name or address on which every process listens.",
        pattern=r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?|\[[0-9A-Fa-f:.]{2,45}\]",
        pattern_says="a host name, an IPv4 address or an IPv6 address in [ ]",
    )
    base_port: int = setting(
        7600,
        "First TCP port. The k-th robot of the file (from 0) listens on `base_port` + 2 k (agent) and "
        f"+ 2 k + 1 (plant); all must lie within {PORT_MIN} and {PORT_MAX}.",
        ge=PORT_MIN,
        le=PORT_MAX - 1,
    )


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
    network: NetworkSection = field(
        default_factory=NetworkSection, metadata=about("Where processes listen. Not part of the digest.")
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
        """Robot ids in the file's order: the order of `formation.offsets`."""
        return tuple(robot.id for robot in self.robots)

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

    def agent_endpoint(self, robot_id: int) -> str:
        """Where a robot's agent listens, as Zenoh writes it. `FleetError` when there is no such robot."""
        return self._endpoint(2 * self.index(robot_id))

    def plant_endpoint(self, robot_id: int) -> str:
        """Where a robot's plant listens, as Zenoh writes it. `FleetError` when there is no such robot."""
        return self._endpoint(2 * self.index(robot_id) + 1)

    def _endpoint(self, number: int) -> str:
        return f"tcp/{self.network.address}:{self.network.base_port + number}"


# --- from text to models ----------------------------------------------------------------------


def load_fleet(
    path: str | Path,
    overrides: Sequence[str] = (),
    law: str | None = None,
    scenario: str | Path | None = None,
) -> Fleet:
    """Reads and parses a fleet file, with the faults of a scenario file if one is given; see `parse_fleet`.

    Raises:
        FleetError: of one line when a file cannot be read.
    """
    text = read_text(path, "fleet file")
    if scenario is None:
        return parse_fleet(text, source=str(path), overrides=overrides, law=law)
    faults = read_text(scenario, "scenario")
    return parse_fleet(
        text, source=str(path), overrides=overrides, law=law, scenario=faults, scenario_source=str(scenario)
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
) -> Fleet:
    """The fleet that a TOML text describes.

    `source` names the text in messages. `law` is a name of `LAWS`; `overrides` are ``table.field=value`` as
    typed after ``--set``. They win over the law, and the law over the text. `scenario` is the text of a file
    of faults: its rules come before the text's, its other settings win over them. Raises `FleetError` with
    every problem at once (of a text that is not TOML, the one that its parser stops at), and nothing else.
    """
    raw = fleet_tables(text, source)
    if scenario is not None:
        add_scenario(raw, scenario, scenario_source)

    reader = Reader(Fleet)
    law_problems = _apply_law(raw, law)
    kind_before = _table(raw, "trajectory").get("kind", "hold")
    for override in overrides:
        reader.override(raw, override)
    _forget_old_kind(raw, kind_before, reader)
    values = reader.read(raw)
    _check(values, raw, reader)
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
    rows = raw.get("robot")
    ids = [row.get("id") for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    added = fleet_tables(text, source)
    try:
        parse_scenario(text, [number for number in ids if isinstance(number, int)])
    except ScenarioError as error:
        raise FleetError(source, error.problems) from None
    own = raw.setdefault("faults", {})
    if isinstance(own, dict):
        for key, value in added.get("faults", {}).items():
            before = own.get(key, [])
            own[key] = [*value, *before] if isinstance(value, list) and isinstance(before, list) else value


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
    control = raw.setdefault("control", {})
    if isinstance(control, dict):
        control.update(LAWS[law])
    return ()


def _forget_old_kind(raw: dict[str, Any], before: object, reader: Reader) -> None:
    """Drops the file's velocity when ``--set trajectory.kind=hold`` turns its line into another kind."""
    trajectory = _table(raw, "trajectory")
    kind = trajectory.get("kind")
    if kind == before or not isinstance(kind, str) or kind not in TRAJECTORY_FIELDS:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in set(_kinds_by_field()) - {*needed, *taken}:
        if not reader.overridden(f"trajectory.{key}"):
            trajectory.pop(key, None)


def _kinds_by_field() -> dict[str, list[str]]:
    kinds: dict[str, list[str]] = {}
    for kind, (needed, taken) in TRAJECTORY_FIELDS.items():
        for key in (*needed, *taken):
            kinds.setdefault(key, []).append(kind)
    return kinds


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


# --- checks across fields ---------------------------------------------------------------------
# They see what Reader.read returned: valid values only, None for an element with a problem of its own.


def _check(values: Mapping[str, Any], raw: Mapping[str, Any], reader: Reader) -> None:
    robots = values.get("robots")
    formation = values.get("formation", {})
    if robots is not None:
        _check_ids(robots, reader)
        _check_ports(values.get("network", {}), len(robots), reader)
    ids = [row.get("id") for row in robots] if robots is not None else []
    if formation:
        _check_edges(formation, ids, reader)
        _check_shape(formation, ids, reader)
        _check_distances(formation, ids, reader)
    check_faults(values.get("faults", {}), [robot_id for robot_id in ids if robot_id is not None], reader)
    _check_trajectory(values.get("trajectory", {}), _table(raw, "trajectory"), reader)
    _check_timeouts(values, reader)


def _check_ids(robots: Sequence[Mapping[str, Any]], reader: Reader) -> None:
    first: dict[int, int] = {}
    for number, row in enumerate(robots, 1):
        robot_id = row.get("id")
        if robot_id is not None and first.setdefault(robot_id, number) != number:
            reader.add(
                f"robot[{number}].id",
                f"robot[{first[robot_id]}] has the id {robot_id} already: ids must differ",
            )


def _check_ports(network: Mapping[str, Any], robots: int, reader: Reader) -> None:
    base_port = network.get("base_port")
    if base_port is not None and base_port + 2 * robots - 1 > PORT_MAX:
        reader.add(
            "network.base_port",
            f"{robots} robots take ports {base_port} to {base_port + 2 * robots - 1}, which must not pass "
            f"{PORT_MAX} (the system uses those above): must be at most {PORT_MAX + 1 - 2 * robots}",
        )


def _check_edges(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    first: dict[frozenset[int], int] = {}
    known = {robot_id for robot_id in ids if robot_id is not None}
    for number, edge in enumerate(formation.get("edges", ()), 1):
        if edge is None:
            continue
        place, shown = f"formation.edges[{number}]", show(edge)
        if edge[0] == edge[1]:
            reader.add(place, f"{shown} joins robot {show(edge[0])} to itself: an edge joins two robots")
            continue
        missing = [show(end) for end in edge if end not in known]
        if missing and None not in ids and ids:  # a robot whose id could not be read may be the one
            there_are = show(sorted(known), 80)[1:-1]
            reader.add(
                place, f"{shown}: there is no robot {' and no robot '.join(missing)}; ids are {there_are}"
            )
        if first.setdefault(frozenset(edge), number) != number:
            reader.add(
                place, f"{shown} is formation.edges[{first[frozenset(edge)]}] again: give each edge once"
            )
    degrees = Counter(end for edge in first for end in edge)
    for robot_id, degree in sorted(degrees.items()):
        if degree > NEIGHBOURS_MAX:
            reader.add(
                "formation.edges",
                f"robot {robot_id} has {degree} edges: must be at most {NEIGHBOURS_MAX}, for its messages "
                "must stay small",
            )


def _check_shape(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    if "offsets" not in formation or "distance_m" not in formation:
        return
    offsets, distance = formation["offsets"], formation["distance_m"]
    if offsets is None and distance is None:
        reader.add("formation", "gives neither offsets nor distance_m: write for example distance_m = 1.0")
    if offsets is not None and ids and len(offsets) != len(ids):
        reader.add(
            "formation.offsets", f"must have one pair per [[robot]], got {len(offsets)} for {len(ids)} robots"
        )
    edges = formation.get("edges")
    if isinstance(distance, tuple) and edges is not None and len(distance) != len(edges):
        reader.add(
            "formation.distance_m",
            f"must be one number or one per edge, got {len(distance)} for {len(edges)} edges",
        )


def _check_distances(formation: Mapping[str, Any], ids: Sequence[int | None], reader: Reader) -> None:
    edges, safe = formation.get("edges"), formation.get("safe_distance_m")
    offsets, distance = formation.get("offsets"), formation.get("distance_m")
    rule = f"r_s must be below every distance, and safe_distance_m is {show(safe)}"
    if isinstance(distance, float) and safe is not None and distance <= safe:
        reader.add("formation.distance_m", f"{show(distance)} is too small: {rule}")
    if isinstance(distance, tuple) and safe is not None:
        for number, value in enumerate(distance, 1):
            if value is not None and value <= safe:
                reader.add(f"formation.distance_m[{number}]", f"{show(value)} is too small: {rule}")
    if offsets is None or edges is None or len(offsets) != len(ids):
        return
    slot = dict(zip(ids, offsets, strict=True))
    for number, edge in enumerate(edges, 1):
        if edge is None or edge[0] == edge[1] or slot.get(edge[0]) is None or slot.get(edge[1]) is None:
            continue
        apart = math.dist(slot[edge[0]], slot[edge[1]])
        place, shown = f"formation.edges[{number}]", show(edge)
        if apart == 0.0:
            reader.add(place, f"{shown} joins two robots with the same offset, {show(slot[edge[0]])}")
        elif distance is None and "distance_m" in formation and safe is not None and apart <= safe:
            reader.add(place, f"{shown}: the offsets are {apart:.6g} m apart, too close: {rule}")


def _check_trajectory(trajectory: Mapping[str, Any], raw: Mapping[str, Any], reader: Reader) -> None:
    kind = trajectory.get("kind")
    if kind is None:
        return
    needed, taken = TRAJECTORY_FIELDS[kind]
    for key in needed:
        if key not in raw:
            example = entries(TrajectorySection)[key].setting.example
            reader.add(
                f"trajectory.{key}", f'is missing: kind = "{kind}" needs it, for example {key} = {example}'
            )
    for key, kinds in _kinds_by_field().items():
        if key in raw and key not in (*needed, *taken):
            users = " and ".join(f'kind = "{name}"' for name in kinds)
            reader.add(
                f"trajectory.{key}", f'is used by {users} only, but here kind = "{kind}": leave it out'
            )
    if kind == "waypoints" and trajectory.get("waypoints_m") is not None:
        points = trajectory["waypoints_m"]
        if len(points) < 2:
            reader.add("trajectory.waypoints_m", f"must have at least 2 points, got {len(points)}")
        for number in range(1, len(points)):
            if points[number] is not None and points[number] == points[number - 1]:
                reader.add(
                    f"trajectory.waypoints_m[{number + 1}]",
                    f"{show(points[number])} is the point before it again",
                )


def _check_timeouts(values: Mapping[str, Any], reader: Reader) -> None:
    rate = values.get("fleet", {}).get("rate_hz")
    for key in ("plant_timeout_s", "wrench_timeout_s", "prediction_horizon_s"):
        timeout = values.get("control", {}).get(key)
        if rate is not None and timeout is not None and timeout < 2 / rate * (1 - 1e-9):
            reader.add(
                f"control.{key}",
                f"must be at least two periods, {2 / rate:.6g} s at fleet.rate_hz = {show(rate)}, "
                f"got {show(timeout)}",
            )


# --- from models back -------------------------------------------------------------------------


def law_name(control: ControlSection) -> str:
    """The name in `LAWS` whose coupling and kp these are, else "custom"."""
    for name, preset in LAWS.items():
        if all(getattr(control, key) == value for key, value in preset.items()):
            return name
    return "custom"


def to_dict(fleet: Fleet) -> dict[str, Any]:
    """A complete table for a TOML writer: ``parse_fleet`` of what it writes gives an equal `Fleet`."""
    table = plain(fleet)
    needed, taken = TRAJECTORY_FIELDS[fleet.trajectory.kind]
    table["trajectory"] = {k: v for k, v in table["trajectory"].items() if k in ("kind", *needed, *taken)}
    return table


def digest(fleet: Fleet) -> str:
    """16 hex digits over what all robots must agree on: everything but ``[network]`` and the description."""
    table = to_dict(fleet)
    del table["network"], table["fleet"]["description"]
    canonical = json.dumps(table, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return blake2b(canonical.encode(), digest_size=8).hexdigest()
