"""What a robot knows of its neighbours: the latest hand state of each, carried forward in time.

Pure. A neighbour's hand state is as old as its message. Its navigation loop is linear and known,
so with its last constraint force held it is carried forward exactly over that age (docs/theory.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from math import cos, exp, sin, sqrt
from typing import Final, NamedTuple

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
    # c and s are cos and sin / omega (or cosh and sinh / omega, or 1 and age) with the decay in them:
    # of two real roots each keeps its own exponential, for cosh would overflow.
    sigma = 0.5 * c2
    discriminant = sigma * sigma - c1
    omega = sqrt(abs(discriminant))
    if discriminant < 0.0:
        decay = exp(-sigma * age)
        c, s = decay * cos(omega * age), decay * sin(omega * age) / omega
    elif discriminant > 0.0:
        slow, fast = exp((omega - sigma) * age), exp(-(omega + sigma) * age)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / omega
    else:
        c = exp(-sigma * age)
        s = age * c
    a22 = c - sigma * s
    return c + sigma * s, s, -c1 * s, a22, (1.0 - a22 - c2 * s) / c1, s


class Prediction(NamedTuple):
    """One neighbour at one instant, vectors (x, y) in W.

    position m, velocity m/s, navigation force F_n and constraint force F_c m/s^2.
    """

    position: tuple[float, float]
    velocity: tuple[float, float]
    navigation: tuple[float, float]
    constraint: tuple[float, float]


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
        self._offsets = [(offsets[robot][0], offsets[robot][1]) for robot in self.ids]
        self._c1, self._c2 = c1, c2
        self._period_ns = period_ns
        count = len(self.ids)
        self._latest: list[HandState | None] = [None] * count
        self._time_ns = [_NEVER] * count
        self._sequence = [_NEVER] * count
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
            waiting = self._early.setdefault(column, message)
            if waiting is not message:
                if waiting.time_ns >= time_ns:
                    self.duplicated += waiting.time_ns == time_ns
                    return "duplicate" if waiting.time_ns == time_ns else "out_of_order"
                self._early[column] = message
            return None
        if self._sequence[column] != _NEVER:
            # No more can be missing than there was time for, whatever the numbers say.
            gap = message.sequence - self._sequence[column] - 1
            self.lost += max(0, min(gap, (time_ns - self._time_ns[column]) // self._period_ns))
        self.received += 1
        if now_ns - time_ns > 2 * self._period_ns:
            self.delayed += 1
        self._time_ns[column] = time_ns
        self._sequence[column] = message.sequence
        self._latest[column] = message
        self._copies[column] = None
        for robot, value in message.multipliers:
            if robot == self._owner:
                self._copies[column] = value
        return None

    def ages_ns(self, now_ns: int) -> list[int | None]:
        """Age of each neighbour's hand state, None where none has come; below 0 if its clock is ahead."""
        return [None if time_ns == _NEVER else now_ns - time_ns for time_ns in self._time_ns]

    def average(self, multipliers: list[float]) -> None:
        """Averages `multipliers`, one a neighbour, in place, with the copies that came since the last call.

        Both ends of an edge hold a copy of lambda; this keeps lambda_ij = lambda_ji, (31), when
        messages are lost.
        """
        for column, copy in enumerate(self._copies):
            if copy is not None:
                multipliers[column] = 0.5 * (multipliers[column] + copy)
                self._copies[column] = None

    def predict(self, time_ns: int, reference: Reference, epoch_ns: int) -> list[Prediction]:
        """Every neighbour carried forward to `time_ns`, in the order of `ids`. Each must have been heard.

        A message from before `epoch_ns` is of a robot that stands until then. One that is ahead of
        `time_ns` (a clock that is ahead) is taken as it is.
        """
        c1, c2 = self._c1, self._c2
        x1, y1, vx1, vy1, ax1, ay1 = reference(time_ns)
        out = []
        for message, (offset_x, offset_y) in zip(self._latest, self._offsets, strict=True):
            assert message is not None
            _, _, stamp, following, x, y, vx, vy, _, _, fx, fy, _ = message
            if not following:
                out.append(_coasting(message, max(0, time_ns - stamp) * 1e-9))
                continue
            since = min(max(stamp, epoch_ns), time_ns)
            a11, a12, a21, a22, b1, b2 = transition(c1, c2, (time_ns - since) * 1e-9)
            x0, y0, vx0, vy0, _, _ = reference(since)
            ex, ey, edot_x, edot_y = x - offset_x - x0, y - offset_y - y0, vx - vx0, vy - vy0
            new_x, new_y = a11 * ex + a12 * edot_x + b1 * fx, a11 * ey + a12 * edot_y + b1 * fy
            new_vx, new_vy = a21 * ex + a22 * edot_x + b2 * fx, a21 * ey + a22 * edot_y + b2 * fy
            out.append(
                Prediction(
                    (x1 + offset_x + new_x, y1 + offset_y + new_y),
                    (vx1 + new_vx, vy1 + new_vy),
                    (ax1 - c1 * new_x - c2 * new_vx, ay1 - c1 * new_y - c2 * new_vy),
                    (fx, fy),
                )
            )
        return out


def _coasting(message: HandState, age: float) -> Prediction:
    """A neighbour that brakes, `age` seconds later: its speed dies away, and it feels no force."""
    remains = exp(-age / BRAKING_TIME_S)
    way = BRAKING_TIME_S * (1.0 - remains)
    position = message.x + way * message.vx, message.y + way * message.vy
    return Prediction(position, (remains * message.vx, remains * message.vy), (0.0, 0.0), (0.0, 0.0))
