"""Channels for Foxglove, derived from a fleet's messages, in a recording and for live viewers alike (PURE).

Besides the scene (`deploy.recording.foxglove.scene`): the fleet in numbers for the Plot panel, the state of
every robot and its reason for the Diagnostics panels, and events for the Log panel.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from math import dist
from typing import Final

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
    EVERY_AUTHOR,
    Beacon,
    Event,
    Faults,
    HandState,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    clipped,
)
from handfast.agent.supervision.state_machine import State, status_hz
from handfast.deploy.console.wording import robots
from handfast.deploy.recording.foxglove import scene
from handfast.deploy.recording.foxglove.json_text import STAMP, dumps, stamped
from handfast.deploy.recording.foxglove.moment import SILENT_NS, Latest, Moment
from handfast.deploy.recording.foxglove.schemas import (
    DIAGNOSTICS,
    EDGES,
    GROUND,
    LOG,
    PLACES,
    PLOTS,
    POSES,
    ROBOTS,
    SILENT,
    TOPICS,
)

_PLOTS: Final = '{%s,"robots":[%s],"edges":[%s]}'
_ROBOT: Final = "{%s}"
_EDGE: Final = '{"label":"%d-%d","error_m":%.4f}'


def plots(moment: Moment, statuses: Mapping[int, Status], safe_m: float) -> str:
    """The content of the topic: units as in its schema, what is not known left out."""
    errors = [(link.i, link.j, link.distance - link.wanted) for link in moment.links if link.counts]
    head = f'"safe_distance_m":{safe_m:.4f}'
    if moment.least is not None:
        head += f',"least_distance_m":{moment.least[0]:.4f}'
    if moment.place_errors:
        head += f',"worst_place_error_m":{max(moment.place_errors.values()):.4f}'
    if errors:
        head += f',"worst_edge_error_m":{max(abs(error) for _, _, error in errors):.4f}'
    robots = []
    for body in moment.bodies:
        robot = body.robot
        row = f'"label":"robot {robot}","id":{robot},"speed_m_s":{body.speed:.3f}'
        place_error, nearest = moment.place_errors.get(robot), moment.nearest.get(robot)
        if place_error is not None:
            row += f',"place_error_m":{place_error:.4f}'
        if nearest is not None:
            row += f',"nearest_m":{nearest:.4f}'
        status = statuses.get(robot)
        if status is not None:
            if status.neighbours:
                row += f',"age_ms":{max(each[1] for each in status.neighbours) / 1e3:.1f}'
            if status.tick_us:
                row += f',"tick_us":{max(status.tick_us)}'
        robots.append(row)
    edges = [_EDGE % error for error in errors]
    return _PLOTS % (head, ",".join([_ROBOT % row for row in robots]), ",".join(edges))


OK, WARN, ERROR, STALE = range(4)
"""Levels of a DiagnosticStatus."""
LEVELS: Final[Mapping[str, int]] = {
    State.RUNNING.value: OK,
    State.DEGRADED.value: WARN,
    State.HOLDING.value: WARN,
    State.RELEASED.value: WARN,
    State.FAULT.value: ERROR,
    State.STOPPING.value: OK,
    State.STOPPED.value: OK,
    State.WAITING.value: OK,
    State.READY.value: OK,
    State.STANDBY.value: OK,
}
"""Of each state, as the page and the film have it (`deploy.playback.looks`): what troubles a robot that is to
drive is a warning, a fault an error, rest and waiting are fine."""


def level_of(state: str) -> int:
    """The level of a state; of one that is not known here, `WARN`."""
    return LEVELS.get(state, WARN)


def in_short(status: Status) -> str:
    """A robot's state, and why it is in it."""
    return f"{status.state}: {status.reason}" if status.reason else status.state


