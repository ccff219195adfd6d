"""A fleet as it drives, summed up: the latest of what its robots say (PURE)."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, inf, isinf
from typing import Final, TypeVar

import numpy as np

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import CLOCK_SKEW_MAX_S
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.reference import Edge, Reference
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
    SEVERITIES,
    Beacon,
    Checks,
    Faults,
    HandState,
    Message,
    Mission,
    PlantState,
    Removed,
    Resume,
    Status,
    StatusText,
    Stop,
)
from handfast.agent.supervision.state_machine import DRIVING_NAMES, status_hz
from handfast.deploy.analysis.places import AT_PLACE
from handfast.deploy.analysis.silence import SilentBodies, SilentBody
from handfast.deploy.drive.news import Happening, Lagging, News
from handfast.deploy.drive.readiness import Line
from handfast.deploy.faults.live import Held, shown
from handfast.deploy.faults.rules import defaults, held, lasts, words
from handfast.deploy.orders.operator import Known
from handfast.plant.backend import BATTERY

GRAVE: Final = frozenset(SEVERITIES[: SEVERITIES.index("warning") + 1])
"""Of what vehicles say, what is shown of a drive; all of it is recorded."""
SILENT_S: Final = 1.0
SILENT_STATUSES: Final = 4.0
"""Who has said nothing for so long, and for so many of the times in which its agent tells its status, is
silent."""
PLANT_SILENT_NS: Final = NS_PER_S
"""What a plant measured holds no longer than this, once others have measured since."""

_AGENT_KEYS: Final[Mapping[type, Callable[[str, int], str]]] = {
    HandState: key_expressions.hand,
    Status: key_expressions.status,
    Beacon: key_expressions.beacon,
    StatusText: key_expressions.status_texts,
    Checks: key_expressions.checks,
}
"""Key expression of each message that an agent publishes, by fleet and robot."""


@dataclass
class Picture:
    """The fleet at one moment.

    time_s is fleet time, negative before the epoch and None before it is set. Distances in m; none between
    two robots that are both silent: what they said last does not hold any more.
    """

    time_s: float | None
    duration_s: float
    nearest: tuple[float, int, int] | None = None
    """Closest of any two robots: distance, and the two."""
    worst: tuple[float, int, int] | None = None
    """Edge that is furthest from its wanted distance: error, and the two robots."""
    robots: Mapping[int, RobotPicture] = field(default_factory=dict)
    faults: Sequence[str] = ()
    """The faults that hold now, in words."""
    lagging: Sequence[int] = ()
    """Robots that drive, are not at their places and do not come nearer, the farthest first."""
    silent: Sequence[SilentBody] = ()
    """Robots that are not heard, and where they are believed to be."""

    @property
    def oldest_ms(self) -> float | None:
        """Age of the oldest message that any robot acts on, ms; None where no robot is heard."""
        return max((robot.age_ms for robot in self.robots.values() if robot.age_ms is not None), default=None)


@dataclass
class RobotPicture:
    """One robot: its state and why, its worst distance error (m), the age of its oldest neighbour
    (ms), its last tick's time (us), the ticks it missed, what is wrong with clocks in its eyes: of the
    neighbour whose clock is furthest off, its id and by how much it is ahead (s); and how far it is from its
    place (m). Of one that is silent only its state, why, the ticks that it missed until then, and its
    battery."""

    state: str
    reason: str
    error_m: float | None
    age_ms: float | None
    tick_us: int | None
    overruns: int
    clock: tuple[int, float] | None = None
    off_m: float | None = None
    silent_s: float | None = None
    """For how long a robot that is silent has said nothing, s."""
    nearest: tuple[float, int] | None = None
    """Distance (m) of its hand to that of the robot nearest to it, and which that is."""
    speed: float | None = None
    """Of its body along its heading, m/s, as its plant measures it; None while its plant says nothing."""
    battery: Line | None = None
    """What its plant says of its battery, None where it says nothing of one."""


class Watch:
    """Keeps the latest hand state and status of every robot: `picture` sums up, `news` says what changed."""

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        self._fleet = fleet
        self._reference = Reference(fleet, geometry)
        self._known = Known(fleet, geometry)
        self.hands: dict[int, HandState] = {}
        self.statuses: dict[int, Status] = {}
        self._plants: dict[int, PlantState] = {}
        self._plant_keys = {
            key_expressions.plant_state(fleet.fleet.name, robot): robot for robot in fleet.ids
        }
        self._batteries: dict[int, Line] = {}
        self._lagging = Lagging()
        self._silent = SilentBodies()
        self._heard: set[int] = set()
        self._heard_s: dict[int, float] = {}
        """Whose agents have said something since the last picture, and when (fleet time) each had last."""
        self._silent_after_s = max(SILENT_S, SILENT_STATUSES / status_hz(len(fleet.robots)))
        self._news = News(fleet)
        self._rules = [rule for rule in FaultPlan(fleet).file_rules() if lasts(rule)]
        everywhere = defaults(fleet.faults)
        self._always = () if everywhere is None else (words(everywhere),)
        self._held = Held(fleet)
        self._epoch_ns: int | None = None

    def feed(self, key: str, message: Message) -> None:
        """Takes a message that came on `key`; one on another robot's key, or an old one, is ignored."""
        if isinstance(message, Faults):
            self._held.feed(key, message)
        elif isinstance(message, Mission | Stop | Resume):
            self._follow(key, message)
        elif isinstance(message, PlantState):
            if self._plant_keys.get(key) == message.robot:
                _keep_newest(self._plants, message)
            if message.note and message.healthy and message.obeying:
                self._news.remark(message.robot, message.note)
        elif (
            isinstance(message, HandState | Status | Beacon | StatusText | Checks)
            and _AGENT_KEYS[type(message)](self._fleet.fleet.name, message.robot) == key
        ):
            self._hear(message)

    def _hear(self, message: HandState | Status | Beacon | StatusText | Checks) -> None:
        """Take a message that an agent published on its own key."""
        robot = message.robot
        if isinstance(message, HandState):
            if _keep_newest(self.hands, message):
                self._heard.add(robot)
        elif isinstance(message, Status):
            if _keep_newest(self.statuses, message):
                self._heard.add(robot)
                self._news.state(robot, message.state, message.reason)
        elif isinstance(message, Beacon):
            self._silent.hear(message)
            self._heard.add(robot)
        elif isinstance(message, Checks):
            found = [Line._make(line) for line in message.lines if line.name == BATTERY]
            if found:
                self._batteries[robot] = found[0]
        elif message.severity in GRAVE:
            text = f"its vehicle says ({message.severity}): {message.text}"
            self._news.said(robot, text, message.time_ns)

    def _follow(self, key: str, message: Mission | Stop | Resume) -> None:
        if self._known.hear(key, message):
            self._news.order(message)
            if type(message) is Mission and self._known.plan is not None:
                self._reference.take(self._known.plan)
                self._epoch_ns = message.epoch_ns

    def forget(self, robot: int) -> None:
        """What its agent said last does not hold any more: there is no connection to it."""
        self.statuses.pop(robot, None)
        self.hands.pop(robot, None)
        self._silent.forget(robot)

    def news(self, time_s: float | None) -> list[str]:
        """Sentences for what was ordered and which robots changed their state since the last call."""
        return self._news.sentences(time_s)

    def happenings(self, time_s: float | None) -> list[Happening]:
        """The same, not yet in sentences: either is asked for, not both."""
        return self._news.happenings(time_s)

    def states(self) -> dict[int, str]:
        """Every robot's state, "" of one that has said nothing yet."""
        return {
            robot: self.statuses[robot].state if robot in self.statuses else "" for robot in self._fleet.ids
        }

    def members(self, time_s: float | None) -> list[int]:
        """Robots that have a place in the formation at this fleet time."""
        now_ns = self._now_ns(time_s)
        return [robot for robot in self._fleet.ids if self._reference.is_member(robot, now_ns)]

    def place(self, robot: int, time_s: float | None) -> tuple[float, float] | None:
        """Where a robot should be at this fleet time, m (W); None for one without a place."""
        motion = self._reference.motion(robot, self._now_ns(time_s))
        return None if motion is None else motion[:2]

    def edges(self, robot: int, time_s: float | None) -> tuple[Edge, ...]:
        """The edges of a robot at this fleet time."""
        return self._reference.edges(robot, self._now_ns(time_s))

    def picture(self, time_s: float | None) -> Picture:
        """The fleet now; `time_s` is the fleet time, None before the epoch is set."""
        mission = self._known.mission
        duration_s = self._fleet.fleet.duration_s if mission is None else mission.duration_ns / NS_PER_S
        robots: dict[int, RobotPicture] = {}
        picture = Picture(time_s, duration_s, robots=robots, faults=self._faults(time_s))
        now_ns = self._now_ns(time_s)
        removed = mission.removed if mission else ()
        gone = self._gone(removed)
        silent_s = {} if time_s is None else self._silent_s(time_s)
        hands = at_once(self.hands)
        near = nearest_of_each({robot: hands[robot] for robot in hands.keys() - gone}, silent_s)
        picture.nearest = closest(near)
        edges = {robot: self._reference.edges(robot, now_ns) for robot in hands}
        errors = edge_errors(hands, edges, silent_s)
        # The last value of a key stays, so each robot keeps its largest error.
        worst = {robot: error for error, robot, _ in sorted(errors)}
        if errors:
            error, robot, other = max(errors, key=lambda each: each[0])
            picture.worst = error, min(robot, other), max(robot, other)
        if time_s is not None:
            picture.silent = self._silent.bodies(removed)
        speeds = self._speeds()
        for robot in self._fleet.ids:
            about = self._robot(self.statuses.get(robot), worst.get(robot))
            if robot in silent_s:
                carried = ", and its body has been removed" if robot in gone else ""
                why = f"has said nothing for {silent_s[robot]:.0f} s{carried}"
                about = RobotPicture(
                    "silent", why, None, None, None, about.overruns, silent_s=silent_s[robot]
                )
            else:
                about.nearest, about.speed = near.get(robot), speeds.get(robot)
                about.off_m = self._off_m(robot, now_ns)
            about.battery = self._batteries.get(robot)
            robots[robot] = about
        least_m = min((edge.distance for each in edges.values() for edge in each), default=inf)
        if time_s is not None and least_m < inf:
            picture.lagging = self._lagging.look(time_s, _driving_off_m(robots), AT_PLACE * least_m)
        return picture

    def _gone(self, removed: Iterable[Removed]) -> set[int]:
        """Return the removed robots that have not sent a hand state since their removal."""
        return {
            robot
            for robot, since_ns in removed
            if robot not in self.hands or self.hands[robot].time_ns <= since_ns
        }

    def _off_m(self, robot: int, now_ns: int) -> float | None:
        """Return the distance (m) of a robot's last hand from its place; None without either."""
        place = self._reference.motion(robot, now_ns) if robot in self.hands else None
        if place is None:
            return None
        return hypot(self.hands[robot].x - place[0], self.hands[robot].y - place[1])

    def _speeds(self) -> dict[int, float]:
        """Speeds (m/s) of the bodies of which something was heard lately."""
        newest_ns = max((plant.time_ns for plant in self._plants.values()), default=0)
        return {
            robot: plant.speed
            for robot, plant in self._plants.items()
            if plant.healthy and newest_ns - plant.time_ns <= PLANT_SILENT_NS
        }

    def stood(self) -> None:
        """This process has stood: by what waited for it since the last picture nobody is heard."""
        self._heard.clear()

    def _silent_s(self, time_s: float) -> dict[int, float]:
        """Robots that have been heard, and not for a while, and for how long."""
        self._heard_s |= dict.fromkeys(self._heard, time_s)
        self._heard.clear()
        return {
            robot: time_s - at_s
            for robot, at_s in self._heard_s.items()
            if time_s - at_s > self._silent_after_s
        }

    def _now_ns(self, time_s: float | None) -> int:
        """The wall clock at this fleet time; 0 before the epoch is known."""
        if time_s is None or self._epoch_ns is None:
            return 0
        return self._epoch_ns + round(time_s * NS_PER_S)

    def _faults(self, time_s: float | None) -> list[str]:
        out = list(self._always)
        for rule, until_s in held(self._rules, -1.0 if time_s is None else time_s):
            out.append(rule.name if isinf(until_s) else f"{rule.name} until {until_s:.1f} s")
        if self._epoch_ns is not None and time_s is not None:
            now_ns = self._epoch_ns + round(time_s * NS_PER_S)
            out += shown(self._held.sets(now_ns), now_ns)
        return out

    def _robot(self, status: Status | None, error: float | None) -> RobotPicture:
        if status is None:
            return RobotPicture("", "nothing heard yet", None, None, None, 0)
        limit_us = CLOCK_SKEW_MAX_S * 1e6
        # Beyond the limit for sure: the estimate is off by its error at most.
        off = [
            (robot, offset_us / 1e6)
            for robot, *_, offset_us, error_us in status.neighbours
            if error_us >= 0 and abs(offset_us) - error_us > limit_us
        ]
        return RobotPicture(
            status.state,
            status.reason,
            error,
            max((neighbour[1] for neighbour in status.neighbours), default=0) / 1e3,
            max(status.tick_us, default=None),
            dict(status.counters).get("overruns", 0),
            max(off, key=lambda each: abs(each[1]), default=None),
        )


