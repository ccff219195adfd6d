"""Messages on the bus and their codec.

A message on the wire is one MessagePack array ``[version, type, *fields]`` with the fields in
the order of the class, and after it the CRC-32 (IEEE 802.3, as zlib computes it) of the array's
bytes as a MessagePack uint32: the byte 0xce and 4 bytes, the highest first. Up to three flipped bits are
always found in a message of at most 91,607 bits (P. Koopman, "32-bit cyclic redundancy codes for Internet
applications", DSN 2002), which `BYTES_MAX` stays below, and so is any one burst of up to 32 bits.

`decode` never trusts its input: anything that is not exactly one known, well-typed, finite message
of at most `BYTES_MAX` raises `Malformed`, whose `reason` is one of `REASONS`, so that a receiver can
drop it and count it by reason.

Units are SI, positions and velocities in W (world ENU), times integer nanoseconds of the wall
clock (Unix epoch).
"""

from __future__ import annotations

from math import isfinite
from struct import Struct
from typing import Any, Final, NamedTuple
from zlib import crc32

import msgpack

VERSION: Final = 5
BYTES_MAX: Final = 10_240
MISSION_BYTES_MAX: Final = 49_152
"""Of a `Mission`, which may write out a formation: some 900 robots. Beyond `BYTES_MAX` the checksum finds
any two flipped bits, not three."""
NEIGHBOURS_MAX: Final = 64
TEXT_MAX: Final = 200
"""Bytes of any text but `Faults.rules`."""
RULES_MAX: Final = 8192
"""Bytes of `Faults.rules`."""
AUTHOR_MAX: Final = 60
"""Characters of `Faults.author`."""
EVERY_AUTHOR: Final = "*"
"""As `Faults.author`, without rules: clears the rules of every author."""
SILENT_MAX: Final = 16
"""Robots of which one `Beacon` tells that they are silent."""
TRACE_MAX: Final = 128
"""Entries of one `LinkTrace`."""
FLOAT_MAX: Final = 1e15
"""No position, speed, force or multiplier of a robot is larger; below it the law's arithmetic is safe."""
TIME_NS_MAX: Final = 2**62
DEGREE_MAX: Final = 1000
"""Constraints that act on one robot."""
ROBOT_MAX: Final = 9999

TOPICS: Final = ("hand", "state", "wrench", "beacon")
"""What a link carries, by the number in a `LinkTrace`: agent to agent, plant to agent, agent to plant,
agent to every other agent."""
# What was done to a message, `LinkTrace`: the bits of `what`.
LOST: Final = 1
DUPLICATED: Final = 2
CORRUPTED: Final = 4
REORDERED: Final = 8
HELD: Final = 16
RANGE: Final = 32
OVERFLOW: Final = 64
WHAT_MAX: Final = 2**16 - 1
EVENTS: Final = ("kill", "start", "stop", "continue")
"""What is done to processes: SIGKILL, started again, SIGSTOP, SIGCONT."""

LEVELS: Final = ("ok", "warning", "blocking")
"""Of a line of `Checks`: fine; worth knowing; no drive begins over it."""
CHECKS_MAX: Final = 32
"""Lines of one `Checks`."""
CHECK_TEXT_MIN: Final = 100
"""Bytes of a text of `Checks` that there is room for, however many lines it has."""

REASONS: Final = ("oversized", "checksum", "malformed", "version", "type", "not_finite", "range")


