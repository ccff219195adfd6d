"""Messages of the bus as JSON, the form in which a recording keeps them, and their JSON schemas.

JSON because Foxglove and every other MCAP tool reads it without our code. Python writes the
shortest decimal that reads back to the same double, so nothing is lost. Rows become objects
(``{"neighbour": 2, "value": 0.5}``): Foxglove has no arrays within arrays, and its message
paths find and filter by these names.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from json.encoder import encode_basestring_ascii as _quoted
from operator import itemgetter
from typing import Any, Final, NamedTuple, get_type_hints

from agent.messages.sequence_numbers import FIRST_ROUND
from agent.messages.types import (
    TOPICS,
    Ask,
    Beacon,
    Checks,
    Event,
    Faults,
    HandState,
    Heartbeat,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)

CLASSES: Final[tuple[type[Message], ...]] = (
    HandState, PlantState, Wrench, Mission, Stop, Status, Faults, LinkTrace, Event, Resume, Checks, Beacon,
    Heartbeat, Ask,
)  # fmt: skip

_ROBOT: Final = "Number of the robot"
_SEQUENCE: Final = "Sequence number, counted by the sender for this topic"
_ROUND: Final = (
    f"Sequence number: {FIRST_ROUND} + the periods from the mission's epoch to time_ns; before the mission "
    "is known, counted from 0"
)
_TIME: Final = "Wall clock at which the content holds, ns since the Unix epoch"

_DOUBT: Final = "Position uncertainty: how far it may be from there, m; 0 unless its plant is lost"

DESCRIPTIONS: Final[dict[type[Message], dict[str, str]]] = {
    HandState: {
        "robot": _ROBOT,
        "sequence": _ROUND,
        "time_ns": _TIME,
        "following": "False while the robot brakes instead of following the law",
        "degree": "How many constraints act on it: edges, and what it is kept away from",
        "x": "Hand point, east, m (world ENU)",
        "y": "Hand point, north, m (world ENU)",
        "vx": "Velocity of the hand point, east, m/s",
        "vy": "Velocity of the hand point, north, m/s",
        "navigation_x": "Navigation force per unit mass, east, m/s2",
        "navigation_y": "Navigation force per unit mass, north, m/s2",
        "constraint_x": "Constraint force per unit mass, east, m/s2",
        "constraint_y": "Constraint force per unit mass, north, m/s2",
        "correction_x": "What safety filter and detour add to the two forces, east, m/s2",
        "correction_y": "What safety filter and detour add to the two forces, north, m/s2",
        "doubt": _DOUBT,
        "multipliers": "The sender's multipliers: of each edge, and of each robot it is kept from",
        "heard": "Least apparent delay of each neighbour's hand states; empty in most messages",
    },
    PlantState: {
        "robot": _ROBOT,
        "sequence": _ROUND,
        "time_ns": _TIME,
        "x": "Position, east, m (world ENU)",
        "y": "Position, north, m (world ENU)",
        "heading": "Heading, rad, counter-clockwise from east",
        "speed": "Speed along the heading, m/s",
        "yaw_rate": "Yaw rate, rad/s, counter-clockwise",
        "force": "Force that acts along the heading, after limits, N",
        "torque": "Torque that acts, after limits, N m",
        "driving": "False while the plant brakes of its own accord",
        "healthy": "False when the measurement must not be used",
        "obeying": "False when the body's operator has it",
        "note": "Why it is not healthy, or does not obey",
    },
    Wrench: {
        "robot": _ROBOT,
        "sequence": _ROUND,
        "time_ns": _TIME,
        "force": "Force asked for, along the heading, N",
        "torque": "Torque asked for, N m",
        "brake": "True when the plant is asked to brake",
    },
    Mission: {
        "version": "Grows with every change",
        "time_ns": _TIME,
        "epoch_ns": "Wall clock at which fleet time is zero, ns since the Unix epoch",
        "duration_ns": "For how long the fleet drives, ns",
        "digest": "Names the fleet file that the operator means",
        "from_ns": "Wall clock at which all take it over, ns since the Unix epoch; 0: the epoch",
        "blend_ns": "Within so long they come to it from what they drove before, ns",
        "note": "What has changed, in words",
        "trajectory_ns": "Wall clock of the trajectory's time 0, ns since the Unix epoch; 0: the epoch",
        "trajectory": "Where the formation goes; empty: as in the fleet file",
        "robots": "Who has a place, and its offset; empty: as in the fleet file",
        "edges": "Who keeps which distance from whom; empty: as in the fleet file",
    },
    Stop: {
        "version": "Grows with every change",
        "time_ns": _TIME,
        "reason": "Why the operator stops the fleet",
    },
    Status: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "state": "State of the agent's supervision",
        "transition": "Row of its table of transitions that led there",
        "reason": "Why it is in that state",
        "mission_version": "Version of the mission that the agent follows",
        "order_version": "Version of the last stop or resume that it has acknowledged",
        "neighbours": "What came from each neighbour, and how its clock stands",
        "tick_us": "Duration of every tick since the last status, us; empty in virtual time",
        "ages_us": "Age of every neighbour's hand state at every tick since the last status, us",
        "counters": "Totals since the agent started",
    },
    Faults: {
        "version": "Replaces the lesser ones of the same author",
        "time_ns": _TIME,
        "author": "Whose rules these are; *: all are cleared",
        "origin_ns": "Wall clock from which the rules' times count, ns since the Unix epoch",
        "lease_ns": "How long the rules hold after time_ns, ns; 0: until they are cleared",
        "rules": "The rules, TOML as in a fleet file",
    },
    LinkTrace: {
        "robot": "Number of the robot that received",
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "entries": "What was done to each message under a fault rule",
    },
    Event: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "role": "agent or plant: which process of the robot",
        "what": "kill, start, stop (SIGSTOP) or continue",
        "rule": "Name of the rule that asked for it",
    },
    Resume: {
        "version": "Grows with every stop and resume",
        "time_ns": _TIME,
        "robots": "Numbers of the robots that may drive again; none: all",
    },
    Checks: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "lines": "What was looked at, how it stands (ok, warning, blocking), what was found, what to do",
    },
    Beacon: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "following": "False while the robot brakes instead of following the law",
        "x": "Hand point, east, m (world ENU)",
        "y": "Hand point, north, m (world ENU)",
        "vx": "Velocity of the hand point, east, m/s",
        "vy": "Velocity of the hand point, north, m/s",
        "doubt": _DOUBT,
        "mission_version": "Version of the mission that it has acknowledged",
        "mission_tag": "Tells missions of one version apart",
        "stop_version": "Version of the last stop that it has acknowledged, -1 for none",
        "resume_version": "Version of the last resume that it has acknowledged, -1 for none",
        "silent": "Robots that it has not heard for a while, as they were when it did",
    },
    Heartbeat: {"time_ns": _TIME, "author": "Who is there"},
    Ask: {"time_ns": _TIME, "author": "Who asks for the mission and the last stop or resume"},
}


class _Column(NamedTuple):
    """One column of a field that holds rows: its JSON name and type.

    `texts`: the message holds an index into them, the JSON the text itself. `added`: what stands for
    it in a recording of version 1, which had no such column. `value`: anything, which the JSON holds as a
    text of JSON, since a schema has one type for it.
    """

    name: str
    kind: str
    description: str = ""
    texts: tuple[str, ...] = ()
    added: int | None = None
    value: bool = False


_WHAT: Final = (
    "Sum of 1: lost, 2: the second copy, 4: corrupted, 8: reordered, 16: held, "
    "32: lost to the range channel, 64: lost to a full queue; 0: untouched"
)
_NEIGHBOUR: Final = _Column("neighbour", "integer")
_ROWS: Final[dict[type[Message], dict[str, tuple[_Column, ...]]]] = {
    HandState: {
        "multipliers": (_NEIGHBOUR, _Column("value", "number")),
        "heard": (
            _NEIGHBOUR,
            _Column(
                "delay_us",
                "integer",
                "Clock at its reception minus its stamp, us; negative when clocks differ",
            ),
        ),
    },
    Mission: {
        "trajectory": (
            _Column("field", "string", "Field of [trajectory] in a fleet file"),
            _Column("value", "string", "Its value, as JSON", value=True),
        ),
        "robots": (
            _Column("robot", "integer"),
            _Column("x", "number", "Offset from the trajectory, east, m"),
            _Column("y", "number", "Offset from the trajectory, north, m"),
        ),
        "edges": (
            _Column("robot", "integer"),
            _Column("other", "integer"),
            _Column("distance", "number", "Wanted distance of their hand points, m"),
        ),
    },
    Beacon: {
        "silent": (
            _Column("robot", "integer"),
            _Column("time_ns", "integer", _TIME),
            _Column("following", "boolean"),
            _Column("x", "number", "Hand point, east, m (world ENU)"),
            _Column("y", "number", "Hand point, north, m (world ENU)"),
            _Column("vx", "number", "Velocity of the hand point, east, m/s"),
            _Column("vy", "number", "Velocity of the hand point, north, m/s"),
        ),
    },
    Status: {
        "neighbours": (
            _Column("robot", "integer"),
            _Column("age_us", "integer", "Age of its hand state now, us; -1: never heard"),
            _Column("received", "integer", "Hand states that came", added=0),
            _Column("lost", "integer", "Hand states that did not come", added=0),
            _Column("offset_us", "integer", "Its clock minus the own, us", added=0),
            _Column("error_us", "integer", "Half the offset's uncertainty, us; -1: not known", added=-1),
        ),
        "counters": (_Column("name", "string"), _Column("value", "integer")),
    },
    Checks: {
        "lines": (
            _Column("name", "string"),
            _Column("level", "string", "ok, warning or blocking"),
            _Column("found", "string"),
            _Column("advice", "string"),
        ),
    },
    LinkTrace: {
        "entries": (
            _Column("source", "integer", "Number of the robot that sent"),
            _Column(
                "topic",
                "string",
                "hand: agent to agent, state: plant to agent, wrench: agent to plant, beacon: agent to all",
                TOPICS,
            ),
            _Column("sequence", "integer", "Sequence number of the message"),
            _Column("time_ns", "integer", "Stamp of the message, ns since the Unix epoch"),
            _Column("what", "integer", _WHAT),
            _Column("delay_us", "integer", "Injected delay after the stamp, us; -1: lost"),
        ),
    },
}  # fmt: skip
_ADDED_FIELDS: Final[dict[type[Message], dict[str, Any]]] = {
    HandState: {"correction_x": 0.0, "correction_y": 0.0, "doubt": 0.0, "heard": ()},
    Beacon: {"doubt": 0.0},
    PlantState: {"obeying": True},
    Mission: dict(Mission._field_defaults),
    Status: {"transition": "", "order_version": 0},
}
"""Fields that messages of earlier versions had not, and what stands for them; `HandState.degree` apart."""
_SCALARS: Final = {int: "integer", float: "number", bool: "boolean", str: "string"}


def schema_name(cls: type[Message]) -> str:
    """Name of a message's schema in a recording, such as ``handfast.HandState``."""
    return f"handfast.{cls.__name__}"


