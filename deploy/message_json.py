"""Messages of the bus as JSON, the form in which a recording keeps them, and their JSON schemas.

JSON because Foxglove and every other MCAP tool reads it without our code. Python writes the
shortest decimal that reads back to the same double, so nothing is lost. Pairs become objects
(``{"neighbour": 2, "value": 0.5}``): Foxglove has no arrays within arrays.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from json.encoder import encode_basestring_ascii as _quoted
from operator import itemgetter
from typing import Any, Final, get_type_hints

from agent.messages import HandState, Message, Mission, PlantState, Status, Stop, Wrench

CLASSES: Final[tuple[type[Message], ...]] = (HandState, PlantState, Wrench, Mission, Stop, Status)

_ROBOT: Final = "Number of the robot"
_SEQUENCE: Final = "Sequence number, counted by the sender for this topic"
_TIME: Final = "Wall clock at which the content holds, ns since the Unix epoch"

DESCRIPTIONS: Final[dict[type[Message], dict[str, str]]] = {
    HandState: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
        "time_ns": _TIME,
        "following": "False while the robot brakes instead of following the law",
        "x": "Hand point, east, m (world ENU)",
        "y": "Hand point, north, m (world ENU)",
        "vx": "Velocity of the hand point, east, m/s",
        "vy": "Velocity of the hand point, north, m/s",
        "navigation_x": "Navigation force per unit mass, east, m/s2",
        "navigation_y": "Navigation force per unit mass, north, m/s2",
        "constraint_x": "Constraint force per unit mass, east, m/s2",
        "constraint_y": "Constraint force per unit mass, north, m/s2",
        "multipliers": "The sender's copy of the multiplier of each of its edges",
    },
    PlantState: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
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
        "note": "Why it is not healthy",
    },
    Wrench: {
        "robot": _ROBOT,
        "sequence": _SEQUENCE,
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
        "reason": "Why it is in that state",
        "mission_version": "Version of the mission that the agent follows",
        "neighbours": "Age of each neighbour's hand state now, us; -1: never heard",
        "tick_us": "Duration of every tick since the last status, us; empty in virtual time",
        "ages_us": "Age of every neighbour's hand state at every tick since the last status, us",
        "counters": "Totals since the agent started",
    },
}

# Names and types of the two columns of a field that holds pairs.
_PAIRS: Final[dict[str, tuple[tuple[str, str], tuple[str, str]]]] = {
    "multipliers": (("neighbour", "integer"), ("value", "number")),
    "neighbours": (("robot", "integer"), ("age_us", "integer")),
    "counters": (("name", "string"), ("value", "integer")),
}
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
        if name in _PAIRS:
            columns = {column: {"type": kind} for column, kind in _PAIRS[name]}
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


# The three classes that come at the loop's rate are written by a template, three times faster than
# a dictionary through json.dumps; repr() of a finite float is its JSON form.
def _template(cls: type[Message]) -> str:
    form = {int: "%d", float: "%r", bool: "%s", str: "%s"}
    hints = get_type_hints(cls)
    parts = [f'"{name}":' + form.get(hints[name], "[%s]") for name in cls._fields]
    return "{" + ",".join(parts) + "}"


_HAND: Final = _template(HandState)
_PLANT: Final = _template(PlantState)
_WRENCH: Final = _template(Wrench)
_TRUTH: Final = {False: "false", True: "true"}


def _hand(m: HandState) -> str:
    robot, sequence, time_ns, following, x, y, vx, vy, nx, ny, cx, cy, multipliers = m
    entries = ",".join(['{"neighbour":%d,"value":%r}' % pair for pair in multipliers])  # noqa: UP031 - the fastest form
    return _HAND % (robot, sequence, time_ns, _TRUTH[following], x, y, vx, vy, nx, ny, cx, cy, entries)


def _plant(m: PlantState) -> str:
    robot, sequence, time_ns, x, y, heading, speed, yaw_rate, force, torque, driving, healthy, note = m
    flags = _TRUTH[driving], _TRUTH[healthy], _quoted(note)
    return _PLANT % (robot, sequence, time_ns, x, y, heading, speed, yaw_rate, force, torque, *flags)


def _wrench(m: Wrench) -> str:
    robot, sequence, time_ns, force, torque, brake = m
    return _WRENCH % (robot, sequence, time_ns, force, torque, _TRUTH[brake])


def _other(m: Message) -> str:
    content: dict[str, Any] = dict(zip(m._fields, m, strict=True))
    for name, ((first, _), (second, _)) in _PAIRS.items():
        if name in content:
            content[name] = [{first: a, second: b} for a, b in content[name]]
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


_WRITERS: Final[dict[type[Message], Callable[[Any], str]]] = {
    HandState: _hand, PlantState: _plant, Wrench: _wrench,
    Mission: _other, Stop: _other, Status: _other,
}  # fmt: skip


def to_json(message: Message) -> bytes:
    """The message as one line of JSON, its fields in the order of the class. Its floats must be finite."""
    return _WRITERS[type(message)](message).encode()


def reader(cls: type[Message]) -> Callable[[dict[str, Any]], Message]:
    """A function from a parsed JSON object to the message.

    The function raises KeyError, TypeError or ValueError for an object that is not such a message.
    """
    values = itemgetter(*cls._fields)
    pairs = [(cls._fields.index(name), columns) for name, columns in _PAIRS.items() if name in cls._fields]
    rows = [cls._fields.index(name) for name in ("tick_us", "ages_us") if name in cls._fields]
    if not pairs and not rows:
        return lambda content: cls._make(values(content))
    getters = [(index, itemgetter(first, second)) for index, ((first, _), (second, _)) in pairs]

    def read(content: dict[str, Any]) -> Message:
        fields = list(values(content))
        for index, both in getters:
            fields[index] = tuple(map(both, fields[index]))
        for index in rows:
            fields[index] = tuple(fields[index])
        return cls._make(fields)

    return read
