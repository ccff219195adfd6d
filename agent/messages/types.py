"""Messages on the bus, each declared once: its fields in the order of the wire, with types, bounds and units.

Units are SI, positions and velocities in W (world ENU), times integer nanoseconds of the wall
clock (Unix epoch). `agent.messages.codec` makes bytes of them.

A new field goes at the end of its class, with `About.before` for recordings that lack it; the wire's
`VERSION` goes up, unless it is `About.omitted` while empty.
"""

from __future__ import annotations

from operator import itemgetter
from typing import Annotated, Any, Final, NamedTuple, get_args

from handfast.agent.common.models import new
from handfast.agent.messages.declaration import FLOAT_MAX as FLOAT_MAX
from handfast.agent.messages.declaration import About
from handfast.agent.messages.trickle_timer import FIRST_ROUND

VERSION: Final = 7
"""Version of the protocol, the first field of every message."""
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
OWN_MAX: Final = 16
"""Numbers of a law's own in one `HandState`."""
TRACE_MAX: Final = 128
"""Entries of one `LinkTrace`."""
TIME_NS_MAX: Final = 2**62
"""All times (ns), versions and sequence numbers are below it."""
ACTS_PERIODS: Final = 2
"""A wrench acts for so many times as long as it is meant to at most, and then nothing does until the plant
brakes: what was decided for one speed and heading drives a body that is elsewhere, and faster, away."""
WRENCH_STEPS_MAX: Final = 16
"""Of `Wrench.step`: a rest of half a second at 100 kHz."""
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
RANGE: Final = 32
OVERFLOW: Final = 64
WHAT_MAX: Final = 2**16 - 1
EVENTS: Final = ("kill", "start", "stop", "continue")
"""What is done to processes: SIGKILL, started again, SIGSTOP, SIGCONT."""

LEVELS: Final = ("ok", "warning", "blocking")
"""Of a line of `Checks`: fine; worth knowing; no drive begins over it."""
SEVERITIES: Final = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
"""Of a `StatusText`: names of MAV_SEVERITY, in the order of its numbers (RFC 5424)."""
LEFT_MAX: Final = 64
"""Of a mission's `left`."""
CHECKS_MAX: Final = 32
"""Lines of one `Checks`."""
CHECK_TEXT_MIN: Final = 100
"""Bytes of a text of `Checks` that there is room for, however many lines it has."""

Outgoing = tuple[str, bytes]
"""A message to publish: its key and its bytes."""

_ROBOT: Final = About("Number of the robot", least=1, most=ROBOT_MAX)
_COUNT: Final = About("Sequence number, counted by the sender for this topic", least=0, most=TIME_NS_MAX - 1)
_ROUND: Final = _COUNT.of(
    f"Sequence number: {FIRST_ROUND} + the periods from the mission's epoch to time_ns; before the "
    "mission is known, counted from 0",
)
_TIME: Final = About(
    "Wall clock at which the content holds, since the Unix epoch", "ns", least=0, most=TIME_NS_MAX - 1
)
_VERSION: Final = _COUNT.of("Grows with every change")
_ACKNOWLEDGED: Final = About("", least=-1, most=TIME_NS_MAX - 1)
_FOLLOWING: Final = About("False while the robot brakes instead of following the law")
_HAND_X: Final = About("Hand point, east (world ENU)", "m")
_HAND_Y: Final = About("Hand point, north (world ENU)", "m")
_HAND_VX: Final = About("Velocity of the hand point, east", "m/s")
_HAND_VY: Final = About("Velocity of the hand point, north", "m/s")
_HEADING: Final = About("Heading, counter-clockwise from east", "rad")
_SPEED: Final = About("Speed along the heading", "m/s")
_YAW_RATE: Final = About("Yaw rate, counter-clockwise", "rad/s")
_NEXT: Final = About(
    "Its next one is stamped so much later at most; 0: as much later as is usual",
    "ms",
    least=0,
    most=60_000,
    before=0,
    omitted=True,
)
_STOOD: Final = About(
    "For how much of the last seconds its process did not run, though it should have: what it did not say "
    "then is not lost",
    "ms",
    least=0,
    most=60_000,
    before=0,
    omitted=True,
)
_OVERLOAD: Final = About(
    "By how many steps it wants the rate of all to fall, as its machine cannot keep it",
    least=0,
    most=16,
    before=0,
    omitted=True,
)
_DOUBT: Final = About(
    "Position uncertainty: how far it may be from there; 0 unless its plant is lost",
    "m",
    least=0.0,
    before=0.0,
)


