"""What is a valid message: the types of its fields, and what they may hold.

Whatever comes over the network is looked at here, field by field, before anybody uses it.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

from agent.messages.types import (
    AUTHOR_MAX,
    CHECKS_MAX,
    DEGREE_MAX,
    EVENTS,
    EVERY_AUTHOR,
    FLOAT_MAX,
    LEVELS,
    NEIGHBOURS_MAX,
    ROBOT_MAX,
    SILENT_MAX,
    TIME_NS_MAX,
    TOPICS,
    TRACE_MAX,
    WHAT_MAX,
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

REASONS: Final = ("oversized", "checksum", "malformed", "version", "type", "not_finite", "range")
"""Why payloads are refused; receivers count them by these names."""


class Malformed(ValueError):
    """A payload that is not a valid message; `reason` is one of `REASONS`, `detail` is for people."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason, self.detail = reason, detail


CLASSES: Final[tuple[type[Message], ...]] = (
    HandState, PlantState, Wrench, Mission, Stop, Status, Faults, LinkTrace, Event, Resume, Checks,
    Beacon, Heartbeat, Ask,
)  # fmt: skip
TYPE_OF: Final = {cls: number for number, cls in enumerate(CLASSES)}

# Exact types of the fields on the wire; a tuple stands for a variable part, checked on its own.
FIELD_TYPES: Final[tuple[tuple[type, ...], ...]] = (
    (int, int, int, bool, int, *(float,) * 11, tuple, tuple),
    (int, int, int, *(float,) * 7, bool, bool, bool, str),
    (int, int, int, float, float, bool),
    (int, int, int, int, str, int, int, str, int, tuple, tuple, tuple),
    (int, int, str),
    (int, int, int, str, str, str, int, int, tuple, tuple, tuple, tuple),
    (int, int, str, int, int, str),
    (int, int, int, tuple),
    (int, int, int, str, str, str),
    (int, int, tuple),
    (int, int, int, tuple),
    (int, int, int, bool, *(float,) * 5, int, int, int, int, tuple),
    (int, str),
    (int, str),
)
FLOATS: Final = tuple(
    slice(types.index(float), len(types) - types[::-1].index(float)) if float in types else slice(0)
    for types in FIELD_TYPES
)


def checked(number: int, fields: tuple[Any, ...]) -> Message:
    """The message of class `number` with these fields.

    Raises:
        Malformed: with the first thing that is wrong with them.
    """
    cls = CLASSES[number]
    fields = _coerced(fields, FIELD_TYPES[number], cls.__name__, cls._fields)
    _check_floats(fields[FLOATS[number]], cls.__name__)
    return _CHECKS[number](fields)


def are_pairs(multipliers: tuple[Any, ...], heard: tuple[Any, ...]) -> bool:
    """True when all are (neighbour, lambda), respectively (neighbour, delay_us), as they should be."""
    for entry in multipliers:
        if type(entry) is not tuple or len(entry) != 2:
            return False
        neighbour, value = entry
        if type(neighbour) is not int or type(value) is not float or not -FLOAT_MAX <= value <= FLOAT_MAX:
            return False
    for entry in heard:
        if type(entry) is not tuple or len(entry) != 2:
            return False
        neighbour, delay_us = entry
        if type(neighbour) is not int or type(delay_us) is not int:
            return False
        if not -TIME_NS_MAX < delay_us < TIME_NS_MAX:
            return False
    return len(multipliers) <= NEIGHBOURS_MAX and len(heard) <= NEIGHBOURS_MAX


def are_versions(versions: tuple[int, ...]) -> bool:
    """True when all versions of a beacon are -1 (none) or above, and below `TIME_NS_MAX`."""
    return min(versions) >= -1 and max(versions) < TIME_NS_MAX


def _check_floats(values: tuple[float, ...], what: str) -> None:
    if not all(map(isfinite, values)):
        raise Malformed("not_finite", f"{what} holds a NaN or an infinity")
    if any(abs(value) > FLOAT_MAX for value in values):
        raise Malformed("range", f"{what} holds a number beyond +-{FLOAT_MAX:g}")


def shown(value: Any) -> str:
    """A received value for a message to people: at most 40 characters."""
    if isinstance(value, tuple):  # its repr could be as deep as the sender liked
        return "an array"
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _coerced(
    fields: tuple[Any, ...], expected: tuple[type, ...], what: str, names: tuple[str, ...]
) -> tuple[Any, ...]:
    """Fields of the right types, or `Malformed`.

    Other languages' encoders write 1.0 as the integer 1: such a number is taken as a float.
    """
    if len(fields) != len(expected):
        raise Malformed("malformed", f"{what} has {len(expected)} fields, got {len(fields)}")
    out = []
    for value, wanted, name in zip(fields, expected, names, strict=True):
        if type(value) is wanted:
            out.append(value)
        elif wanted is float and type(value) is int and -(2**53) <= value <= 2**53:
            out.append(float(value))
        else:
            raise Malformed("malformed", f"{what}.{name} is {shown(value)}, not a {wanted.__name__}")
    return tuple(out)