def at_once(hands: Mapping[int, HandState]) -> dict[int, HandState]:
    """All of them at the time of the newest: who promises the next one goes on from its last until then."""
    newest_ns = max((hand.time_ns for hand in hands.values()), default=0)
    found = {}
    for robot, hand in hands.items():
        on_s = min((newest_ns - hand.time_ns) / NS_PER_S, hand.next_ms / 1e3)
        moved = hand._replace(x=hand.x + on_s * hand.vx, y=hand.y + on_s * hand.vy) if on_s > 0.0 else hand
        found[robot] = moved
    return found


def _driving_off_m(robots: Mapping[int, RobotPicture]) -> dict[int, float]:
    """Return the distances (m) from their places of the robots that drive."""
    return {
        robot: about.off_m
        for robot, about in robots.items()
        if about.off_m is not None and about.state in DRIVING_NAMES
    }


def edge_errors(
    hands: Mapping[int, HandState], edges: Mapping[int, Sequence[Edge]], silent: Container[int]
) -> list[tuple[float, int, int]]:
    """Return the distance error (m) of each edge of full weight as each of its robots has it, and its ends.

    Args:
        silent: robots that are not heard: an edge between two of them has no error.
    """
    return [
        (abs(hypot(here.x - there.x, here.y - there.y) - edge.distance), robot, edge.other)
        for robot, here in hands.items()
        for edge in edges[robot]
        if (there := hands.get(edge.other)) is not None
        and edge.weight >= 1.0
        and not (robot in silent and edge.other in silent)
    ]


