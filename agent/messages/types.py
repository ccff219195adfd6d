"""Messages on the bus: their fields and limits. `agent.messages.codec` makes bytes of them.

Units are SI, positions and velocities in W (world ENU), times integer nanoseconds of the wall
clock (Unix epoch).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

BYTES_MAX: Final = 10_240
"""Of any message but a `Mission`."""
MISSION_BYTES_MAX: Final = 49_152
"""Of a `Mission`, which may write out a formation: some 900 robots. Beyond `BYTES_MAX` the checksum finds
any two flipped bits, not three."""
NEIGHBOURS_MAX: Final = 64
"""Edges of one robot at most; as many multipliers, or neighbours heard, has one `HandState` at most."""
TEXT_MAX: Final = 200
"""Bytes of any text but `Faults.rules`."""
RULES_MAX: Final = 8192
"""Bytes of `Faults.rules`."""
AUTHOR_MAX: Final = 60
"""Characters of `Faults.author`."""
EVERY_AUTHOR: Final = "*"
"""As `Faults.author`, without rules: clears the rules of every author."""
SILENT_MAX: Final = 16
"""Silent robots in one `Beacon`."""
TRACE_MAX: Final = 128
"""Entries of one `LinkTrace`."""
FLOAT_MAX: Final = 1e15
"""No position, speed, force or multiplier of a robot is larger; below it the law's arithmetic is safe."""
TIME_NS_MAX: Final = 2**62
"""All times (ns), versions and sequence numbers are below it."""
FUTURE_NS_MAX: Final = 250_000_000
"""A message may be stamped this far ahead of the local clock; the clocks of a fleet agree better."""
HEARD_ROUNDS: Final = 7
"""Each robot's hand states echo once in so many what it heard of the others: clocks part slowly."""
DEGREE_MAX: Final = 1000
"""Constraints that act on one robot."""
ROBOT_MAX: Final = 9999
"""Largest id of a robot; the smallest is 1."""

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

Outgoing = tuple[str, bytes]
"""A message to publish: its key and its bytes."""


class HandState(NamedTuple):
    """One robot's hand point, from its agent to its neighbours.

    Position, velocity (m, m/s, W) are those at `time_ns`; forces are per unit mass (m/s^2, W).
    `following` is True when the robot obeys the law, or stands ready to from the epoch on; when it
    is False the robot brakes, comes to rest, and its forces say nothing about its motion.
    The correction is what the safety filter and a detour make of the two forces: it accelerates by the sum
    of all three. `doubt` is the position uncertainty (m), how far it may be from where it says: 0 unless its
    plant is lost.
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
    doubt: float
    multipliers: tuple[tuple[int, float], ...]
    heard: tuple[tuple[int, int], ...]


NO_FORCES: Final = (0.0,) * 6
"""The forces and the correction of a `HandState` where there are none, or none are known."""


class PlantState(NamedTuple):
    """One body as its plant measures it, valid at `time_ns`.

    x, y (m, W), heading (rad, counter-clockwise from x), speed along the heading (m/s), yaw rate (rad/s).
    `force` (N) and `torque` (N m) are what acts on the body from now on, after limits. `driving` is False
    while the plant brakes: for want of a fresh wrench, or as it was asked to. `healthy` is False when the
    measurement must not be used; `obeying` is False when it may be, but the body does not do what it is
    asked: its operator has it. `note` says why.
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
    """Operator's resume: after a `Stop`, and for robots whose body an operator took away and
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

    `transition` names the row of `agent.supervision.state_machine.TRANSITIONS` that led to `state`;
    `order_version` is that of the last stop or resume. `tick_us` holds the duration of every tick since the
    last status (empty in virtual time), `ages_us` the age of every neighbour's hand state at every tick
    since then. `neighbours` gives ``(id, age_us, received, lost, offset_us, error_us)`` for each neighbour:
    the age of its hand state now, -1 when never heard; how many of them came and how many did not; its
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

    Hand point and its velocity (m, m/s, W) at `time_ns`, `following` and `doubt` as in `HandState`. Then the
    orders that it has acknowledged: the mission (its version and `tag`), the last stop and the last resume
    (-1: none). Who has later ones relays them. `silent` are robots that it has not heard for a while, as they
    were then: ``(robot, time_ns, following, x, y, vx, vy)``. A robot that has just started hears of them so.
    """

    robot: int
    sequence: int
    time_ns: int
    following: bool
    x: float
    y: float
    vx: float
    vy: float
    doubt: float
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
    """An operator asks for the mission and the last stop or resume: agents relay them."""

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


def clipped(text: str, most: int = TEXT_MAX) -> str:
    """`text` cut to what a message may hold, `most` bytes."""
    data = text.encode()
    return text if len(data) <= most else data[: most - 3].decode(errors="ignore") + "..."