def diagnostics(
    statuses: Mapping[int, Status], plants: Mapping[int, PlantState], silent: Collection[int]
) -> str:
    """The content of the topic, with `STAMP` for its time.

    Args:
        statuses, plants: the last of every robot that has said one.
        silent: robots whose agents are not heard.
    """
    rows = []
    for robot, status in sorted(statuses.items()):
        plant = plants.get(robot)
        body = "not heard" if plant is None else plant.note or ("drives" if plant.driving else "brakes")
        values = {
            "body": body,
            "mission": str(status.mission_version),
            "missed ticks": str(dict(status.counters).get("overruns", 0)),
        }
        rows.append(
            {
                "level": STALE if robot in silent else level_of(status.state),
                "name": "agent",
                "message": f"not heard, was {in_short(status)}" if robot in silent else in_short(status),
                "hardware_id": f"robot {robot}",
                "values": [{"key": key, "value": value} for key, value in values.items()],
            }
        )
    return '{"header":{"stamp":' + STAMP + ',"frame_id":""},"status":' + dumps(rows) + "}"


_INFO, _WARNING, _ERROR = 2, 3, 4
_LEVELS: Final = {WARN: _WARNING, ERROR: _ERROR}
_WORDS: Final = {"kill": "killed", "start": "started", "stop": "paused", "continue": "continued"}
_LINE: Final = '{"timestamp":' + STAMP + ',"level":%d,"message":%s,"name":%s,"file":"","line":0}'
_APART: Final = 1.05
"""Two robots that were too close are apart again at this multiple of the safe distance: at it, noise would
part them again and again."""


class Log:
    """Makes lines of what is heard, each order, fault and violation once.

    Attributes:
        lines: their contents, with `STAMP` for the time, until somebody takes them away.
    """

    def __init__(self, safe_m: float) -> None:
        self._safe_m = safe_m
        self.lines: list[str] = []
        self._order = -1
        self._faults: dict[str, int] = {}
        self._close: dict[tuple[int, int], float] = {}

    def status(self, status: Status) -> None:
        """A robot has come to another state."""
        level = _LEVELS.get(level_of(status.state), _INFO)
        self._add(level, f"robot {status.robot}", in_short(status))

    def silent(self, robot: int) -> None:
        """A robot's agent is not heard any more."""
        self._add(_WARNING, f"robot {robot}", "not heard")

    def heard(self, robot: int) -> None:
        """It is heard again."""
        self._add(_INFO, f"robot {robot}", "heard again")

    def mission(self, mission: Mission) -> None:
        """Takes a mission that is newer than those before."""
        text = mission.note or f"a drive of {mission.duration_ns / NS_PER_S:g} s"
        self._add(_INFO, "operator", f"mission: {text}")

    def order(self, order: Stop | Resume) -> None:
        """Takes a stop or a resume, again and again."""
        if order.version <= self._order:
            return
        self._order = order.version
        if type(order) is Stop:
            self._add(_WARNING, "operator", "stop" + (f": {order.reason}" if order.reason else ""))
        elif type(order) is Resume:
            who = robots(order.robots) if order.robots else "all robots"
            self._add(_INFO, "operator", f"resume: {who}")

    def faults(self, faults: Faults) -> None:
        """Takes an author's live fault rules, again and again."""
        known = self._faults.get(faults.author)
        if not faults.rules if known is None else faults.version <= known:
            return
        self._faults[faults.author] = faults.version
        if faults.rules:
            rules = clipped(" ".join(faults.rules.split()))
            self._add(_WARNING, "faults", f"live faults of {faults.author}: {rules}")
        else:
            whose = "all live faults" if faults.author == EVERY_AUTHOR else f"live faults of {faults.author}"
            self._add(_INFO, "faults", f"{whose} are cleared")

    def event(self, event: Event) -> None:
        """Takes what was done to a process on purpose."""
        text = f"{event.role} of robot {event.robot} {_WORDS[event.what]}"
        self._add(_WARNING, "faults", f"{text} ({event.rule})" if event.rule else text)

    def distances(self, close: Mapping[tuple[int, int], float], hands: Mapping[int, Vector]) -> None:
        """Takes the pairs that are closer than the safe distance now."""
        for pair, distance in close.items():
            if pair not in self._close:
                apart = f"{robots(pair)} are {distance:.3f} m apart"
                self._add(_ERROR, "safety", f"{apart}, less than the safe distance of {self._safe_m:.3f} m")
            self._close[pair] = min(distance, self._close.get(pair, distance))
        for pair in [pair for pair in self._close if pair not in close]:
            here, there = (hands.get(robot) for robot in pair)
            if here is None or there is None:  # its body has been carried off
                del self._close[pair]
            elif dist(here, there) > _APART * self._safe_m:
                least_m = self._close.pop(pair)
                self._add(_INFO, "safety", f"{robots(pair)} are apart again; they were {least_m:.3f} m apart")

    def _add(self, level: int, name: str, message: str) -> None:
        self.lines.append(_LINE % (level, dumps(message), dumps(name)))