def schema(cls: type[Message]) -> dict[str, Any]:
    """JSON schema of one message class, generated from its fields."""
    properties: dict[str, Any] = {}
    hints = get_type_hints(cls)
    for name in cls._fields:
        field: dict[str, Any] = {"description": DESCRIPTIONS[cls][name]}
        if name in _ROWS.get(cls, ()):
            columns = {column.name: _column_schema(column) for column in _ROWS[cls][name]}
            item = {"type": "object", "properties": columns, "required": list(columns)}
            field |= {"type": "array", "items": item}
        elif hints[name] in _SCALARS:
            field["type"] = _SCALARS[hints[name]]
        else:  # the only other kind of field: a row of integers
            assert hints[name] == tuple[int, ...], f"{cls.__name__}.{name} needs a JSON form"
            field |= {"type": "array", "items": {"type": "integer"}}
        properties[name] = field
    return {
        "title": schema_name(cls),
        "description": (cls.__doc__ or "").split("\n", 1)[0],
        "type": "object",
        "properties": properties,
        "required": list(cls._fields),
    }


def _column_schema(column: _Column) -> dict[str, Any]:
    described = {"description": column.description} if column.description else {}
    texts = {"enum": list(column.texts)} if column.texts else {}
    return {"type": column.kind, **described, **texts}


