"""The contract of a plant: one body, simulated or real, that is stepped at a fixed rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Final, NamedTuple, Protocol

from handfast.agent.control.hand import Pose
from handfast.agent.fleet.sections import Robot

Place = tuple[float, float, float]
"""x, y (m, W), heading (rad, counter-clockwise from x)."""


class Command(NamedTuple):
    """Force (N, along the heading) and torque (N m) asked of a body."""

    force: float
    torque: float


COAST: Final = Command(0.0, 0.0)
"""Nothing is asked for: on as fast as it goes."""


class Reading(NamedTuple):
    """The state of a body at one instant.

    The pose of a simulated body is exact: `plant.node` adds the errors of its sensors.

    Attributes:
        time_ns: when `pose` was true, not when it was read; ns of the wall clock.
        pose: position (m), heading (rad), in W; speed along the heading (m/s), yaw rate (rad/s).
        force, torque: N, N m, along the heading and about the axis up: act on the body from then on.
        healthy: False when the pose must not be used.
        note: why it is not healthy or not obeying; "" when it is both.
        obeying: False when the pose may be used, but commands do not reach the body: its operator has it.
        asked: speed (m/s) and yaw rate (rad/s) that a body with a watchdog of its own was asked for last, and
            goes on by until that stops it, when nothing commands it any more; None for any other.
    """

    time_ns: int
    pose: Pose
    force: float
    torque: float
    healthy: bool = True
    note: str = ""
    obeying: bool = True
    asked: tuple[float, float] | None = None


WAITING: Final = "waiting for "
"""How `Check.found` begins of what is blocking now and may become good by itself."""
BATTERY: Final = "battery"
"""`Check.name` of how full the body's battery is, which a drive shows: its `Check.found` holds a share, as
"88 %", or a voltage, as "12.3 V", or neither where it is not measured."""


class Check(NamedTuple):
    """The result of one check of a body before it drives: a line of `agent.messages.types.Checks`.

    Attributes:
        name: of what was checked.
        level: one of `agent.messages.types.LEVELS`.
        found: what was found, for people.
        advice: what to do about it; "" when there is nothing to do.
    """

    name: str
    level: str
    found: str
    advice: str = ""


class Said(NamedTuple):
    """What a vehicle said itself: a text, `severity` one of `agent.messages.types.SEVERITIES`."""

    severity: str
    text: str


class PlantBackend(Protocol):
    """A body. `PlantNode` calls `step` at a fixed rate and decides what is asked of the body."""

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """Brings the body to `now_ns`, then gives it `command`; returns its state there.

        Never blocks and never raises: what fails makes the reading unhealthy.

        Args:
            now_ns: the present, ns of the wall clock.
            command: acts from now on; None: brake, and stay stopped.
        """
        ...

    def close(self) -> None:
        """Releases the body, which goes on braking."""
        ...

    def clear_to_drive(self) -> None:
        """Takes the fleet's clearance to drive: a new mission, or a resume.

        A body that its operator has taken away and given back obeys again only after this. A vehicle's
        process that starts in mid-drive hears it only of a resume: its operator may have had it before.
        """
        return None

    def checks(self, now_ns: int) -> Sequence[Check]:
        """The checks of the body before a drive; none of a simulated one.

        Args:
            now_ns: the present, ns of the wall clock.
        """
        return ()

    def status_texts(self) -> Sequence[Said]:
        """What the body itself has said since the last call, oldest first; nothing of a simulated one."""
        return ()


class VirtualBody(PlantBackend, Protocol):
    """A body in virtual time, which says where it is."""

    @property
    def pose(self) -> Pose:
        """Where it was (W) at the last step."""
        ...

    def alone(self, now_ns: int) -> bool:
        """Lets time pass, until `now_ns`, in which no process steps it, if it is one that goes on by itself.

        Returns whether `pose` is where it is by now.
        """
        return False


class Begin(NamedTuple):
    """How a body begins.

    Attributes:
        now_ns: the present, ns of the wall clock.
        at: where it stands, at rest; None: where the fleet file has it.
        before: in virtual time the body that the robot had, None for the first.
        look: it is looked at only: a vehicle is not made able to move.
        log: takes a line of its process's log.
    """

    now_ns: int
    at: Place | None = None
    before: VirtualBody | None = None
    look: bool = False
    log: Callable[[str], None] = lambda _: None


class Setup(NamedTuple):
    """What a plant of others is made with. More may be added at the end.

    Attributes:
        robot: its entry in the fleet file: id, mass_kg, inertia_kgm2, limits.
        settings: its own table, an instance of its `Settings`; None where it has none.
        start: where its centre stands at the start.
        period_s: time between two steps, s.
        timeout_s: a command acts for so long at most when no step follows, s.
        seed: of its random draws; another one for each robot.
        look: it is looked at only, before a drive: a vehicle must not be made able to move.
    """

    robot: Robot
    settings: Any
    start: Place
    period_s: float
    timeout_s: float
    seed: int
    look: bool = False


class Plant(PlantBackend):
    """Base of a plant of others: a class that a fleet file names, as ``plant = "package.module:Class"``.

    It is made with one `Setup`, and asked for one `step` after another.

    Attributes:
        section: name of its table in the fleet file, ``[robot.NAME]``; None: it has none.
        Settings: model of that table: a frozen dataclass whose fields are made with `setting`.
        vehicle: whether it is a real body, which stands where the world has it.
        rolls_on_s: for so long it goes on as it went once its process is gone, s, and stops by itself then.
        simulated: what stands for it in virtual time; None: it itself.
    """

    section: ClassVar[str | None] = None
    Settings: ClassVar[type[Any] | None] = None
    vehicle: ClassVar[bool] = False
    rolls_on_s: ClassVar[float] = 0.0
    simulated: ClassVar[type[Plant] | None] = None

    def __init__(self, setup: Setup) -> None:
        self.setup = setup

    def close(self) -> None:
        """See `PlantBackend.close`."""