PERIOD_NS: Final = 100_000_000
"""Between two pictures, and so between two messages of one topic, at least; but for the log's."""
DIAGNOSTICS_NS: Final = NS_PER_S
"""Between two diagnostics in which no robot's state has changed."""
REPEAT_NS: Final = NS_PER_S
"""Plots that stay as they are are sent again so often: a plot joins its points by straight lines."""
_SILENT_STATUSES: Final = 4.0
"""An agent is silent that has said nothing in so many of the times in which it tells its status."""

Derived = tuple[str, str, bytes]
"""Topic, name of its schema, JSON."""
_Take = Callable[[int, int, Message], None]


class Channels:
    """Takes a fleet's messages as they come and says, ten times a second at most, what Foxglove shall show.

    What does not change is not said again.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._latest = Latest(fleet)
        self._log = Log(self._latest.safe_m)
        self._statuses: dict[int, Status] = {}
        self._heard_ns: dict[int, int] = {}
        self._plants: dict[int, PlantState] = {}
        self._silent: set[int] = set()
        self._silent_ns = max(SILENT_NS, round(_SILENT_STATUSES / status_hz(len(fleet.robots)) * NS_PER_S))
        self._has_changed = False
        self._diagnosed_ns = -DIAGNOSTICS_NS
        self._next_ns: int | None = None
        self._sent: dict[str, tuple[int, str]] = {}
        name = fleet.fleet.name
        self._takes: dict[str, tuple[int, _Take]] = {
            key_expressions.mission(name): (0, self._take_order),
            key_expressions.stop(name): (0, self._take_order),
            key_expressions.resume(name): (0, self._take_order),
            key_expressions.faults(name): (0, self._take_faults),
            key_expressions.events(name): (0, self._take_faults),
        }
        for robot in fleet.ids:
            self._takes |= {
                key_expressions.plant_state(name, robot): (robot, self._take_plant),
                key_expressions.plant_truth(name, robot): (robot, self._take_truth),
                key_expressions.hand(name, robot): (robot, self._take_hand),
                key_expressions.beacon(name, robot): (robot, self._take_hand),
                key_expressions.status(name, robot): (robot, self._take_status),
                key_expressions.relayed(name, robot): (robot, self._take_order),
            } | {
                key_expressions.faults_held(name, robot, role): (robot, self._take_faults)
                for role in key_expressions.ROLES
            }

    def feed(self, now_ns: int, key: str, message: Message) -> Sequence[Derived]:
        """Takes a message that came on `key`; gives what is to be shown from now on.

        A message on another robot's key, or on one that is not the fleet's, changes nothing.

        Args:
            now_ns: when it came, wall clock or virtual time.
        """
        known = self._takes.get(key)
        if known is None:
            return ()
        robot, take = known
        take(now_ns, robot, message)
        next_ns = self._next_ns
        # A clock that was set back must not end the pictures until it is where it was.
        if next_ns is None or now_ns >= next_ns or now_ns < next_ns - PERIOD_NS:
            return self._picture(now_ns)
        return self._lines(now_ns) if self._log.lines else ()

    # --- what is heard

    def _take_plant(self, now_ns: int, robot: int, message: Message) -> None:
        if type(message) is PlantState and message.robot == robot:
            self._plants[robot] = message
            self._latest.take_plant(now_ns, message)

    def _take_truth(self, now_ns: int, robot: int, message: Message) -> None:
        if type(message) is PlantState and message.robot == robot:
            self._latest.take_truth(now_ns, message)

    def _take_hand(self, now_ns: int, robot: int, message: Message) -> None:
        if isinstance(message, (HandState, Beacon)) and message.robot == robot:
            self._latest.take_hand(now_ns, message)

    def _take_status(self, now_ns: int, robot: int, message: Message) -> None:
        if type(message) is not Status or message.robot != robot:
            return
        known = self._statuses.get(robot)
        self._statuses[robot] = message
        self._heard_ns[robot] = now_ns
        if robot in self._silent:
            self._silent.discard(robot)
            self._log.heard(robot)
            self._has_changed = True
        if known is None or known.state != message.state:  # reasons hold numbers that change all the time
            self._has_changed = True
            self._log.status(message)

    def _take_order(self, now_ns: int, robot: int, message: Message) -> None:
        if type(message) is Mission:
            if self._latest.take_mission(message):
                self._log.mission(message)
        elif type(message) is Stop or type(message) is Resume:
            self._log.order(message)

    def _take_faults(self, now_ns: int, robot: int, message: Message) -> None:
        if type(message) is Faults:
            self._log.faults(message)
        elif type(message) is Event:
            self._log.event(message)

    # --- what is shown

    def _picture(self, now_ns: int) -> list[Derived]:
        is_first = self._next_ns is None
        self._next_ns = now_ns - now_ns % PERIOD_NS + PERIOD_NS
        safe_m, moment = self._latest.safe_m, self._latest.at(now_ns)
        self._note_silent(now_ns)
        self._log.distances(moment.close, moment.hands)
        contents = []
        if is_first:
            contents.append((ROBOTS, scene.robots(self._fleet)))
            ground = scene.ground(self._fleet)
            contents += [] if ground is None else [(GROUND, ground)]
        if moment.bodies:
            contents += [
                (POSES, scene.poses(moment)),
                (PLACES, scene.places(moment, safe_m)),
                (EDGES, scene.edges(moment, safe_m)),
                (PLOTS, plots(moment, self._statuses, safe_m)),
            ]
        if moment.believed or SILENT in self._sent:
            contents.append((SILENT, scene.silent(moment)))
        if self._statuses and (self._has_changed or not 0 <= now_ns - self._diagnosed_ns < DIAGNOSTICS_NS):
            self._has_changed, self._diagnosed_ns = False, now_ns
            contents.append((DIAGNOSTICS, diagnostics(self._statuses, self._plants, self._silent)))
        derived = []
        for topic, content in contents:
            sent_ns, sent = self._sent.get(topic, (now_ns, None))
            if content != sent or (topic == PLOTS and not 0 <= now_ns - sent_ns < REPEAT_NS):
                self._sent[topic] = now_ns, content
                derived.append((topic, TOPICS[topic], stamped(content, now_ns)))
        return derived + self._lines(now_ns)

    def _note_silent(self, now_ns: int) -> None:
        for robot, heard_ns in self._heard_ns.items():
            if now_ns - heard_ns > self._silent_ns and robot not in self._silent:
                self._silent.add(robot)
                self._log.silent(robot)
                self._has_changed = True

    def _lines(self, now_ns: int) -> list[Derived]:
        lines, self._log.lines = self._log.lines, []
        return [(LOG, TOPICS[LOG], stamped(line, now_ns)) for line in lines]