# The classes that come often are written by a template, three times faster than
# a dictionary through json.dumps; repr() of a finite float is its JSON form.
def _template(cls: type[Message]) -> str:
    form = {int: "%d", float: "%r", bool: "%s", str: "%s"}
    hints = get_type_hints(cls)
    parts = [f'"{name}":' + form.get(hints[name], "[%s]") for name in cls._fields]
    return "{" + ",".join(parts) + "}"


_HAND: Final = _template(HandState)
_PLANT: Final = _template(PlantState)
_WRENCH: Final = _template(Wrench)
_BEACON: Final = _template(Beacon)
_TRUTH: Final = {False: "false", True: "true"}


def _hand(m: HandState) -> str:
    robot, sequence, time_ns, following, degree, *numbers, multipliers, heard = m
    # % is the fastest form, and this one runs for every message of every robot.
    values = ",".join(['{"neighbour":%d,"value":%r}' % pair for pair in multipliers])  # noqa: UP031
    delays = ",".join(['{"neighbour":%d,"delay_us":%d}' % pair for pair in heard])  # noqa: UP031
    follows = _TRUTH[following]
    return _HAND % (robot, sequence, time_ns, follows, degree, *numbers, values, delays)


def _plant(m: PlantState) -> str:
    (
        robot,
        sequence,
        time_ns,
        x,
        y,
        heading,
        speed,
        yaw_rate,
        force,
        torque,
        driving,
        healthy,
        obeying,
        note,
    ) = m
    flags = _TRUTH[driving], _TRUTH[healthy], _TRUTH[obeying], _quoted(note)
    return _PLANT % (robot, sequence, time_ns, x, y, heading, speed, yaw_rate, force, torque, *flags)


