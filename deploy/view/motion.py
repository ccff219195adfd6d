"""Where the robots of a running fleet are, as one row of numbers, from what they say (PURE)."""

from __future__ import annotations

from math import atan2, cos, hypot, nan, sin
from typing import Final

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.points import Floats
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import HandState, Message, PlantState, Status
from handfast.deploy.drive.watch import Watch
from handfast.deploy.playback.scene import COLUMNS

_AT: Final = {name: index for index, name in enumerate(COLUMNS)}
_FORCES: Final = _AT["navigation_x"]
_OF_AGENT: Final = _AT["age_ms"]
SILENT_NS: Final = 2_000_000_000
"""A body that was not heard of for so long is nowhere, and what its agent said so long ago is not so any
more: what is believed of it is said otherwise."""
MOVING_M_S: Final = 0.01
PLACE_DIGITS: Final = 3
"""Wanted distances are told to so many places, m."""


class Motion:
    """Keeps the newest of each robot in `rows`, (n, columns of `deploy.playback.track`), float32."""

    def __init__(self, fleet: Fleet, watch: Watch) -> None:
        self._watch = watch
        self._ids = fleet.ids
        self._hand_m = {robot.id: robot.hand_offset_m for robot in fleet.robots}
        self._index = {robot: index for index, robot in enumerate(fleet.ids)}
        self.rows: Final = np.full((len(fleet.ids), len(COLUMNS)), np.nan, dtype="<f4")
        self._seen_ns = np.zeros(len(fleet.ids), dtype=np.int64)
        self._heard_ns = np.zeros(len(fleet.ids), dtype=np.int64)
        """When there was something of each body, and of each agent."""
        name = fleet.fleet.name
        self._truth_keys = {key_expressions.plant_truth(name, robot): robot for robot in fleet.ids}
        self._plant_keys = {key_expressions.plant_state(name, robot): robot for robot in fleet.ids}
        self._hand_keys = {key_expressions.hand(name, robot): robot for robot in fleet.ids}
        self._status_keys = {key_expressions.status(name, robot): robot for robot in fleet.ids}
        self._with_truth: set[int] = set()
        self._with_body: set[int] = set()
        """Robots whose bodies are heard of: routers pass only on what agents say."""

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes a message that came on `key` at a time (ns, wall clock); one on another robot's key is
        ignored."""
        if type(message) is PlantState:
            robot = self._truth_keys.get(key)
            if robot is not None:
                self._with_truth.add(robot)  # where it really is; what it measures is another thing
            elif (robot := self._plant_keys.get(key)) is None or robot in self._with_truth:
                return
            if message.robot == robot:
                self._with_body.add(robot)
                if message.healthy:
                    self._place(now_ns, robot, message)
        elif type(message) is HandState and self._hand_keys.get(key) == message.robot:
            self._of_agent(now_ns, message.robot)[_FORCES:] = (
                message.navigation_x, message.navigation_y, message.constraint_x, message.constraint_y,
            )  # fmt: skip
            if message.robot not in self._with_body:
                self._place_hand(now_ns, message)
        elif type(message) is Status and self._status_keys.get(key) == message.robot:
            row = self._of_agent(now_ns, message.robot)
            row[_AT["age_ms"]] = max(message.ages_us, default=nan) / 1e3
            row[_AT["tick_us"]] = max(message.tick_us, default=nan)

    def _of_agent(self, now_ns: int, robot: int) -> Floats:
        """The row of a robot whose agent says something."""
        index = self._index[robot]
        self._heard_ns[index] = now_ns
        row: Floats = self.rows[index]
        return row

    def _place(self, now_ns: int, robot: int, body: PlantState) -> None:
        """Takes where a body is; its hand point is ahead of it (eq. 2)."""
        index, offset_m = self._index[robot], self._hand_m[robot]
        self._seen_ns[index] = now_ns
        self.rows[index, :4] = (
            body.x + offset_m * cos(body.heading),
            body.y + offset_m * sin(body.heading),
            body.heading,
            body.speed,
        )

    def _place_hand(self, now_ns: int, hand: HandState) -> None:
        """Takes where a hand is; its body heads the way that it moves, as long as it does."""
        index, speed = self._index[hand.robot], hypot(hand.vx, hand.vy)
        self._seen_ns[index] = now_ns
        heading = atan2(hand.vy, hand.vx) if speed > MOVING_M_S else self.rows[index, _AT["heading"]]
        self.rows[index, :4] = hand.x, hand.y, heading, speed

    def forget(self, robot: int) -> None:
        """There is no connection to a robot any more."""
        self.rows[self._index[robot]] = nan

    def look(self, now_ns: int, time_s: float | None) -> Floats:
        """The rows now, with where each robot should be; NaN of those that are not heard."""
        for robot, index in self._index.items():
            place = self._watch.place(robot, time_s)
            self.rows[index, 4:6] = (nan, nan) if place is None else place
        self.rows[now_ns - self._seen_ns > SILENT_NS, :4] = nan
        self.rows[now_ns - self._heard_ns > SILENT_NS, _OF_AGENT:] = nan
        rows: Floats = self.rows
        return rows

    def near(self, safe_m: float) -> list[tuple[float, int, int]]:
        """Pairs of robots whose hands are nearer to each other than `safe_m`: distance (m), and the two."""
        x, y = self.rows[:, 0].astype(float), self.rows[:, 1].astype(float)
        apart = np.hypot(x[:, None] - x[None, :], y[:, None] - y[None, :])
        first, second = np.nonzero(np.triu(apart < safe_m, 1))
        return [
            (float(apart[i, j]), self._ids[i], self._ids[j])
            for i, j in zip(first.tolist(), second.tolist(), strict=True)
        ]

    def edges(self, time_s: float | None) -> list[list[float]]:
        """The edges now: places of both robots in the fleet file, wanted distance (m)."""
        return [
            [self._index[robot], self._index[edge.other], round(edge.distance, PLACE_DIGITS)]
            for robot in self._ids
            for edge in self._watch.edges(robot, time_s)
            if robot < edge.other
        ]