class Malformed(ValueError):
    """A payload that is not a valid message; `reason` is one of `REASONS`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class HandState(NamedTuple):
    """One robot's hand point, from its agent to its neighbours.

    Position, velocity (m, m/s, W) are those at `time_ns`; forces are per unit mass (m/s^2, W).
    `following` is True when the robot obeys the law, or stands ready to from the epoch on; when it
    is False the robot brakes, comes to rest, and its forces say nothing about its motion.
    The correction is what the last stage and a way round what blocks it make of the two forces: it
    accelerates by the sum of all three.
    `degree` is how many constraints act on it: edges, and what it is kept away from.
    `multipliers` are the sender's copies of lambda, one ``(robot, lambda)`` for each of its edges and each
    robot that it is kept away from.
    `heard`, empty in most messages, echoes, as ``(neighbour, delay_us)``, the least apparent delay of
    each neighbour's hand states: the sender's clock when it took one minus the stamp on it. As the
    clocks differ it may be negative; from both directions both ends find the offset of their clocks.
    """

    robot: int
    sequence: int
    time_ns: int
    following: bool
    degree: int
    x: float
    y: float
    vx: float
    vy: float
    navigation_x: float
    navigation_y: float
    constraint_x: float
    constraint_y: float
    correction_x: float
    correction_y: float
    multipliers: tuple[tuple[int, float], ...]
    heard: tuple[tuple[int, int], ...]


NO_FORCES: Final = (0.0,) * 6
"""The forces and the correction of a `HandState` where there are none, or none are known."""


class PlantState(NamedTuple):
    """One body as its plant measures it, valid at `time_ns`.

    x, y (m, W), heading (rad, counter-clockwise from x), speed along the heading (m/s),
    yaw rate (rad/s). `force` (N) and `torque` (N m) are what acts on the body from now on, after
    limits. `driving` is False while the plant brakes of its own accord (no fresh wrench, or told
    so); `healthy` is False when the measurement must not be used; `obeying` is False when it may be, but the
    body does not do what it is asked: its operator has it. `note` says why.
    """

    robot: int
    sequence: int
    time_ns: int
    x: float
    y: float
    heading: float
    speed: float
    yaw_rate: float
    force: float
    torque: float
    driving: bool
    healthy: bool
    obeying: bool
    note: str


class Wrench(NamedTuple):
    """What the agent asks of its plant: force (N, along the heading), torque (N m), or to brake."""

    robot: int
    sequence: int
    time_ns: int
    force: float
    torque: float
    brake: bool


class Mission(NamedTuple):
    """When the fleet starts (`epoch_ns`) and for how long it drives (`duration_ns`).

    It is all that the fleet is to do, so the one with the greatest `version` holds wherever it is heard
    (`newer`). `digest` names the fleet file that the operator means: an agent that runs another one refuses.

    What is empty is as in the fleet file, but where `robots` are given `edges` are all there are. `robots`
    are the members, ``(id, x, y)`` with their offsets (m, W); `edges` ``(id, id, distance m)``;
    `trajectory` ``(field, value)`` of a `[trajectory]`, whose time 0 is `trajectory_ns`. All take it over
    at `from_ns`, and come from what they drove before to it within `blend_ns`; 0 for these times is the
    epoch. `note` says in words what has changed.
    """

    version: int
    time_ns: int
    epoch_ns: int
    duration_ns: int
    digest: str
    from_ns: int = 0
    blend_ns: int = 0
    note: str = ""
    trajectory_ns: int = 0
    trajectory: tuple[tuple[str, Any], ...] = ()
    robots: tuple[tuple[int, float, float], ...] = ()
    edges: tuple[tuple[int, int, float], ...] = ()


class Stop(NamedTuple):
    """Operator's stop: every robot brakes and stays stopped until a `Resume` of a greater version."""

    version: int
    time_ns: int
    reason: str


class Resume(NamedTuple):
    """Operator's leave to drive again: after a `Stop`, and for robots whose body an operator took away and
    gave back.

    `robots` are their ids, none of them means all. An agent or plant obeys a `version` only once, and
    only a greater one than before.
    """

    version: int
    time_ns: int
    robots: tuple[int, ...]


class Checks(NamedTuple):
    """What a plant has to say of its body before a drive, for operators.

    A line is ``(name, level, found, advice)``: what was looked at, one of `LEVELS`, what was found, and
    what to do about it ("" when there is nothing to do). At most `CHECKS_MAX` lines, which fit if no text
    is longer than `CHECK_TEXT_MIN`.
    """

    robot: int
    sequence: int
    time_ns: int
    lines: tuple[tuple[str, str, str, str], ...]


