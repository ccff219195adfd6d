"""The live view of a fleet: what its robots say, summed up a few times a second."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, inf, isinf
from typing import Final, Protocol, TextIO, TypeVar

from rich.console import Group
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from agent.common.time import NS_PER_S
from agent.fleet.model import Fleet
from agent.formation.geometry import Geometry
from agent.formation.reference import Reference
from agent.links.fault_plan import FaultPlan
from agent.messages import key_expressions
from agent.messages.types import Beacon, Faults, HandState, Message, Mission, PlantState, Resume, Status, Stop
from agent.supervision.state_machine import DRIVING_NAMES, State
from deploy.analysis.places import AT_PLACE
from deploy.analysis.silent_bodies import SilentBodies, SilentBody, in_words
from deploy.console.views import LinesView, Speaker, TerminalView, plain
from deploy.console.wording import some
from deploy.drive.lagging import Lagging
from deploy.drive.news import News
from deploy.faults.live import Held, shown
from deploy.faults.wording import defaults, held, lasts, words
from deploy.orders.operator import Known

STYLES: Final = {
    State.RUNNING.value: "green",
    State.DEGRADED.value: "yellow",
    State.HOLDING.value: "bold yellow",
    State.RELEASED.value: "bold yellow",
    State.STOPPING.value: "cyan",
    State.STOPPED.value: "cyan",
    State.FAULT.value: "bold red",
    State.STANDBY.value: "dim",
    State.WAITING.value: "dim",
}
ROWS_MAX: Final = 24
"""Robots shown one by one in a terminal; of a larger fleet, those in trouble first."""
REASONS_MAX: Final = 3
"""Robots that are released, or lag, whose reasons are in the line that sums up; of more only the numbers."""
SILENT_S: Final = 2.0
"""Who has said nothing for so long is silent; its agent speaks five times a second."""
_LAST_NAME: Final = re.compile(r"robot \d+$")
FAULTS_MAX: Final = 4
"""Faults that are named; of more only the number is said."""


@dataclass
class Picture:
    """The fleet at one moment.

    time_s is fleet time, negative before the epoch and None before it is set. Distances in m.
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
    def oldest_ms(self) -> float:
        """Age of the oldest message that any robot acts on, ms."""
        return max((robot.age_ms for robot in self.robots.values()), default=0.0)


@dataclass
class RobotPicture:
    """One robot: its state and why, its worst distance error (m), the age of its oldest neighbour
    (ms), its last tick's time (us), the ticks it missed, what is wrong with clocks in its eyes: of the
    neighbour whose clock is furthest off, its id and by how much it is ahead (s); and how far it is from its
    place (m)."""

    state: str
    reason: str
    error_m: float | None
    age_ms: float
    tick_us: int | None
    overruns: int
    clock: tuple[int, float] | None = None
    off_m: float | None = None