def _check_times(robot: int, sequence: int, time_ns: int) -> None:
    if not 0 < robot <= ROBOT_MAX:
        raise Malformed("range", f"robot {robot} is not within 1..{ROBOT_MAX}")
    if not 0 <= sequence < TIME_NS_MAX:
        raise Malformed("range", f"sequence number {sequence} is negative or absurd")
    if not 0 <= time_ns < TIME_NS_MAX:
        raise Malformed("range", f"time {time_ns} ns is negative or absurd")


def _check_doubt(doubt: float) -> None:
    if doubt < 0.0:
        raise Malformed("range", f"a doubt of {doubt} m is negative")


def _hand_state(fields: tuple[Any, ...]) -> HandState:
    _check_times(fields[0], fields[1], fields[2])
    if not 0 <= fields[4] <= DEGREE_MAX:
        raise Malformed("range", f"degree {fields[4]} is not within 0..{DEGREE_MAX}")
    _check_doubt(fields[-3])
    multipliers, heard = fields[-2:]
    for entries, what in ((multipliers, "multipliers"), (heard, "neighbours heard")):
        if len(entries) > NEIGHBOURS_MAX:
            raise Malformed("range", f"{len(entries)} {what}, at most {NEIGHBOURS_MAX} are accepted")
    checked = []
    for entry in multipliers:
        if type(entry) is not tuple or len(entry) != 2 or type(entry[0]) is not int:
            raise Malformed("malformed", f"multiplier {shown(entry)} is not [neighbour, lambda]")
        values = _coerced(entry[1:], (float,), "HandState", ("multipliers",))
        _check_floats(values, "a multiplier")
        checked.append((entry[0], *values))
    for entry in heard:
        if type(entry) is not tuple or tuple(map(type, entry)) != (int, int):
            raise Malformed("malformed", f"HandState.heard holds {shown(entry)}, not [neighbour, delay_us]")
        if not -TIME_NS_MAX < entry[1] < TIME_NS_MAX:
            raise Malformed("range", f"a delay of {entry[1]} us is absurd")
    return HandState._make((*fields[:-2], tuple(checked), heard))


def _plant_state(fields: tuple[Any, ...]) -> PlantState:
    _check_times(fields[0], fields[1], fields[2])
    return PlantState._make(fields)


def _wrench(fields: tuple[Any, ...]) -> Wrench:
    _check_times(fields[0], fields[1], fields[2])
    return Wrench._make(fields)


def _mission(fields: tuple[Any, ...]) -> Mission:
    mission = Mission._make(fields)
    _check_times(1, mission.version, mission.time_ns)
    if not 0 <= mission.epoch_ns < TIME_NS_MAX or not 0 < mission.duration_ns < TIME_NS_MAX:
        raise Malformed("range", "a mission's epoch or duration is negative or absurd")
    for time_ns in (mission.from_ns, mission.blend_ns, mission.trajectory_ns):
        if not 0 <= time_ns < TIME_NS_MAX:
            raise Malformed("range", f"a mission's time {time_ns} ns is negative or absurd")
    for entry in fields[9]:
        if type(entry) is not tuple or len(entry) != 2 or type(entry[0]) is not str:
            raise Malformed("malformed", f"Mission.trajectory holds {shown(entry)}, not [field, value]")
        _check_setting(entry[1])
    robots = tuple(_row(row, (int, float, float), "Mission.robots") for row in mission.robots)
    edges = tuple(_row(row, (int, int, float), "Mission.edges") for row in mission.edges)
    for robot in (*(row[0] for row in robots), *(end for row in edges for end in row[:2])):
        _check_times(robot, 0, 0)
    return mission._replace(robots=robots, edges=edges)


def _row(row: Any, types: tuple[type, ...], what: str) -> tuple[Any, ...]:
    if type(row) is not tuple:
        raise Malformed("malformed", f"{what} holds {shown(row)}, not an array")
    values = _coerced(row, types, what, tuple(map(str, range(1, len(types) + 1))))
    _check_floats(tuple(value for value in values if type(value) is float), what)
    return values


def _check_setting(value: Any, depth: int = 0) -> None:
    """A value as a fleet file could hold it: number, text, truth value, or rows of numbers."""
    if type(value) is tuple and depth < 2:
        for item in value:
            _check_setting(item, depth + 1)
    elif type(value) is float:
        _check_floats((value,), "Mission.trajectory")
    elif type(value) not in (int, str, bool):
        raise Malformed("malformed", f"Mission.trajectory holds {shown(value)}")


def _stop(fields: tuple[Any, ...]) -> Stop:
    stop = Stop._make(fields)
    _check_times(1, stop.version, stop.time_ns)
    return stop