class Status(NamedTuple):
    """What one agent is doing. `counters` are totals since it started.

    `transition` names the row of `agent.supervision.TRANSITIONS` that led to `state`; `order_version` is that
    of the last stop or resume. `tick_us` holds the duration of every tick since the last status (empty in
    virtual time), `ages_us` the age of every neighbour's hand state at every tick since then.
    `neighbours` gives ``(id, age_us, received, lost, offset_us, error_us)`` for each neighbour: the
    age of its hand state now, -1 when never heard; how many of them came and how many did not; its
    clock minus the own, and half of that estimate's uncertainty, -1 while nothing is known.
    """

    robot: int
    sequence: int
    time_ns: int
    state: str
    transition: str
    reason: str
    mission_version: int
    order_version: int
    neighbours: tuple[tuple[int, int, int, int, int, int], ...]
    tick_us: tuple[int, ...]
    ages_us: tuple[int, ...]
    counters: tuple[tuple[str, int], ...]


class Faults(NamedTuple):
    """One author's whole set of live fault rules, to every agent and plant.

    `rules` is TOML text, ``[[faults.rule]]`` tables as in the fleet file; their times count from
    `origin_ns`. A greater `version` of the same author replaces the set. It ends at `time_ns` + `lease_ns`
    unless it comes again with a later `time_ns`; with a lease of 0 it stays until it is cleared.
    Author `EVERY_AUTHOR`, without rules, clears the sets of all.
    """

    version: int
    time_ns: int
    author: str
    origin_ns: int
    lease_ns: int
    rules: str


class LinkTrace(NamedTuple):
    """What a receiver did to messages under its fault rules, one entry for every decision.

    An entry is ``(source, topic, sequence, time_ns, what, delay_us)``: robot that sent the message, index
    into `TOPICS`, its sequence number and stamp; `what` the sum of `LOST`, `DUPLICATED` (this is the second
    copy), `CORRUPTED`, `REORDERED`, `HELD`, `RANGE` (lost to the range channel), `OVERFLOW` (lost to a full
    queue); the injected delay after the stamp, -1 where it was lost. A message that passed untouched
    under a rule has an entry as well; one on a link without a rule has none.
    """

    robot: int
    sequence: int
    time_ns: int
    entries: tuple[tuple[int, int, int, int, int, int], ...]


class Event(NamedTuple):
    """What was done to a process on purpose: `what` is one of `EVENTS`, `rule` the name of the rule."""

    robot: int
    sequence: int
    time_ns: int
    role: str
    what: str
    rule: str


class Beacon(NamedTuple):
    """Where one robot is, a few times a second, from its agent to all others.

    Hand point and its velocity (m, m/s, W) at `time_ns`, `following` as in `HandState`. Then what it knows:
    the mission (its version and `tag`), the last stop and the last resume (-1: none). Who knows later ones
    says them again. `silent` are robots that it has not heard for a while, as they were when it did:
    ``(robot, time_ns, following, x, y, vx, vy)``. One that has just started cannot know of them else.
    """

    robot: int
    sequence: int
    time_ns: int
    following: bool
    x: float
    y: float
    vx: float
    vy: float
    mission_version: int
    mission_tag: int
    stop_version: int
    resume_version: int
    silent: tuple[tuple[int, int, bool, float, float, float, float], ...] = ()


class Heartbeat(NamedTuple):
    """An operator is there: where the fleet has a dead-man's switch, robots drive only while these come."""

    time_ns: int
    author: str


class Ask(NamedTuple):
    """An operator asks for the mission and the last stop or resume: agents say them again."""

    time_ns: int
    author: str


Message = (
    HandState
    | PlantState
    | Wrench
    | Mission
    | Stop
    | Status
    | Faults
    | LinkTrace
    | Event
    | Resume
    | Checks
    | Beacon
    | Heartbeat
    | Ask
)

_CLASSES: Final[tuple[type[Message], ...]] = (
    HandState, PlantState, Wrench, Mission, Stop, Status, Faults, LinkTrace, Event, Resume, Checks,
    Beacon, Heartbeat, Ask,
)  # fmt: skip
_TYPE_OF: Final = {cls: number for number, cls in enumerate(_CLASSES)}

