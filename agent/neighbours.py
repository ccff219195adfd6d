"""What a robot knows of its neighbours: the latest hand state of each, carried forward in time.

Pure. A neighbour's hand state is as old as its message. Its navigation loop is linear and known,
so with its last constraint force held it is carried forward exactly over that age (docs/theory.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from math import cos, cosh, exp, sin, sinh, sqrt
from typing import Final, NamedTuple

import numpy as np

from agent.law import Array
from agent.messages import HandState

_NEVER: Final = -1
BRAKING_TIME_S: Final = 0.2
"""A robot that brakes is taken to lose its speed with this time constant."""
FUTURE_NS_MAX: Final = 250_000_000
"""A message may be stamped this far ahead of the local clock; the clocks of a fleet agree better."""

Reference = Callable[[int], tuple[float, float, float, float, float, float]]
"""The formation's reference point at a wall time (ns): x, y, vx, vy, ax, ay (m, m/s, m/s^2; W)."""


@lru_cache(maxsize=1024)
def transition(c1: float, c2: float, age: float) -> tuple[float, float, float, float, float, float]:
    """Exact step of e'' = -c1 e - c2 e' + F_c over `age` seconds with F_c held.

    Returns (a11, a12, a21, a22, b1, b2) with [e; e'] <- [[a11, a12], [a21, a22]] [e; e'] + [b1; b2] F_c,
    that is exp(A T) and A^-1 (exp(A T) - I) B. c1 > 0.
    """
    sigma = 0.5 * c2
    discriminant = sigma * sigma - c1
    if discriminant < 0.0:
        omega = sqrt(-discriminant)
        c, s = cos(omega * age), sin(omega * age) / omega
    elif discriminant > 0.0:
        omega = sqrt(discriminant)
        c, s = cosh(omega * age), sinh(omega * age) / omega
    else:
        c, s = 1.0, age
    decay = exp(-sigma * age)
    a12 = decay * s
    a22 = decay * (c - sigma * s)
    return decay * (c + sigma * s), a12, -c1 * a12, a22, (1.0 - a22 - c2 * a12) / c1, a12


class Prediction(NamedTuple):
    """Every neighbour at one instant, columns in the order of `Neighbours.ids`, W.

    position (2, k) m, velocity (2, k) m/s, navigation F_n (2, k) and constraint F_c (2, k) m/s^2.
    """

    position: Array
    velocity: Array
    navigation: Array
    constraint: Array