class Watch:
    """Keeps the latest hand state and status of every robot: `picture` sums up, `news` says what changed."""

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        self._fleet = fleet
        self._reference = Reference(fleet, geometry)
        self._known = Known(fleet, geometry)
        self.hands: dict[int, HandState] = {}
        self.statuses: dict[int, Status] = {}
        self._lagging = Lagging()
        self._silent = SilentBodies()
        self._heard: set[int] = set()
        self._heard_s: dict[int, float] = {}
        """Whose statuses have come since the last picture, and when (fleet time) the last of each had."""
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
            _keep_newest(self.hands, message)
        elif type(message) is Status and key == key_expressions.status(name, message.robot):
            if _keep_newest(self.statuses, message):
                self._heard.add(message.robot)
                self._news.state(message.robot, message.state, message.reason)
        elif type(message) is Beacon and key == key_expressions.beacon(name, message.robot):
            self._silent.hear(message)
        elif type(message) is PlantState:
            if message.note and message.healthy and message.obeying:
                self._news.remark(message.robot, message.note)
        elif type(message) is Faults:
            self._held.feed(key, message)
        elif type(message) is Mission or type(message) is Stop or type(message) is Resume:
            self._follow(key, message)

    def _follow(self, key: str, message: Mission | Stop | Resume) -> None:
        if self._known.hear(key, message):
            self._news.order(message)
            if type(message) is Mission and self._known.plan is not None:
                self._reference.take(self._known.plan)
                self._epoch_ns = message.epoch_ns

    def forget(self, robot: int) -> None:
        """What its agent said last does not hold any more: the agent is gone."""
        self.statuses.pop(robot, None)
        self.hands.pop(robot, None)
        self._silent.forget(robot)

    def news(self, time_s: float | None) -> list[str]:
        """Sentences for what was ordered and which robots changed their state since the last call."""
        return self._news.sentences(time_s)

    def states(self) -> dict[int, str]:
        """Every robot's state, "" of one that has said nothing yet."""
        return {
            robot: self.statuses[robot].state if robot in self.statuses else "" for robot in self._fleet.ids
        }

    def members(self, time_s: float | None) -> list[int]:
        """Robots that have a place in the formation at this fleet time."""
        now_ns = self._now_ns(time_s)
        return [robot for robot in self._fleet.ids if self._reference.is_member(robot, now_ns)]

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
        picture.nearest = closest(hand for robot, hand in self.hands.items() if robot not in gone)
        errors: dict[int, float] = {}
        least_m = inf
        for robot, here in self.hands.items():
            for edge in self._reference.edges(robot, now_ns):
                least_m = min(least_m, edge.distance)
                there = self.hands.get(edge.other)
                if there is None or edge.weight < 1.0:
                    continue
                distance = hypot(here.x - there.x, here.y - there.y)
                error = abs(distance - edge.distance)
                errors[robot] = max(error, errors.get(robot, 0.0))
                pair = min(robot, edge.other), max(robot, edge.other)
                if picture.worst is None or error > picture.worst[0]:
                    picture.worst = error, *pair
        if time_s is not None:
            self._heard_s |= dict.fromkeys(self._heard, time_s)
            self._heard.clear()
            picture.silent = self._silent.bodies(removed)
        picture.robots = {
            robot: self._robot(self.statuses.get(robot), errors.get(robot)) for robot in self._fleet.ids
        }
        for robot, about in picture.robots.items():
            silent_s = (time_s or 0.0) - self._heard_s.get(robot, inf)
            if silent_s > SILENT_S:
                carried = ", and its body has been removed" if robot in gone else ""
                about.state, about.reason = "silent", f"has said nothing for {silent_s:.0f} s{carried}"
            place = self._reference.motion(robot, now_ns) if robot in self.hands else None
            if place is not None:
                about.off_m = hypot(self.hands[robot].x - place[0], self.hands[robot].y - place[1])
        if time_s is not None and least_m < inf:
            driving = {
                robot: about.off_m
                for robot, about in picture.robots.items()
                if about.off_m is not None and about.state in DRIVING_NAMES
            }
            picture.lagging = self._lagging.look(time_s, driving, AT_PLACE * least_m)
        return picture

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
            return RobotPicture("", "nothing heard yet", None, 0.0, None, 0)
        limit_us = self._fleet.control.clock_skew_max_s * 1e6
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


def closest(hands: Iterable[HandState]) -> tuple[float, int, int] | None:
    """Distance (m) of the two hands nearest to each other, and the two robots; None without two."""
    found: tuple[float, int, int] | None = None
    least_m = inf
    near: list[HandState] = []
    for here in sorted(hands, key=lambda hand: hand.x):  # all pairs of a large fleet would take too long
        near = [there for there in near if here.x - there.x < least_m]
        for there in near:
            distance_m = hypot(here.x - there.x, here.y - there.y)
            if distance_m < least_m:
                least_m = distance_m
                found = distance_m, min(here.robot, there.robot), max(here.robot, there.robot)
        near.append(here)
    return found


S = TypeVar("S", HandState, Status)


def _keep_newest(known: dict[int, S], message: S) -> bool:
    """Whether the message is newer than the one that was known, whose place it then takes."""
    if message.robot in known and message.time_ns <= known[message.robot].time_ns:
        return False
    known[message.robot] = message
    return True


class View(Speaker, Protocol):
    """Where progress is shown."""

    def show(self, picture: Picture) -> None:
        """The fleet as it is now."""
        ...


def make_view(stream: TextIO | None = None, *, quiet: bool = False, period_s: float = 2.0) -> View:
    """A live table on a terminal; elsewhere plain lines, one for each `period_s` of fleet time.

    When `quiet`, only what `say` is given.
    """
    stream = sys.stderr if stream is None else stream
    if quiet or not stream.isatty():
        return Lines(stream, quiet=quiet, period_s=period_s)
    return Terminal(stream)