def _status(fields: tuple[Any, ...]) -> Status:
    _check_times(fields[0], fields[1], fields[2])
    for index, types in ((8, (int,) * 6), (11, (str, int))):
        for entry in fields[index]:
            if type(entry) is not tuple or tuple(map(type, entry)) != types:
                raise Malformed("malformed", f"Status.{Status._fields[index]} holds {shown(entry)}")
    for index in (9, 10):
        if not all(type(value) is int for value in fields[index]):
            raise Malformed(
                "malformed", f"Status.{Status._fields[index]} holds a value that is not an integer"
            )
    return Status._make(fields)


def _faults(fields: tuple[Any, ...]) -> Faults:
    faults = Faults._make(fields)
    _check_times(1, faults.version, faults.time_ns)
    if not 0 <= faults.origin_ns < TIME_NS_MAX or not 0 <= faults.lease_ns < TIME_NS_MAX:
        raise Malformed("range", "the origin or the lease of faults is negative or absurd")
    if not 0 < len(faults.author) <= AUTHOR_MAX or not faults.author.isprintable():
        raise Malformed(
            "range",
            f"the author of faults {shown(faults.author)} is not 1 to {AUTHOR_MAX} printable characters",
        )
    if faults.author == EVERY_AUTHOR and faults.rules:
        raise Malformed("range", f"author {EVERY_AUTHOR!r} clears the faults of all and has no rules")
    return faults


def _link_trace(fields: tuple[Any, ...]) -> LinkTrace:
    trace = LinkTrace._make(fields)
    _check_times(trace.robot, trace.sequence, trace.time_ns)
    if len(trace.entries) > TRACE_MAX:
        raise Malformed("range", f"{len(trace.entries)} entries, at most {TRACE_MAX} are accepted")
    for entry in trace.entries:
        if type(entry) is not tuple or tuple(map(type, entry)) != (int,) * 6:
            raise Malformed("malformed", f"LinkTrace.entries holds {shown(entry)}")
        source, topic, sequence, time_ns, what, delay_us = entry
        _check_times(source, sequence, time_ns)
        if not 0 <= topic < len(TOPICS) or not 0 <= what <= WHAT_MAX or not -1 <= delay_us < TIME_NS_MAX:
            raise Malformed("range", f"topic {topic}, what {what} or delay {delay_us} us is not possible")
    return trace


def _event(fields: tuple[Any, ...]) -> Event:
    event = Event._make(fields)
    _check_times(event.robot, event.sequence, event.time_ns)
    if event.role not in ("agent", "plant") or event.what not in EVENTS:
        raise Malformed("range", f"event {shown(event.what)} of {shown(event.role)} is not known")
    return event


def _resume(fields: tuple[Any, ...]) -> Resume:
    resume = Resume._make(fields)
    _check_times(1, resume.version, resume.time_ns)
    for robot in resume.robots:
        if type(robot) is not int:
            raise Malformed("malformed", f"Resume.robots holds {shown(robot)}, not a robot's id")
        _check_times(robot, 0, 0)
    return resume


def _checks(fields: tuple[Any, ...]) -> Checks:
    checks = Checks._make(fields)
    _check_times(checks.robot, checks.sequence, checks.time_ns)
    if len(checks.lines) > CHECKS_MAX:
        raise Malformed("range", f"{len(checks.lines)} lines, at most {CHECKS_MAX} are accepted")
    for line in checks.lines:
        if type(line) is not tuple or tuple(map(type, line)) != (str,) * 4:
            raise Malformed("malformed", f"Checks.lines holds {shown(line)}, not 4 texts")
        if line[1] not in LEVELS:
            raise Malformed("range", f"level {shown(line[1])} is not one of {', '.join(LEVELS)}")
    return checks


def _beacon(fields: tuple[Any, ...]) -> Beacon:
    beacon = Beacon._make(fields)
    _check_times(beacon.robot, beacon.sequence, beacon.time_ns)
    _check_doubt(beacon.doubt)
    if not are_versions(beacon[-5:-1]):
        raise Malformed("range", "a version of a beacon is negative or absurd")
    if len(beacon.silent) > SILENT_MAX:
        raise Malformed("range", f"{len(beacon.silent)} silent robots, at most {SILENT_MAX} are accepted")
    rows = tuple(_row(row, (int, int, bool, *(float,) * 4), "Beacon.silent") for row in beacon.silent)
    for row in rows:
        _check_times(row[0], 0, row[1])
    return beacon._replace(silent=rows)


def _heartbeat(fields: tuple[Any, ...]) -> Heartbeat:
    _check_times(1, 0, fields[0])
    return Heartbeat._make(fields)


def _ask(fields: tuple[Any, ...]) -> Ask:
    _check_times(1, 0, fields[0])
    return Ask._make(fields)


_CHECKS: Final = (
    _hand_state, _plant_state, _wrench, _mission, _stop, _status, _faults, _link_trace, _event, _resume,
    _checks, _beacon, _heartbeat, _ask,
)  # fmt: skip