LOST_MS_MAX: Final = 60_000
_LOST: Final = About(
    "How long ago its body was measured last, while its plant is lost and it may roll on",
    "ms",
    least=0,
    most=LOST_MS_MAX,
    before=0,
    omitted=True,
)


class Multiplier(NamedTuple):
    """One of the sender's copies of lambda: of an edge, or of a robot that it is kept away from."""

    neighbour: Annotated[int, About("Robot at the other end")]
    value: Annotated[float, About("lambda")]


class Echo(NamedTuple):
    """The least apparent delay of a neighbour's hand states. From both directions both ends find the offset
    of their clocks."""

    neighbour: Annotated[int, About("Whose hand states")]
    delay_us: Annotated[
        int,
        About(
            "Clock at its reception minus its stamp; negative when clocks differ",
            "us",
            least=1 - TIME_NS_MAX,
            most=TIME_NS_MAX - 1,
        ),
    ]


class Setpoint(NamedTuple):
    """What a body obeys, from the stamp of the message on; of one whose plant is lost, which tells a circle
    round its way, since it was measured last."""

    heading: Annotated[float, _HEADING]
    speed: Annotated[float, _SPEED]
    yaw_rate: Annotated[float, _YAW_RATE]


class HandState(NamedTuple):
    """One robot's hand point, from its agent to its neighbours.

    Position and velocity are those at `time_ns`. `following` is True when the robot obeys the law, or stands
    ready to from the epoch on; when it is False the robot brakes, comes to rest, and its forces say nothing
    about its motion. It accelerates by the sum of the two forces and the correction, which is what the safety
    filter and a detour make of them.
    """

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _ROUND]
    time_ns: Annotated[int, _TIME]
    following: Annotated[bool, _FOLLOWING]
    degree: Annotated[
        int,
        About(
            "How many constraints act on it: edges, and what it is kept away from",
            least=0,
            most=DEGREE_MAX,
            before=lambda content: len(content["multipliers"]),  # nothing but its edges acted on a robot
        ),
    ]
    x: Annotated[float, _HAND_X]
    y: Annotated[float, _HAND_Y]
    vx: Annotated[float, _HAND_VX]
    vy: Annotated[float, _HAND_VY]
    navigation_x: Annotated[float, About("Navigation force per unit mass, east", "m/s2")]
    navigation_y: Annotated[float, About("Navigation force per unit mass, north", "m/s2")]
    constraint_x: Annotated[float, About("Constraint force per unit mass, east", "m/s2")]
    constraint_y: Annotated[float, About("Constraint force per unit mass, north", "m/s2")]
    correction_x: Annotated[
        float, About("What safety filter and detour add to the two forces, east", "m/s2", before=0.0)
    ]
    correction_y: Annotated[
        float, About("What safety filter and detour add to the two forces, north", "m/s2", before=0.0)
    ]
    doubt: Annotated[float, _DOUBT]
    multipliers: Annotated[
        tuple[tuple[int, float], ...],
        About(
            "The sender's multipliers: of each edge, and of each robot it is kept from",
            rows=NEIGHBOURS_MAX,
            row=Multiplier,
        ),
    ]
    heard: Annotated[
        tuple[tuple[int, int], ...],
        About(
            "Least apparent delay of each neighbour's hand states; empty in most messages",
            rows=NEIGHBOURS_MAX,
            row=Echo,
            before=(),
        ),
    ]
    own: Annotated[
        tuple[Annotated[float, About("One number")], ...],
        About("Numbers of its law's own, for its neighbours' laws", rows=OWN_MAX, before=(), omitted=True),
    ] = ()
    next_ms: Annotated[int, _NEXT] = 0
    stood_ms: Annotated[int, _STOOD] = 0
    obeys: Annotated[
        tuple[tuple[float, float, float], ...],
        About(
            "What its body goes on by when nothing commands it any more, while it moves and has a watchdog "
            "of its own; else none",
            rows=1,
            row=Setpoint,
            before=(),
            omitted=True,
        ),
    ] = ()
    lost_ms: Annotated[int, _LOST] = 0

    @classmethod
    def placed(
        cls,
        robot: int,
        sequence: int,
        time_ns: int,
        following: bool,
        degree: int,
        place: tuple[float, float, float, float],
        doubt: float = 0.0,
        obeys: tuple[tuple[float, float, float], ...] = (),
        lost_ms: int = 0,
    ) -> HandState:
        """One that says only where a robot is, as a beacon does; `place`: x, y, vx, vy."""
        x, y, vx, vy = place
        values = (
            robot, sequence, time_ns, following, degree, x, y, vx, vy, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, doubt,
            (), (), (), 0, 0, obeys, lost_ms,
        )  # fmt: skip
        return new(cls, values)

    @property
    def place(self) -> tuple[float, float, float, float]:
        """x, y (m), vx, vy (m/s)."""
        return self.x, self.y, self.vx, self.vy


