"""A running fleet as pages see it: what it is, where it is, what happened, and what it has driven so far."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Sequence
from math import nan
from typing import Any, Final, cast

import numpy as np

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message
from handfast.agent.transport.bus import Bus
from handfast.deploy.drive.attached import Attached
from handfast.deploy.drive.fleet_state import FleetState
from handfast.deploy.drive.preconditions import clock, why
from handfast.deploy.drive.watch import Picture, fleet_time_s
from handfast.deploy.playback.marks import FAULT, SILENT, VIOLATION, Mark
from handfast.deploy.playback.scene import COLUMNS, ground
from handfast.deploy.session.session import valid
from handfast.deploy.view.motion import Motion

BYTES_MAX: Final = 16_000_000
"""Some ten minutes of 6 robots in full; what is longer is thinned."""


class History:
    """Rows of numbers over time: all of them, or, when these would be too many, every second, fourth, ...

    Args:
        width: numbers of a row.
        bytes_max: the most that all rows take, float32.
    """

    def __init__(self, width: int, bytes_max: int = BYTES_MAX) -> None:
        self._most = max(2, bytes_max // (4 * (width + 1)))
        self._rows = np.empty((min(self._most, 1024), width + 1), dtype="<f4")
        self._count = self._offered = 0
        self.stride = 1
        """Every so many rows that were offered, one is kept."""

    def __len__(self) -> int:
        return self._count

    def add(self, t_s: float, row: Floats) -> None:
        """Takes a row (width,) and its time, s; times ascend."""
        self._offered += 1
        if (self._offered - 1) % self.stride:
            return
        if self._count == self._most:
            self._thin()
            if (self._offered - 1) % self.stride:
                return
        if self._count == len(self._rows):
            more = np.empty((min(self._most, 2 * self._count), self._rows.shape[1]), dtype="<f4")
            more[: self._count] = self._rows[: self._count]
            self._rows = more
        self._rows[self._count, 0] = t_s
        self._rows[self._count, 1:] = row
        self._count += 1

    def _thin(self) -> None:
        kept = self._rows[: self._count : 2].copy()
        self._rows[: len(kept)] = kept
        self._count = len(kept)
        self.stride *= 2

    def clear(self) -> None:
        """Another drive begins."""
        self._count = self._offered = 0
        self.stride = 1

    def content(self) -> bytes:
        """All rows as little-endian float32, the time (s) before each."""
        return self._rows[: self._count].tobytes()


FRAME_NS: Final = NS_PER_S // 20
PANEL_NS: Final = NS_PER_S // 2
"""What changes slowly, or costs more, is said so often."""
EVENTS_MAX: Final = 5000
"""Of one drive; of more the latest are left out, and that is said."""
APART: Final = 1.02
"""Two that were too near are apart again at so many times the safe distance: else each wobble is a mark."""
FORCE_COLUMNS: Final = 4
"""The last columns of a row, which only those get who want them."""
HEAD: Final = struct.Struct("<ddII")
"""Before the numbers of a frame: fleet time (s, NaN before there is a mission), when it was made (s, wall
clock), its number, columns of a robot."""
HISTORY_COLUMNS: Final = 0
"""Of the frame that is none, but all rows until now."""
HANDS_INBOX: Final = 4096
BLEND_NS: Final = NS_PER_S // 5
"""How often edges are said while they change all the time."""
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?")
_AT: Final = re.compile(r"-?\d+\.\d s: ")
_BODIES: Final = ("/plant/state", "/plant/truth")
_UNWANTED: Final = ("/plant/wrench", "/links")


class LiveFleet:
    """`fleet` (resolved, as its robots read it), seen over a bus that is connected to all its processes.

    Logs grow within a drive: `events` (marks), `states` ([time, index, state, why]) and `edges` ([time,
    edges]). Parts are replaced: by name their version and JSON text. A new drive has another `drive` number.
    `listeners` are told of everything that comes: time of reception (ns), key, message.
    """

    def __init__(self, fleet: Fleet, bus: Bus) -> None:
        self.fleet: Final = fleet
        self.listeners: Final[list[Callable[[int, str, Message], None]]] = []
        self._bus, self._hears_hands = bus, fleet.is_routed
        self.fleet_state: Final = FleetState(
            fleet, cast("Bus", _NewestBodies(bus)), Attached(fleet), self._take, _heard_of(fleet)
        )
        self.watch: Final = self.fleet_state.watch
        self.motion: Final = Motion(fleet, self.watch)
        self.history: Final = History(len(fleet.ids) * (len(COLUMNS) - FORCE_COLUMNS))
        self.drive = 0
        self.number = 0
        self.logs: Final[dict[str, list[Any]]] = {"events": [], "states": [], "edges": []}
        self.parts: Final[dict[str, tuple[int, str]]] = {}
        self._states: dict[int, tuple[str, str]] = {}
        self._faults: set[str] = set()
        self._near: set[tuple[int, int]] = set()
        self._edges: list[list[float]] = []
        self._edges_of: Any = None
        self._edges_due_ns = 0
        self._rows = self.motion.rows
        self._made_s = 0.0
        self._panel_due_ns = 0
        self.t_s: float | None = None
        """Fleet time of the last frame, None before there is a mission."""
        about = {"frame_columns": len(COLUMNS) - FORCE_COLUMNS, "rate_hz": float(fleet.fleet.rate_hz)}
        self.put("scene", ground(fleet) | about)

    def _take(self, now_ns: int, key: str, payload: bytes) -> Message | None:
        message = None if key.endswith(_UNWANTED) else valid(payload)
        if message is not None:
            self.motion.feed(now_ns, key, message)
            for listener in self.listeners:
                listener(now_ns, key, message)
        return message

    # ------------------------------------------------------------------ every frame

    def step(self) -> None:
        """Takes what came, and makes the next frame."""
        state = self.fleet_state
        state.collect()
        self._follow_drive()
        now_ns = state.clock.now_ns()
        self.t_s = state.time_s
        before = set(state.present)
        for text in state.look():
            self._event(FAULT, _AT.sub("", text, count=1))
        for robot, role in before - state.present:
            if role == "plant":
                self.motion.forget(robot)
        for each in self.watch.happenings(self.t_s):
            self._event(each.kind, each.text, each.robots, each.time_ns)
        self._rows = self.motion.look(now_ns, self.t_s)
        self._made_s = now_ns / NS_PER_S
        self.number += 1
        if self.t_s is not None and self.t_s >= 0.0:
            self.history.add(self.t_s, self._rows[:, :-FORCE_COLUMNS].reshape(-1))
        self._look_for_near()
        self._look_at_edges(now_ns)
        self._look_at_states()
        if now_ns >= self._panel_due_ns:
            self._panel_due_ns = now_ns + PANEL_NS
            self._panel(now_ns)

    def _follow_drive(self) -> None:
        """Goes by the newest mission; one of another epoch begins another drive."""
        mission = self.fleet_state.operator.mission
        if mission is None or mission.epoch_ns == self.fleet_state.epoch_ns:
            return
        self.fleet_state.epoch_ns = mission.epoch_ns
        self.drive += 1
        self.history.clear()
        for log in self.logs.values():
            log.clear()
        self._states.clear()
        self._faults.clear()
        self._near.clear()
        self._edges_of = None

    def _event(self, kind: str, text: str, robots: Sequence[int] = (), time_ns: int = 0) -> None:
        """Notes what happened, at a time of the wall clock, 0: now."""
        events = self.logs["events"]
        if len(events) == EVENTS_MAX:
            text, robots = "more happened than is kept here", ()
        if len(events) <= EVENTS_MAX:
            t_s = 0.0 if self.t_s is None else self.t_s
            if time_ns:  # what was ordered before anybody looked from here is heard only now
                t_s = min(t_s, fleet_time_s(time_ns, self.fleet_state.epoch_ns) or 0.0)
            t_s = round(t_s, 3)
            events.append(Mark(t_s, None, kind, text, tuple(robots))._asdict())

    def _look_for_near(self) -> None:
        safe_m = self.fleet.formation.safe_distance_m
        near = {(i, j): distance_m for distance_m, i, j in self.motion.near(safe_m * APART)}
        for (i, j), distance_m in near.items():
            if distance_m < safe_m and (i, j) not in self._near:
                self._near.add((i, j))
                text = f"robots {i} and {j} {distance_m:.3f} m apart, less than the safe distance"
                self._event(VIOLATION, f"{text} of {safe_m:.3f} m", (i, j))
        self._near &= near.keys()

    def _look_at_edges(self, now_ns: int) -> None:
        """Says what edges there are when that changes: with a mission, and as long as it blends."""
        plan = self.fleet_state.operator.plan
        is_blending = plan is not None and now_ns < plan.from_ns + plan.mission.blend_ns + NS_PER_S
        is_due = now_ns >= self._edges_due_ns if is_blending else plan is not self._edges_of
        if not is_due and self.logs["edges"]:
            return
        self._edges_due_ns = now_ns + BLEND_NS
        self._edges_of = plan
        edges = self.motion.edges(self.t_s)
        if edges != self._edges or not self.logs["edges"]:
            self._edges = edges
            self.logs["edges"].append([0.0 if self.t_s is None else round(self.t_s, 3), edges])

    def _look_at_states(self) -> None:
        for index, (robot, status) in enumerate(
            (robot, self.watch.statuses.get(robot)) for robot in self.fleet.ids
        ):
            known = self._states.get(robot)
            if status is not None and (known is None or known[0] != SILENT):
                self._state(index, robot, status.state, status.reason)

    def _state(self, index: int, robot: int, state: str, reason: str) -> None:
        # A reason that counts seconds would be another one with every status.
        known = state, _NUMBER.sub("#", reason)
        if self._states.get(robot) != known:
            self._states[robot] = known
            t_s = -1e9 if self.t_s is None else round(self.t_s, 3)
            self.logs["states"].append([t_s, index, state, reason])

    # ------------------------------------------------------------------ now and then

    def put(self, name: str, content: Any) -> None:
        """Replaces a part, where it has changed."""
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        version, before = self.parts.get(name, (0, ""))
        if text != before:
            self.parts[name] = version + 1, text

    def _panel(self, now_ns: int) -> None:
        picture = self.watch.picture(self.t_s)
        for index, robot in enumerate(self.fleet.ids):
            about = picture.robots[robot]
            is_away = (robot, "agent") not in self.fleet_state.present
            if about.state == SILENT or is_away:
                why_not = about.reason if about.state == SILENT else "no connection to its agent"
                self._state(index, robot, SILENT, why_not)
            elif about.state:
                self._state(index, robot, about.state, about.reason)
        for text in picture.faults:
            if text not in self._faults:
                self._event(FAULT, text)
        self._faults = set(picture.faults)
        self.put("panel", self._about(now_ns, picture))
        self.put("links", self._links())

    def _about(self, now_ns: int, picture: Picture) -> dict[str, Any]:
        state, operator = self.fleet_state, self.fleet_state.operator
        mission, stop = operator.mission, operator.stop_in_force
        return {
            "duration_s": picture.duration_s,
            "mission": None if mission is None else mission.note,
            "stop": None if stop is None else f"stopped at {clock(stop.time_ns, now_ns)}{why(stop)}",
            "members": state.members,
            "present": [len(state.present), state.processes.count],
            "lacking": {"mission": state.without_mission, "order": state.without_order},
            "other_file": state.on_other_file,
            "faults": list(picture.faults),
            "silent": [body.row for body in picture.silent],
            "why": {
                str(robot): [about.state, about.reason]
                for robot, about in picture.robots.items()
                if about.reason and about.state == self._states.get(robot, ("", ""))[0]
            },
            "checks": {
                str(robot): [list(line) for line in state.checks.lines(robot)]
                for robot in state.checks.robots
            },
            "notes": {str(robot): plant.note for robot, plant in state.states.items() if plant.note},
        }

    def _links(self) -> list[list[int]]:
        """Of each link: robots that say and hear, age of the newest hand state (ms, -1: none ever), how many
        came and were lost, by how much the clock of who says is ahead (ms)."""
        return [
            [
                *(each.robot, robot, -1 if each.age_us < 0 else each.age_us // 1000),
                *(each.received, each.lost, each.offset_us // 1000),
            ]
            for robot, status in sorted(self.watch.statuses.items())
            for each in status.neighbours
        ]

    # ------------------------------------------------------------------ what is sent

    def frame(self, *, forces: bool) -> bytes:
        """The newest frame: `HEAD`, and the rows as little-endian float32."""
        columns = len(COLUMNS) - (0 if forces else FORCE_COLUMNS)
        head = HEAD.pack(nan if self.t_s is None else self.t_s, self._made_s, self.number, columns)
        return head + self._rows[:, :columns].tobytes()

    def until_now(self) -> bytes:
        """All rows of this drive until now: `HEAD`, and `deploy.view.history.History.content`."""
        return HEAD.pack(nan, self._made_s, self.history.stride, HISTORY_COLUMNS) + self.history.content()

    def want_forces(self) -> None:
        """From now on hand states are heard, which tell them."""
        if not self._hears_hands:
            self._hears_hands = True
            self._bus.subscribe(key_expressions.hand(self.fleet.fleet.name, "*"), HANDS_INBOX)


class _NewestBodies:
    """A bus of whose bodies only the newest states are drained: they say all that is shown, and are read last
    and often."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def drain(self) -> list[tuple[str, bytes]]:
        """As of a bus."""
        bodies: dict[str, bytes] = {}
        rest = []
        for key, payload in self._bus.drain():
            if key.endswith(_BODIES):
                bodies[key] = payload
            else:
                rest.append((key, payload))
        return [*rest, *bodies.items()]


def _heard_of(fleet: Fleet) -> list[str]:
    """The keys that a page needs. Each robot's hand states would be as much again as all the rest; through
    routers nothing else says where robots are."""
    name = fleet.fleet.name
    if fleet.is_routed:
        return [key_expressions.everything(name)]
    of_operators = (key_expressions.mission, key_expressions.stop, key_expressions.resume)
    of_robots = (
        key_expressions.status,
        key_expressions.plant_state,
        key_expressions.plant_truth,
        key_expressions.beacon,
        key_expressions.checks,
        key_expressions.status_texts,
        key_expressions.relayed,
    )
    return [
        *(key(name) for key in of_operators),
        *(key(name, "*") for key in of_robots),
        *(key_expressions.faults_held(name, "*", role) for role in key_expressions.ROLES),
    ]