def _wrench(m: Wrench) -> str:
    robot, sequence, time_ns, force, torque, brake = m
    return _WRENCH % (robot, sequence, time_ns, force, torque, _TRUTH[brake])


def _beacon(m: Beacon) -> str:
    robot, sequence, time_ns, following, *rest, silent = m
    names = [column.name for column in _ROWS[Beacon]["silent"]]
    rows = ",".join([_dumps(dict(zip(names, row, strict=True))) for row in silent])
    return _BEACON % (robot, sequence, time_ns, _TRUTH[following], *rest, rows)


def _other(m: Message) -> str:
    content: dict[str, Any] = dict(zip(m._fields, m, strict=True))
    for field, columns in _ROWS.get(type(m), {}).items():
        names = [column.name for column in columns]
        content[field] = [dict(zip(names, row, strict=True)) for row in content[field]]
        for column in columns:
            for row in content[field]:
                if column.texts:
                    row[column.name] = column.texts[row[column.name]]
                elif column.value:
                    row[column.name] = _dumps(row[column.name])
    return _dumps(content)


def _dumps(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


_WRITERS: Final[dict[type[Message], Callable[[Any], str]]] = {
    HandState: _hand, PlantState: _plant, Wrench: _wrench,
    Mission: _other, Stop: _other, Status: _other, Faults: _other, LinkTrace: _other, Event: _other,
    Resume: _other, Checks: _other, Beacon: _beacon, Heartbeat: _other, Ask: _other,
}  # fmt: skip


def to_json(message: Message) -> bytes:
    """The message as one line of JSON, its fields in the order of the class. Its floats must be finite."""
    return _WRITERS[type(message)](message).encode()


def reader(cls: type[Message]) -> Callable[[dict[str, Any]], Message]:
    """A function from a parsed JSON object to the message. Recordings of earlier versions are read as well.

    The function raises KeyError, TypeError or ValueError for an object that is not such a message.
    """
    values = itemgetter(*cls._fields)
    added = _ADDED_FIELDS.get(cls, {})
    rows = [(cls._fields.index(name), _row(columns)) for name, columns in _ROWS.get(cls, {}).items()]
    hints = get_type_hints(cls)
    plain = [index for index, name in enumerate(cls._fields) if hints[name] == tuple[int, ...]]
    if not rows and not plain and not added:
        return lambda content: cls._make(values(content))

    def read(content: dict[str, Any]) -> Message:
        try:
            fields = list(values(content))
        except KeyError:
            if cls is HandState:  # before version 4 nothing but its edges acted on a robot
                content = {"degree": len(content["multipliers"])} | content
            fields = list(values(added | content))
        for index, row in rows:
            fields[index] = tuple(map(row, fields[index]))
        for index in plain:
            fields[index] = tuple(fields[index])
        return cls._make(fields)

    return read


def _row(columns: tuple[_Column, ...]) -> Callable[[dict[str, Any]], tuple[Any, ...]]:
    """A function from the JSON object of one row to the row."""
    values: Callable[[dict[str, Any]], tuple[Any, ...]] = itemgetter(*(column.name for column in columns))
    added = {column.name: column.added for column in columns if column.added is not None}
    texts = [(index, column.texts) for index, column in enumerate(columns) if column.texts]
    anything = [index for index, column in enumerate(columns) if column.value]
    if not added and not texts and not anything:
        return values

    def read(content: dict[str, Any]) -> tuple[Any, ...]:
        try:
            row = values(content)
        except KeyError:
            row = values(added | content)
        for index, known in texts:
            row = (*row[:index], known.index(row[index]), *row[index + 1 :])
        for index in anything:
            row = (*row[:index], _hashable(json.loads(row[index])), *row[index + 1 :])
        return row

    return read


def _hashable(value: Any) -> Any:
    """A value as messages have it: tuples for lists."""
    return tuple(map(_hashable, value)) if isinstance(value, list) else value