Forces = tuple[float, float, float, float, float, float]
"""Navigation force, constraint force and correction of a `HandState`, x and y of each."""
NO_FORCES: Final[Forces] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The forces and the correction of a `HandState` where there are none, or none are known."""


class Asked(NamedTuple):
    """What a body was asked for last that has a watchdog of its own, and goes on by until that stops it."""

    speed: Annotated[float, _SPEED]
    yaw_rate: Annotated[float, _YAW_RATE]


class PlantState(NamedTuple):
    """One body as its plant measures it, valid at `time_ns`.

    Force and torque act on the body from now on, after limits. `healthy` is False when the measurement must
    not be used; `obeying` is False when it may be, but the body does not do what it is asked.
    """

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _ROUND]
    time_ns: Annotated[int, _TIME]
    x: Annotated[float, About("Position, east (world ENU)", "m")]
    y: Annotated[float, About("Position, north (world ENU)", "m")]
    heading: Annotated[float, _HEADING]
    speed: Annotated[float, _SPEED]
    yaw_rate: Annotated[float, _YAW_RATE]
    force: Annotated[float, About("Force along the heading that acts until the next state", "N")]
    torque: Annotated[float, About("Torque that acts until the next state", "N m")]
    driving: Annotated[
        bool, About("False while the plant brakes: for want of a fresh wrench, or as asked to")
    ]
    healthy: Annotated[bool, About("False when the measurement must not be used")]
    obeying: Annotated[bool, About("False when the body's operator has it", before=True)]
    note: Annotated[str, About("Why it is not healthy, or does not obey")]
    asked: Annotated[
        tuple[tuple[float, float], ...],
        About(
            "What its body goes on by when nothing commands it any more; none where it stands then",
            rows=1,
            row=Asked,
            before=(),
            omitted=True,
        ),
    ] = ()


class Wrench(NamedTuple):
    """What the agent asks of its plant: force and torque, or to brake."""

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _ROUND]
    time_ns: Annotated[int, _TIME]
    force: Annotated[float, About("Force asked for, along the heading", "N")]
    torque: Annotated[float, About("Torque asked for", "N m")]
    brake: Annotated[bool, About("True when the plant is asked to brake")]
    clock: Annotated[
        tuple[
            Annotated[
                int,
                About(
                    "Which monotonic clock, wall minus it", "ns", least=1 - TIME_NS_MAX, most=TIME_NS_MAX - 1
                ),
            ],
            ...,
        ],
        About(
            "`agent.common.time.MachineClock` of the agent, by which its plant goes too if it has the same "
            "monotonic clock; none in virtual time",
            rows=2,
            before=(),
            omitted=True,
        ),
    ] = ()
    step: Annotated[
        int,
        About(
            "By how many steps the rate has fallen: it is meant to act for 2^step periods of the plant",
            least=0,
            most=WRENCH_STEPS_MAX,
            before=0,
            omitted=True,
        ),
    ] = 0


class Setting(NamedTuple):
    """One field of a `[trajectory]`."""

    field: Annotated[str, About("Field of [trajectory] in a fleet file")]
    value: Annotated[Any, About("Its value, as JSON")]


class Place(NamedTuple):
    """A member of the formation."""

    robot: Annotated[int, _ROBOT]
    x: Annotated[float, About("Offset from the trajectory, east", "m")]
    y: Annotated[float, About("Offset from the trajectory, north", "m")]


class Distance(NamedTuple):
    """An edge of the formation."""

    robot: Annotated[int, _ROBOT]
    other: Annotated[int, _ROBOT]
    distance: Annotated[float, About("Wanted distance of their hand points", "m")]


class Removed(NamedTuple):
    """A robot whose body somebody has carried off: it is nowhere, until it is heard again."""

    robot: Annotated[int, _ROBOT]
    time_ns: Annotated[int, _TIME.of("When an operator said so, since the Unix epoch")]


class Left(NamedTuple):
    """How far the motion of a formation is from that of its mission some time after its take-over: that of
    its reference point, the mean of its places from there, and each place from that mean."""

    x: Annotated[float, About("Reference point, east", "m")]
    y: Annotated[float, About("Reference point, north", "m")]
    vx: Annotated[float, About("Velocity of that, east", "m/s")]
    vy: Annotated[float, About("Velocity of that, north", "m/s")]
    mean_x: Annotated[float, About("Mean of the places from there, east", "m")]
    mean_y: Annotated[float, About("Mean of the places from there, north", "m")]
    mean_vx: Annotated[float, About("Velocity of that, east", "m/s")]
    mean_vy: Annotated[float, About("Velocity of that, north", "m/s")]
    places: Annotated[float, About("From the mean, no place is further off than so", "m")]
    rate: Annotated[float, About("That changes no faster than so", "m/s")]
    reach: Annotated[float, About("No place is further from the mean than so", "m")]


class Mission(NamedTuple):
    """When the fleet starts and for how long it drives; all that the fleet is to do.

    The one with the greatest `version` holds wherever it is heard (`agent.messages.codec.newer`). An agent
    that runs another fleet file than `digest` names refuses it. What is empty is as in the fleet file, but
    where `robots` are given `edges` are all there are.
    """

    version: Annotated[int, _VERSION]
    time_ns: Annotated[int, _TIME]
    epoch_ns: Annotated[int, _TIME.of("Wall clock at which fleet time is zero, since the Unix epoch")]
    duration_ns: Annotated[int, _TIME.of("For how long the fleet drives", least=1)]
    digest: Annotated[str, About("Names the fleet file that the operator means")]
    from_ns: Annotated[
        int,
        _TIME.of(
            "Wall clock at which all take it over, since the Unix epoch; 0: the epoch",
            before=0,
        ),
    ] = 0
    blend_ns: Annotated[
        int, _TIME.of("Within so long they come to it from what they drove before", before=0)
    ] = 0
    note: Annotated[str, About("What has changed, in words", before="")] = ""
    trajectory_ns: Annotated[
        int,
        _TIME.of("Wall clock of the trajectory's time 0, since the Unix epoch; 0: the epoch", before=0),
    ] = 0
    trajectory: Annotated[
        tuple[Setting, ...], About("Where the formation goes; empty: as in the fleet file", before=())
    ] = ()
    robots: Annotated[
        tuple[Place, ...], About("Who has a place, and its offset; empty: as in the fleet file", before=())
    ] = ()
    edges: Annotated[
        tuple[Distance, ...],
        About("Who keeps which distance from whom; empty: as in the fleet file", before=()),
    ] = ()
    removed: Annotated[
        tuple[Removed, ...],
        About("Robots whose bodies have been carried off the field", rows=ROBOT_MAX, before=()),
    ] = ()
    left: Annotated[
        tuple[Left, ...],
        About(
            "What is left of the motion before, at equal shares of blend_ns from 0 to 1; empty: not known",
            rows=LEFT_MAX,
            before=(),
        ),
    ] = ()


class Stop(NamedTuple):
    """Operator's stop: every robot brakes and stays stopped until a `Resume` of a greater version."""

    version: Annotated[int, _VERSION]
    time_ns: Annotated[int, _TIME]
    reason: Annotated[str, About("Why the operator stops the fleet")]