# Exact types of the fields on the wire; a tuple stands for a variable part, checked on its own.
_FIELD_TYPES: Final[tuple[tuple[type, ...], ...]] = (
    (int, int, int, bool, int, *(float,) * 10, tuple, tuple),
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
    (int, int, int, bool, float, float, float, float, int, int, int, int, tuple),
    (int, str),
    (int, str),
)
_HEAD: Final = 2  # version and type come before the fields
_FLOATS: Final = tuple(
    slice(types.index(float), len(types) - types[::-1].index(float)) if float in types else slice(0)
    for types in _FIELD_TYPES
)
# The messages of every tick, by the types on the wire: number of the class, its floats, the class.
_FREQUENT: Final = {
    (int, int, *_FIELD_TYPES[number]): (
        number,
        slice(_FLOATS[number].start + _HEAD, _FLOATS[number].stop + _HEAD),
        _CLASSES[number],
    )
    for number in map(_CLASSES.index, (HandState, PlantState, Wrench, Beacon))
}
_HAND_STATE: Final = _TYPE_OF[HandState]
_BEACON: Final = _TYPE_OF[Beacon]
_STATUS_VALUES_MAX: Final = 2048
# A valid message of these kinds begins with these three bytes; only such a one may be long, in all or a text.
_FAULTS_HEAD: Final = bytes([0x90 | _HEAD + len(Faults._fields), VERSION, _TYPE_OF[Faults]])
_MISSION_HEAD: Final = bytes([0x90 | _HEAD + len(Mission._fields), VERSION, _TYPE_OF[Mission]])

_pack = msgpack.Packer(use_bin_type=True, autoreset=True).pack
_checksum = Struct(">BI").pack
_UINT32: Final = 0xCE
_CHECKSUM_BYTES: Final = 5


def newer(mission: Mission, known: Mission | None) -> bool:
    """Whether `mission` holds instead of `known`: by its version, and of equal ones by its content, so that
    of two operators' missions the same one wins everywhere."""
    if known is None:
        return True
    if mission.version != known.version:
        return mission.version > known.version
    return (tag(mission), _content(mission)) > (tag(known), _content(known))


def tag(mission: Mission) -> int:
    """A number that tells missions of one version apart, by which `newer` puts them in order."""
    return crc32(_content(mission))


def _content(mission: Mission) -> bytes:
    return encode(mission._replace(time_ns=0))


def encode(message: Message) -> bytes:
    """The message's bytes. Does not check: what is sent was made here (see `Agent.tick`)."""
    packed: bytes = _pack((VERSION, _TYPE_OF[type(message)], *message))
    return packed + _checksum(_UINT32, crc32(packed))


def decode(payload: bytes) -> Message:
    """The message in `payload`.

    Raises:
        Malformed: for anything but one valid message.
    """
    if len(payload) > BYTES_MAX:
        most = MISSION_BYTES_MAX if payload[:3] == _MISSION_HEAD else BYTES_MAX
        if len(payload) > most:
            raise Malformed("oversized", f"{len(payload)} bytes, at most {most} are accepted")
    packed = payload[:-_CHECKSUM_BYTES]
    if payload[-_CHECKSUM_BYTES:] != _checksum(_UINT32, crc32(packed)):
        raise _unchecked(payload)
    try:
        array = _unpacked(packed)
    except Exception as error:  # msgpack raises a dozen unrelated types; each means the same here
        raise Malformed("malformed", f"not one MessagePack array ({type(error).__name__})") from None
    # A valid message of the frequent kinds is through here; `_examine` takes all others and says why.
    if type(array) is tuple:
        frequent = _FREQUENT.get(tuple(map(type, array)))
        if frequent is not None:
            number, floats, cls = frequent
            if (
                array[0] == VERSION
                and array[1] == number
                and 0 < array[2] <= ROBOT_MAX
                and 0 <= array[3] < TIME_NS_MAX
                and 0 <= array[4] < TIME_NS_MAX
                and sum(map(abs, array[floats])) <= FLOAT_MAX  # false for NaN and infinities, too
                and (number != _HAND_STATE or (0 <= array[6] <= DEGREE_MAX and _plain(array[-2], array[-1])))
                and (number != _BEACON or (not array[-1] and _known(array[-5:-1])))
            ):
                message: Message = tuple.__new__(cls, array[_HEAD:])
                return message
    return _examine(array)


