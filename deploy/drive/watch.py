"""A fleet as it drives, summed up: the latest of what its robots say (PURE)."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
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
        name = self._fleet.fleet.name
        if type(message) is HandState and key == key_expressions.hand(name, message.robot):
            if _keep_newest(self.hands, message):
                self._heard.add(message.robot)
        elif type(message) is Status and key == key_expressions.status(name, message.robot):
            if _keep_newest(self.statuses, message):
                self._heard.add(message.robot)
                self._news.state(message.robot, message.state, message.reason)
        elif type(message) is Beacon and key == key_expressions.beacon(name, message.robot):
            self._silent.hear(message)
            self._heard.add(message.robot)
        elif type(message) is PlantState:
            if self._plant_keys.get(key) == message.robot:
                _keep_newest(self._plants, message)
            if message.note and message.healthy and message.obeying:
                self._news.remark(message.robot, message.note)
        elif type(message) is StatusText:
            if key == key_expressions.status_texts(name, message.robot) and message.severity in GRAVE:
                text = f"its vehicle says ({message.severity}): {message.text}"
                self._news.said(message.robot, text, message.time_ns)
        elif type(message) is Faults:
            self._held.feed(key, message)
        elif type(message) is Checks and key == key_expressions.checks(name, message.robot):
            found = [Line._make(line) for line in message.lines if line.name == BATTERY]
            if found:
                self._batteries[message.robot] = found[0]
        elif type(message) is Mission or type(message) is Stop or type(message) is Resume:
            self._follow(key, message)

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
        picture = Picture(time_s, duration_s, faults=self._faults(time_s))
        now_ns = self._now_ns(time_s)
        removed = mission.removed if mission else ()
        gone = {
            robot
            for robot, since_ns in removed
            if robot not in self.hands or self.hands[robot].time_ns <= since_ns
        }
        silent_s = {} if time_s is None else self._silent_s(time_s)
        hands = at_once(self.hands)
        near = nearest_of_each({robot: hands[robot] for robot in hands.keys() - gone}, silent_s)
        picture.nearest = closest(near)
        errors: dict[int, float] = {}
        least_m = inf
        for robot, here in hands.items():
            for edge in self._reference.edges(robot, now_ns):
                least_m = min(least_m, edge.distance)
                there = hands.get(edge.other)
                if there is None or edge.weight < 1.0 or (robot in silent_s and edge.other in silent_s):
                    continue
                distance = hypot(here.x - there.x, here.y - there.y)
                error = abs(distance - edge.distance)
                errors[robot] = max(error, errors.get(robot, 0.0))
                pair = min(robot, edge.other), max(robot, edge.other)
                if picture.worst is None or error > picture.worst[0]:
                    picture.worst = error, *pair
        if time_s is not None:
            picture.silent = self._silent.bodies(removed)
        speeds = self._speeds()
        picture.robots = {
            robot: self._robot(self.statuses.get(robot), errors.get(robot)) for robot in self._fleet.ids
        }
        for robot, about in picture.robots.items():
            if robot in silent_s:
                carried = ", and its body has been removed" if robot in gone else ""
                why = f"has said nothing for {silent_s[robot]:.0f} s{carried}"
                about = picture.robots[robot] = RobotPicture(
                    "silent", why, None, None, None, about.overruns, silent_s=silent_s[robot]
                )
            else:
                about.nearest, about.speed = near.get(robot), speeds.get(robot)
                place = self._reference.motion(robot, now_ns) if robot in self.hands else None
                if place is not None:
                    about.off_m = hypot(self.hands[robot].x - place[0], self.hands[robot].y - place[1])
            about.battery = self._batteries.get(robot)
        if time_s is not None and least_m < inf:
            driving = {
                robot: about.off_m
                for robot, about in picture.robots.items()
                if about.off_m is not None and about.state in DRIVING_NAMES
            }
            picture.lagging = self._lagging.look(time_s, driving, AT_PLACE * least_m)
        return picture

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