class Resume(NamedTuple):
    """Operator's resume: after a `Stop`, and for robots whose body an operator took away and
    gave back.

    An agent or plant obeys a `version` only once, and only a greater one than before.
    """

    version: Annotated[int, _VERSION.of("Grows with every stop and resume")]
    time_ns: Annotated[int, _TIME]
    robots: Annotated[
        tuple[Annotated[int, _ROBOT], ...], About("Numbers of the robots that may drive again; none: all")
    ]


class CheckLine(NamedTuple):
    """One thing that was looked at."""

    name: Annotated[str, About("What was looked at")]
    level: Annotated[str, About("ok, warning or blocking", choices=LEVELS)]
    found: Annotated[str, About("What was found")]
    advice: Annotated[str, About("What to do about it; empty when there is nothing to do")]


class Checks(NamedTuple):
    """What a plant has to say of its body before a drive, for operators.

    The lines fit if no text is longer than `CHECK_TEXT_MIN`.
    """

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    lines: Annotated[
        tuple[CheckLine, ...],
        About(
            "What was looked at, how it stands (ok, warning, blocking), what was found, what to do",
            rows=CHECKS_MAX,
        ),
    ]


class StatusText(NamedTuple):
    """What the vehicle of a robot says itself, as an autopilot's STATUSTEXT, for operators and recordings."""

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    severity: Annotated[str, About("How grave it is, as MAV_SEVERITY", choices=SEVERITIES)]
    text: Annotated[str, About("What it says")]