def _unpacked(packed: bytes) -> Any:
    text_max = RULES_MAX if packed[: len(_FAULTS_HEAD)] == _FAULTS_HEAD else TEXT_MAX
    return msgpack.unpackb(packed, use_list=False, max_array_len=_STATUS_VALUES_MAX, max_str_len=text_max)


def _unchecked(payload: bytes) -> Malformed:
    """Why a payload without its checksum is refused: version 1 had none."""
    try:
        array = _unpacked(payload)
    except Exception:  # whatever it is, it is no array of version 1
        array = None
    if type(array) is tuple and array and type(array[0]) is int and array[0] != VERSION:
        return _other_version(array[0])
    return Malformed("checksum", "the bytes are not those that were sent, or not of this protocol")


def _other_version(version: Any) -> Malformed:
    return Malformed("version", f"version {_shown(version)}, this program speaks {VERSION}")


def _plain(multipliers: tuple[Any, ...], heard: tuple[Any, ...]) -> bool:
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


def _examine(array: Any) -> Message:
    """The message in what was unpacked, or `Malformed` with the first thing that is wrong with it."""
    if type(array) is not tuple or len(array) < 3:
        raise Malformed("malformed", "not a MessagePack array [version, type, *fields]")
    version, number, fields = array[0], array[1], array[_HEAD:]
    if type(version) is not int or version != VERSION:
        raise _other_version(version)
    if type(number) is not int or not 0 <= number < len(_CLASSES):
        raise Malformed("type", f"message type {_shown(number)} is not known")
    cls = _CLASSES[number]
    fields = _coerced(fields, _FIELD_TYPES[number], cls.__name__, cls._fields)
    _check_floats(fields[_FLOATS[number]], cls.__name__)
    return _CHECKS[number](fields)


def _check_floats(values: tuple[float, ...], what: str) -> None:
    if not all(map(isfinite, values)):
        raise Malformed("not_finite", f"{what} holds a NaN or an infinity")
    if any(abs(value) > FLOAT_MAX for value in values):
        raise Malformed("range", f"{what} holds a number beyond +-{FLOAT_MAX:g}")


def clipped(text: str, most: int = TEXT_MAX) -> str:
    """`text` cut to what a message may hold, `most` bytes."""
    data = text.encode()
    return text if len(data) <= most else data[: most - 3].decode(errors="ignore") + "..."


def _shown(value: Any) -> str:
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
            raise Malformed("malformed", f"{what}.{name} is {_shown(value)}, not a {wanted.__name__}")
    return tuple(out)


def _check_times(robot: int, sequence: int, time_ns: int) -> None:
    if not 0 < robot <= ROBOT_MAX:
        raise Malformed("range", f"robot {robot} is not within 1..{ROBOT_MAX}")
    if not 0 <= sequence < TIME_NS_MAX:
        raise Malformed("range", f"sequence number {sequence} is negative or absurd")
    if not 0 <= time_ns < TIME_NS_MAX:
        raise Malformed("range", f"time {time_ns} ns is negative or absurd")


def _hand_state(fields: tuple[Any, ...]) -> HandState:
    _check_times(fields[0], fields[1], fields[2])
    if not 0 <= fields[4] <= DEGREE_MAX:
        raise Malformed("range", f"degree {fields[4]} is not within 0..{DEGREE_MAX}")
    multipliers, heard = fields[-2:]
    for entries, what in ((multipliers, "multipliers"), (heard, "neighbours heard")):
        if len(entries) > NEIGHBOURS_MAX:
            raise Malformed("range", f"{len(entries)} {what}, at most {NEIGHBOURS_MAX} are accepted")
    checked = []
    for entry in multipliers:
        if type(entry) is not tuple or len(entry) != 2 or type(entry[0]) is not int:
            raise Malformed("malformed", f"multiplier {_shown(entry)} is not [neighbour, lambda]")
        values = _coerced(entry[1:], (float,), "HandState", ("multipliers",))
        _check_floats(values, "a multiplier")
        checked.append((entry[0], *values))
    for entry in heard:
        if type(entry) is not tuple or tuple(map(type, entry)) != (int, int):
            raise Malformed("malformed", f"HandState.heard holds {_shown(entry)}, not [neighbour, delay_us]")
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
            raise Malformed("malformed", f"Mission.trajectory holds {_shown(entry)}, not [field, value]")
        _check_setting(entry[1])
    robots = tuple(_row(row, (int, float, float), "Mission.robots") for row in mission.robots)
    edges = tuple(_row(row, (int, int, float), "Mission.edges") for row in mission.edges)
    for robot in (*(row[0] for row in robots), *(end for row in edges for end in row[:2])):
        _check_times(robot, 0, 0)
    return mission._replace(robots=robots, edges=edges)