class Lines(LinesView):
    """A line now and then."""

    def __init__(self, stream: TextIO, *, quiet: bool, period_s: float) -> None:
        super().__init__(stream)
        self._quiet, self._period_s = quiet, period_s
        self._due_s = 0.0

    def show(self, picture: Picture) -> None:
        if self._quiet or picture.time_s is None or picture.time_s < self._due_s:
            return
        self._due_s = (picture.time_s // self._period_s + 1.0) * self._period_s
        lines = [summary(picture), *in_words(picture.silent), faults_line(picture)]
        self.say(f"{picture.time_s:6.1f} s  {', '.join(filter(None, lines))}")


class Terminal(TerminalView):
    """A table of robots."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream, transient=True)

    def show(self, picture: Picture) -> None:
        lines = [plain(summary(picture)), *(plain(line, "yellow") for line in in_words(picture.silent))]
        if picture.faults:
            lines.append(plain(faults_line(picture), "yellow"))
        self._draw(Group(_bar(picture), *lines, _table(picture)))


def summary(picture: Picture) -> str:
    """One line: worst edge, closest pair, oldest message, and how many robots are in which state."""
    parts = []
    if picture.worst is not None:
        parts.append("worst edge {:.3f} m off ({}-{})".format(*picture.worst))
    if picture.nearest is not None:
        parts.append("closest {:.3f} m ({}-{})".format(*picture.nearest))
    parts.append(f"oldest message {picture.oldest_ms:.0f} ms")
    states: dict[str, list[int]] = {}
    for robot, about in picture.robots.items():
        states.setdefault(about.state or "silent", []).append(robot)
    for state, robots in states.items():
        shown = [str(robot) for robot in robots]
        if state == State.RELEASED.value and len(robots) <= REASONS_MAX:
            shown = [f"{robot} ({picture.robots[robot].reason})" for robot in robots]
        elif len(states) == 1:
            shown = []
        parts.append(f"{state}: {', '.join(shown)}" if shown else f"all {state}")
    if picture.lagging:
        parts.append(f"off place: {_lags(picture)}")
    # Both of a pair see it: the one whose clock is behind says it.
    ahead = {robot: about for robot, about in picture.robots.items() if about.clock and about.clock[1] > 0.0}
    if ahead:
        robot, about = max(ahead.items(), key=lambda item: item[1].clock[1] if item[1].clock else 0.0)
        parts.append(f"{_clock(about)} of robot {robot}'s")
    return ", ".join(parts)


def _lags(picture: Picture) -> str:
    """Who lags, how far each is from its place, and what it says of that; of many only the numbers."""
    robots = {robot: picture.robots[robot] for robot in picture.lagging}
    silent_s = {f"robot {body.robot}": body.silent_s for body in picture.silent}

    def why(about: RobotPicture) -> str:
        named = _LAST_NAME.search(about.reason)
        since_s = silent_s.get(named[0]) if named else None
        return about.reason + (f", silent for {since_s:.0f} s" if since_s is not None else "")

    if len(robots) > REASONS_MAX:
        most_m = max(about.off_m or 0.0 for about in robots.values())
        return f"{some(sorted(robots))} by up to {most_m:.2f} m"
    return ", ".join(
        f"{robot} by {about.off_m:.2f} m" + (f" ({why(about)})" if about.reason else "")
        for robot, about in robots.items()
    )


def faults_line(picture: Picture) -> str:
    """The faults that hold now on one line, empty without any."""
    if not picture.faults:
        return ""
    more = len(picture.faults) - FAULTS_MAX
    named = "; ".join(picture.faults[:FAULTS_MAX])
    return f"faults: {named}" + (f"; and {more} more" if more > 0 else "")


def _clock(about: RobotPicture) -> str:
    if about.clock is None:
        return ""
    robot, ahead_s = about.clock
    return f"clock of robot {robot} {abs(ahead_s) * 1e3:.0f} ms {'ahead' if ahead_s > 0 else 'behind'}"


def _bar(picture: Picture) -> Progress:
    progress = Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=None), TextColumn("{task.fields[clock]}")
    )
    now = max(0.0, picture.time_s or 0.0)
    what = "starting" if picture.time_s is None else "driving"
    clock = f"{now:5.1f} of {picture.duration_s:.0f} s"
    task = progress.add_task(what, total=picture.duration_s, clock=clock)
    progress.update(task, completed=min(now, picture.duration_s))
    return progress


def _table(picture: Picture) -> Table:
    table = Table(expand=True, pad_edge=False, box=None)
    for heading in ("robot", "state", "worst edge m", "off place m", "oldest ms", "tick us", "missed"):
        table.add_column(heading, justify="left" if heading == "state" else "right", no_wrap=True)
    table.add_column("why", ratio=1, no_wrap=True, overflow="ellipsis")
    rows = sorted(picture.robots.items(), key=lambda item: (item[1].state == State.RUNNING.value, item[0]))
    if len(rows) <= ROWS_MAX:
        rows.sort(key=lambda item: item[0])
    for robot, about in rows[:ROWS_MAX]:
        table.add_row(
            str(robot),
            plain(about.state or "-", STYLES.get(about.state, "")),
            "-" if about.error_m is None else f"{about.error_m:.3f}",
            "-" if about.off_m is None else f"{about.off_m:.2f}",
            f"{about.age_ms:.0f}",
            "-" if about.tick_us is None else str(about.tick_us),
            str(about.overruns),
            plain("; ".join(filter(None, (about.reason, _clock(about))))),
        )
    if len(rows) > ROWS_MAX:
        table.add_row("...", f"and {len(rows) - ROWS_MAX} more", "", "", "", "", "", "")
    return table


def fleet_time_s(now_ns: int, epoch_ns: int | None) -> float | None:
    """Seconds since the epoch, None before it is set."""
    return None if epoch_ns is None else (now_ns - epoch_ns) / NS_PER_S