class NeighbourStatus(NamedTuple):
    """What came from one neighbour, and how its clock stands."""

    robot: Annotated[int, About("Number of the neighbour")]
    age_us: Annotated[int, About("Age of its hand state now; -1: never heard", "us")]
    received: Annotated[int, About("Hand states that came", before=0)]
    lost: Annotated[int, About("Hand states that did not come", before=0)]
    offset_us: Annotated[int, About("Its clock minus the own", "us", before=0)]
    error_us: Annotated[int, About("Half the offset's uncertainty; -1: not known", "us", before=-1)]


class Total(NamedTuple):
    """One thing that was counted."""

    name: Annotated[str, About("What was counted")]
    value: Annotated[int, About("How many since the agent started")]


class Status(NamedTuple):
    """What one agent is doing.

    Durations and ages are those of every tick since the last status; the durations are left out in virtual
    time.
    """

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    state: Annotated[str, About("State of the agent's supervision")]
    transition: Annotated[
        str,
        About("Row of handfast.agent.supervision.state_machine.TRANSITIONS that led there", before=""),
    ]
    reason: Annotated[str, About("Why it is in that state")]
    mission_version: Annotated[int, About("Version of the mission that the agent follows")]
    order_version: Annotated[
        int, About("Version of the last stop or resume that it has acknowledged", before=0)
    ]
    neighbours: Annotated[
        tuple[NeighbourStatus, ...], About("What came from each neighbour, and how its clock stands")
    ]
    tick_us: Annotated[
        tuple[Annotated[int, About("One tick", "us")], ...],
        About("Duration of every tick since the last status; empty in virtual time", "us"),
    ]
    ages_us: Annotated[
        tuple[Annotated[int, About("One age", "us")], ...],
        About("Age of every neighbour's hand state at every tick since the last status", "us"),
    ]
    counters: Annotated[tuple[Total, ...], About("Totals since the agent started")]
    digest: Annotated[
        tuple[Annotated[str, About("The digest")], ...],
        About(
            "Names the fleet file that it reads, once it has refused a mission for another",
            rows=1,
            before=(),
            omitted=True,
        ),
    ] = ()