def nearest_of_each(hands: Mapping[int, HandState], silent: Container[int]) -> dict[int, tuple[float, int]]:
    """By robot, the distance (m) of its hand to the nearest other one, and whose that is.

    Args:
        silent: robots that are not heard: two of them are not near each other, as far as is known.
    """
    ids = sorted(hands)
    if len(ids) < 2:
        return {}
    x, y = np.array([(hands[robot].x, hands[robot].y) for robot in ids]).T
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    is_silent = np.array([robot in silent for robot in ids])
    apart[is_silent[:, None] & is_silent] = inf
    np.fill_diagonal(apart, inf)
    others = apart.argmin(axis=1).tolist()
    least = apart.min(axis=1).tolist()
    return {
        robot: (distance, ids[other])
        for robot, other, distance in zip(ids, others, least, strict=True)
        if distance < inf
    }


def closest(nearest: Mapping[int, tuple[float, int]]) -> tuple[float, int, int] | None:
    """Distance (m) of the two hands nearest to each other, and the two robots; None without two.

    Args:
        nearest: of each robot (`nearest_of_each`).
    """
    if not nearest:
        return None
    robot, (distance_m, other) = min(nearest.items(), key=lambda item: item[1][0])
    return distance_m, min(robot, other), max(robot, other)


S = TypeVar("S", HandState, PlantState, Status)


def _keep_newest(known: dict[int, S], message: S) -> bool:
    """Whether the message is newer than the one that was known, whose place it then takes."""
    if message.robot in known and message.time_ns <= known[message.robot].time_ns:
        return False
    known[message.robot] = message
    return True


def fleet_time_s(now_ns: int, epoch_ns: int | None) -> float | None:
    """Seconds since the epoch, None before it is set."""
    return None if epoch_ns is None else (now_ns - epoch_ns) / NS_PER_S