def _row(row: Any, types: tuple[type, ...], what: str) -> tuple[Any, ...]:
    if type(row) is not tuple:
        raise Malformed("malformed", f"{what} holds {_shown(row)}, not an array")
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
        raise Malformed("malformed", f"Mission.trajectory holds {_shown(value)}")


def _stop(fields: tuple[Any, ...]) -> Stop:
    stop = Stop._make(fields)
    _check_times(1, stop.version, stop.time_ns)
    return stop


def _status(fields: tuple[Any, ...]) -> Status:
    _check_times(fields[0], fields[1], fields[2])
    for index, types in ((8, (int,) * 6), (11, (str, int))):
        for entry in fields[index]:
            if type(entry) is not tuple or tuple(map(type, entry)) != types:
                raise Malformed("malformed", f"Status.{Status._fields[index]} holds {_shown(entry)}")
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
            f"the author of faults {_shown(faults.author)} is not 1 to {AUTHOR_MAX} printable characters",
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
            raise Malformed("malformed", f"LinkTrace.entries holds {_shown(entry)}")
        source, topic, sequence, time_ns, what, delay_us = entry
        _check_times(source, sequence, time_ns)
        if not 0 <= topic < len(TOPICS) or not 0 <= what <= WHAT_MAX or not -1 <= delay_us < TIME_NS_MAX:
            raise Malformed("range", f"topic {topic}, what {what} or delay {delay_us} us is not possible")
    return trace


def _event(fields: tuple[Any, ...]) -> Event:
    event = Event._make(fields)
    _check_times(event.robot, event.sequence, event.time_ns)
    if event.role not in ("agent", "plant") or event.what not in EVENTS:
        raise Malformed("range", f"event {_shown(event.what)} of {_shown(event.role)} is not known")
    return event


def _resume(fields: tuple[Any, ...]) -> Resume:
    resume = Resume._make(fields)
    _check_times(1, resume.version, resume.time_ns)
    for robot in resume.robots:
        if type(robot) is not int:
            raise Malformed("malformed", f"Resume.robots holds {_shown(robot)}, not a robot's id")
        _check_times(robot, 0, 0)
    return resume


def _checks(fields: tuple[Any, ...]) -> Checks:
    checks = Checks._make(fields)
    _check_times(checks.robot, checks.sequence, checks.time_ns)
    if len(checks.lines) > CHECKS_MAX:
        raise Malformed("range", f"{len(checks.lines)} lines, at most {CHECKS_MAX} are accepted")
    for line in checks.lines:
        if type(line) is not tuple or tuple(map(type, line)) != (str,) * 4:
            raise Malformed("malformed", f"Checks.lines holds {_shown(line)}, not 4 texts")
        if line[1] not in LEVELS:
            raise Malformed("range", f"level {_shown(line[1])} is not one of {', '.join(LEVELS)}")
    return checks


def _beacon(fields: tuple[Any, ...]) -> Beacon:
    beacon = Beacon._make(fields)
    _check_times(beacon.robot, beacon.sequence, beacon.time_ns)
    if not _known(beacon[-5:-1]):
        raise Malformed("range", "a version of a beacon is negative or absurd")
    if len(beacon.silent) > SILENT_MAX:
        raise Malformed("range", f"{len(beacon.silent)} silent robots, at most {SILENT_MAX} are accepted")
    rows = tuple(_row(row, (int, int, bool, *(float,) * 4), "Beacon.silent") for row in beacon.silent)
    for row in rows:
        _check_times(row[0], 0, row[1])
    return beacon._replace(silent=rows)


def _known(versions: tuple[int, ...]) -> bool:
    """Whether the versions of a beacon may be some."""
    return min(versions) >= -1 and max(versions) < TIME_NS_MAX


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