class Neighbours:
    """The latest hand state of each neighbour of robot `owner`.

    Args:
        owner: id of the robot that listens.
        offsets: neighbour's id -> its offset in the formation, (x, y), m.
        c1, c2: the neighbours' navigation gains (21).
        period_ns: time between two messages of one neighbour.
    """

    def __init__(
        self, owner: int, offsets: Mapping[int, Sequence[float]], c1: float, c2: float, period_ns: int
    ) -> None:
        self.ids: Final = tuple(sorted(offsets))
        self._owner = owner
        self._column = {robot: column for column, robot in enumerate(self.ids)}
        self._offsets = np.array([offsets[robot] for robot in self.ids]).reshape(-1, 2).T
        self._c1, self._c2 = c1, c2
        self._period_ns = period_ns
        count = len(self.ids)
        self._state = np.zeros((8, count))  # x y vx vy, F_n, F_c by column
        self._time_ns = [_NEVER] * count
        self._sequence = [_NEVER] * count
        self._following = [False] * count
        self._copies: list[float | None] = [None] * count
        self._early: dict[int, HandState] = {}
        self._tick_ns = _NEVER
        self.received = self.lost = self.delayed = self.duplicated = 0

    def begin(self, now_ns: int) -> None:
        """Begins the tick at `now_ns`, if it has not begun: takes what came too early for the last one."""
        if now_ns > self._tick_ns:
            self._tick_ns = now_ns
            early, self._early = self._early, {}
            for message in early.values():
                self.accept(message, now_ns)

    def accept(self, message: HandState, now_ns: int) -> str | None:
        """Takes a neighbour's message at the tick `now_ns`; returns why it is refused, None when it is taken.

        Refused, with nothing changed: ``stranger`` (not a neighbour), ``future``, ``duplicate``
        and ``out_of_order`` (not newer than what is known). A sender that starts again counts its
        messages from 0 but its clock goes on: the time decides what is newer.

        All robots tick at once, and which of them sees which other's message of the same tick
        would be up to the scheduler. So a message of this tick waits for the next one: every
        robot works with its neighbours' last tick, as the joint sweep supposes.
        """
        self.begin(now_ns)
        column = self._column.get(message.robot)
        if column is None:
            return "stranger"
        time_ns = message.time_ns
        if time_ns > now_ns + FUTURE_NS_MAX:
            return "future"
        if time_ns <= self._time_ns[column]:
            if time_ns == self._time_ns[column]:
                self.duplicated += 1
                return "duplicate"
            return "out_of_order"
        if now_ns <= time_ns < now_ns + self._period_ns:
            self._early[column] = message
            return None
        gap = message.sequence - self._sequence[column] - 1
        if self._sequence[column] != _NEVER and gap > 0:
            self.lost += gap
        self.received += 1
        if now_ns - time_ns > 2 * self._period_ns:
            self.delayed += 1
        self._time_ns[column] = time_ns
        self._sequence[column] = message.sequence
        self._following[column] = message.following
        self._state[:, column] = message[4:12]
        self._copies[column] = next(
            (value for robot, value in message.multipliers if robot == self._owner), None
        )
        return None

    def ages_ns(self, now_ns: int) -> list[int | None]:
        """Age of each neighbour's hand state, None where none has come; below 0 if its clock is ahead."""
        return [None if time_ns == _NEVER else now_ns - time_ns for time_ns in self._time_ns]

    def average(self, multipliers: Array) -> None:
        """Averages `multipliers` (k,), in place, with the neighbours' copies that came since the last call.

        Both ends of an edge hold a copy of lambda; this keeps lambda_ij = lambda_ji, (31), when
        messages are lost.
        """
        for column, copy in enumerate(self._copies):
            if copy is not None:
                multipliers[column] = 0.5 * (multipliers[column] + copy)
                self._copies[column] = None

    def predict(self, time_ns: int, reference: Reference, epoch_ns: int) -> Prediction:
        """Every neighbour carried forward to `time_ns`. Each must have been heard.

        A message from before `epoch_ns` is of a robot that stands until then.
        """
        rows = []
        for stamp in self._time_ns:
            since = max(stamp, epoch_ns)
            rows.append(transition(self._c1, self._c2, (time_ns - since) * 1e-9) + reference(since))
        a11, a12, a21, a22, b1, b2, x, y, vx, vy, _, _ = np.array(rows).T
        x1, y1, vx1, vy1, ax1, ay1 = reference(time_ns)
        state, offsets = self._state, self._offsets
        constraint = state[6:8]
        error = state[0:2] - offsets
        error[0] -= x
        error[1] -= y
        error_rate = state[2:4].copy()
        error_rate[0] -= vx
        error_rate[1] -= vy
        position = a11 * error + a12 * error_rate + b1 * constraint
        velocity = a21 * error + a22 * error_rate + b2 * constraint
        navigation = -self._c1 * position - self._c2 * velocity
        navigation[0] += ax1
        navigation[1] += ay1
        position += offsets
        position[0] += x1
        position[1] += y1
        velocity[0] += vx1
        velocity[1] += vy1
        if not all(self._following):
            constraint = constraint.copy()
            for column, following in enumerate(self._following):
                if not following:
                    self._coast(column, time_ns, position, velocity)
                    navigation[:, column] = constraint[:, column] = 0.0
        return Prediction(position, velocity, navigation, constraint)

    def _coast(self, column: int, time_ns: int, position: Array, velocity: Array) -> None:
        """A neighbour that brakes: its speed dies away, and it feels no force."""
        remains = exp(-(time_ns - self._time_ns[column]) * 1e-9 / BRAKING_TIME_S)
        moving = self._state[2:4, column]
        velocity[:, column] = remains * moving
        position[:, column] = self._state[0:2, column] + BRAKING_TIME_S * (1.0 - remains) * moving