class Faults(NamedTuple):
    """One author's whole set of live fault rules, to every agent and plant.

    A greater `version` of the same author replaces the set. It ends at `time_ns` + `lease_ns` unless it comes
    again with a later `time_ns`. Author `EVERY_AUTHOR`, without rules, clears the sets of all.
    """

    version: Annotated[int, _COUNT.of("Replaces the lesser ones of the same author")]
    time_ns: Annotated[int, _TIME]
    author: Annotated[str, About("Whose rules these are; *: all are cleared", characters=AUTHOR_MAX)]
    origin_ns: Annotated[int, _TIME.of("Wall clock from which the rules' times count, since the Unix epoch")]
    lease_ns: Annotated[int, _TIME.of("How long the rules hold after time_ns; 0: until they are cleared")]
    rules: Annotated[str, About("The rules, TOML as in a fleet file")]

    def contradiction(self) -> str:
        """What does not go together in it, "" when all does."""
        if self.author == EVERY_AUTHOR and self.rules:
            return f"author {EVERY_AUTHOR!r} clears the faults of all and has no rules"
        return ""


class Decision(NamedTuple):
    """What was done to one message under a fault rule."""

    source: Annotated[int, _ROBOT.of("Number of the robot that sent")]
    topic: Annotated[
        int,
        About(
            "hand: agent to agent, state: plant to agent, wrench: agent to plant, beacon: agent to all",
            choices=TOPICS,
        ),
    ]
    sequence: Annotated[int, _COUNT.of("Sequence number of the message")]
    time_ns: Annotated[int, _TIME.of("Stamp of the message, since the Unix epoch")]
    what: Annotated[
        int,
        About(
            f"Sum of {LOST}: lost, {DUPLICATED}: the second copy, {CORRUPTED}: corrupted, {REORDERED}: "
            f"reordered, {RANGE}: lost to the range channel, {OVERFLOW}: lost to a full queue; "
            "0: untouched",
            least=0,
            most=WHAT_MAX,
        ),
    ]
    delay_us: Annotated[
        int, About("Injected delay after the stamp; -1: lost", "us", least=-1, most=TIME_NS_MAX - 1)
    ]


class LinkTrace(NamedTuple):
    """What a receiver did to messages under its fault rules, one entry for every decision.

    A message that passed untouched under a rule has an entry as well; one on a link without a rule has none.
    """

    robot: Annotated[int, _ROBOT.of("Number of the robot that received")]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    entries: Annotated[
        tuple[Decision, ...], About("What was done to each message under a fault rule", rows=TRACE_MAX)
    ]


class Event(NamedTuple):
    """What was done to a process on purpose."""

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    role: Annotated[str, About("agent or plant: which process of the robot", choices=("agent", "plant"))]
    what: Annotated[str, About("kill, start, stop (SIGSTOP) or continue", choices=EVENTS)]
    rule: Annotated[str, About("Name of the rule that asked for it")]


class Silent(NamedTuple):
    """A robot that somebody does not hear: as it was when the sender of a beacon, or whoever told that, heard
    it last, and where it may be since."""

    robot: Annotated[int, _ROBOT]
    time_ns: Annotated[
        int,
        _TIME.of(
            "When that was, by the sender's clock, since the Unix epoch; 0: never since the drive began"
        ),
    ]
    following: Annotated[bool, _FOLLOWING]
    x: Annotated[float, _HAND_X]
    y: Annotated[float, _HAND_Y]
    vx: Annotated[float, _HAND_VX]
    vy: Annotated[float, _HAND_VY]
    to_x: Annotated[
        float, About("End of the straight way on which it may be, east", "m", before=itemgetter("x"))
    ]
    to_y: Annotated[
        float, About("End of the straight way on which it may be, north", "m", before=itemgetter("y"))
    ]
    doubt: Annotated[float, About("How far to either side of that way it may be", "m", least=0.0, before=0.0)]


class Rolling(NamedTuple):
    """How the body of one robot goes on when nothing commands it any more: as `HandState.obeys`."""

    robot: Annotated[int, _ROBOT]
    heading: Annotated[float, _HEADING]
    speed: Annotated[float, _SPEED]
    yaw_rate: Annotated[float, _YAW_RATE]


