"""What Foxglove is given of a fleet: derived from its messages, for a recording and for live viewers alike
(PURE)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
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
)
from handfast.agent.supervision.status import status_hz
from handfast.deploy.recording.foxglove import scene
from handfast.deploy.recording.foxglove.diagnostics import diagnostics
from handfast.deploy.recording.foxglove.json_text import stamped
from handfast.deploy.recording.foxglove.log import Log
from handfast.deploy.recording.foxglove.moment import SILENT_NS, Latest
from handfast.deploy.recording.foxglove.plots import plots
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