class Lost(NamedTuple):
    """A robot whose plant is lost: as `HandState.lost_ms`, when it said so."""

    robot: Annotated[int, _ROBOT]
    lost_ms: Annotated[int, _LOST]


class Beacon(NamedTuple):
    """Where one robot is, a few times a second, from its agent to all others.

    Then the orders that it has acknowledged: who has later ones relays them. A robot that has just started
    hears so of the `silent`.
    """

    robot: Annotated[int, _ROBOT]
    sequence: Annotated[int, _COUNT]
    time_ns: Annotated[int, _TIME]
    following: Annotated[bool, _FOLLOWING]
    x: Annotated[float, _HAND_X]
    y: Annotated[float, _HAND_Y]
    vx: Annotated[float, _HAND_VX]
    vy: Annotated[float, _HAND_VY]
    doubt: Annotated[float, _DOUBT]
    mission_version: Annotated[int, _ACKNOWLEDGED.of("Version of the mission that it has acknowledged")]
    mission_tag: Annotated[int, _ACKNOWLEDGED.of("Tells missions of one version apart")]
    stop_version: Annotated[
        int, _ACKNOWLEDGED.of("Version of the last stop that it has acknowledged, -1 for none")
    ]
    resume_version: Annotated[
        int, _ACKNOWLEDGED.of("Version of the last resume that it has acknowledged, -1 for none")
    ]
    silent: Annotated[
        tuple[Silent, ...],
        About("Robots that it or somebody else does not hear, in turn where they are many", rows=SILENT_MAX),
    ] = ()
    unheard: Annotated[
        tuple[Annotated[int, _ROBOT], ...],
        About("Robots from which it hears nothing", rows=ROBOT_MAX, before=()),
    ] = ()
    next_ms: Annotated[int, _NEXT] = 0
    overload: Annotated[int, _OVERLOAD] = 0
    stood_ms: Annotated[int, _STOOD] = 0
    rolling: Annotated[
        tuple[tuple[int, float, float, float], ...],
        About(
            "How the bodies go on of its sender and of silent robots that have a watchdog of their own",
            rows=SILENT_MAX + 1,
            row=Rolling,
            before=(),
            omitted=True,
        ),
    ] = ()
    lost: Annotated[
        tuple[tuple[int, int], ...],
        About(
            "Of these, whose plants are lost",
            rows=SILENT_MAX + 1,
            row=Lost,
            before=(),
            omitted=True,
        ),
    ] = ()

    @property
    def place(self) -> tuple[float, float, float, float]:
        """x, y (m), vx, vy (m/s)."""
        return self.x, self.y, self.vx, self.vy

    def obeys(self, robot: int) -> tuple[tuple[float, float, float], ...]:
        """As `HandState.obeys`, of any robot that it tells of."""
        if not self.rolling:  # as nearly always
            return ()
        return tuple(row[1:] for row in self.rolling if row[0] == robot)[:1]

    def lost_ms(self, robot: int) -> int:
        """As `HandState.lost_ms`, of any robot that it tells of."""
        return next((ms for each, ms in self.lost if each == robot), 0) if self.lost else 0


class Heartbeat(NamedTuple):
    """An operator is there: where the fleet has a dead-man's switch, robots drive only while these come."""

    time_ns: Annotated[int, _TIME]
    author: Annotated[str, About("Who is there")]


class Ask(NamedTuple):
    """An operator asks for the mission and the last stop or resume: agents relay them."""

    time_ns: Annotated[int, _TIME]
    author: Annotated[str, About("Who asks for the mission and the last stop or resume")]


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
    | StatusText
)
CLASSES: Final[tuple[type[Message], ...]] = get_args(Message)
"""In the order of their numbers on the wire."""


def clipped(text: str, most: int = TEXT_MAX) -> str:
    """`text` as a message may hold it: at most `most` bytes, and of no bytes that are no text, as a command
    line may have them."""
    data = text.encode(errors="replace")
    return data.decode() if len(data) <= most else data[: most - 3].decode(errors="ignore") + "..."
