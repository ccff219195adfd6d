"""What a robot knows of its neighbours: the latest hand state of each, carried forward in time.

Pure. A neighbour's hand state is as old as its message. Its navigation loop is linear and known,
so with its last constraint force dying away as an edge's error does it is carried forward exactly over
that age (docs/theory.md).

A neighbour stamps its messages and follows the trajectory by its own clock. So all that is about it
is reckoned in that clock: the own one plus its offset, as far as that is proven (`agent.clock_offset`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from math import cos, exp, sin, sqrt
from typing import Final, NamedTuple

from agent.clock_offset import ClockOffset
from agent.messages import HandState

_NEVER: Final = -1
BRAKING_TIME_S: Final = 0.2
"""A robot that brakes is taken to lose its speed with this time constant."""
FUTURE_NS_MAX: Final = 250_000_000
"""A message may be stamped this far ahead of the local clock; the clocks of a fleet agree better."""

Reference = Callable[[int], tuple[float, float, float, float, float, float]]
"""The formation's reference point at a wall time (ns): x, y, vx, vy, ax, ay (m, m/s, m/s^2; W)."""

Transition = tuple[float, float, float, float, float, float, float]
"""What `transition` returns."""


def constraint_decay(kd: float, kp: float) -> float:
    """How fast a neighbour's constraint force is taken to die away, 1/s: as the edges' own errors do (J1).

    The slower root of s^2 + kd s + kp; 0 for kp = 0, where nothing pulls an edge's error back.
    """
    root = kd * kd - 4.0 * kp
    if root <= 0.0:
        return 0.5 * kd
    return 2.0 * kp / (kd + sqrt(root)) if kd > 0.0 else 0.0


@lru_cache(maxsize=1024)
def transition(c1: float, c2: float, decay: float, age: float) -> Transition:
    """Exact step of e'' = -c1 e - c2 e' + F_c exp(-decay t) over `age` seconds, (P1).

    Returns (a11, a12, a21, a22, b1, b2, remains) with [e; e'] <- [[a11, a12], [a21, a22]] [e; e'] +
    [b1; b2] F_c, and F_c <- remains F_c. c1 > 0, decay >= 0.
    """
    # c and s are cos and sin / omega (or cosh and sinh / omega, or 1 and age) with the decay in them:
    # of two real roots each keeps its own exponential, for cosh would overflow.
    sigma = 0.5 * c2
    discriminant = sigma * sigma - c1
    omega = sqrt(abs(discriminant))
    if discriminant < 0.0:
        shrunk = exp(-sigma * age)
        c, s = shrunk * cos(omega * age), shrunk * sin(omega * age) / omega
    elif discriminant > 0.0:
        slow, fast = exp((omega - sigma) * age), exp(-(omega + sigma) * age)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / omega
    else:
        c = exp(-sigma * age)
        s = age * c
    a11, a22 = c + sigma * s, c - sigma * s
    # A particular solution is F_c exp(-decay t) / (decay^2 - c2 decay + c1). At a root of that there is
    # none of this form, and the solution of a decay beside it is the same to six digits.
    divisor = decay * decay - c2 * decay + c1
    if abs(divisor) < 1e-9 * (c1 + decay * decay):
        return transition(c1, c2, decay * (1.0 + 1e-5), age)
    remains = exp(-decay * age)
    b1 = (remains - a11 + decay * s) / divisor
    b2 = (-decay * remains + c1 * s + decay * a22) / divisor
    return a11, s, -c1 * s, a22, b1, b2, remains


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
        decay: of a neighbour's constraint force, 1/s (`constraint_decay`).
        predict: False takes every hand state as it came, whatever its age.

    Attributes, each in the order of ``ids``:
        clocks: what is known of the neighbours' clocks.
        received_by, lost_by, delayed_by, duplicated_by: messages of each, since the start.
        ahead_ns: how far the last message was stamped ahead of the own clock if it was refused as
            ``future``, else 0.
    """

    def __init__(
        self,
        owner: int,
        offsets: Mapping[int, Sequence[float]],
        c1: float,
        c2: float,
        period_ns: int,
        *,
        decay: float = 0.0,
        predict: bool = True,
    ) -> None:
        self.ids: Final = tuple(sorted(offsets))
        self._owner = owner
        self._column = {robot: column for column, robot in enumerate(self.ids)}
        self._offsets = [(offsets[robot][0], offsets[robot][1]) for robot in self.ids]
        self._c1, self._c2 = c1, c2
        self._period_ns = period_ns
        self._decay, self._predict = decay, predict
        count = len(self.ids)
        self._latest: list[HandState | None] = [None] * count
        self._time_ns = [_NEVER] * count
        self._sequence = [_NEVER] * count
        self._copies: list[float | None] = [None] * count
        self._early: dict[int, HandState] = {}
        self._tick_ns = _NEVER
        self._heard: tuple[tuple[int, int], ...] | None = ()
        self.clocks: Final = tuple(ClockOffset(period_ns) for _ in self.ids)
        self.ahead_ns = [0] * count
        self.received_by, self.lost_by = [0] * count, [0] * count
        self.delayed_by, self.duplicated_by = [0] * count, [0] * count

    @property
    def received(self) -> int:
        return sum(self.received_by)

    @property
    def lost(self) -> int:
        return sum(self.lost_by)

    @property
    def delayed(self) -> int:
        return sum(self.delayed_by)

    @property
    def duplicated(self) -> int:
        return sum(self.duplicated_by)

    def begin(self, now_ns: int) -> None:
        """Begins the tick at `now_ns`, if it has not begun: takes what came too early for the last one."""
        if now_ns > self._tick_ns:
            self._tick_ns = now_ns
            early, self._early = self._early, {}
            for column, message in early.items():
                if message.time_ns > self._time_ns[column]:
                    self._take(column, message, now_ns)

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
        clock = self.clocks[column]
        used_ns = clock.used_ns
        # A clock that was behind and has been set must not be refused for what it was.
        if time_ns > now_ns + FUTURE_NS_MAX and time_ns > now_ns + used_ns + FUTURE_NS_MAX:
            self.ahead_ns[column] = time_ns - now_ns
            return "future"
        if time_ns <= self._time_ns[column]:
            return self._refuse(column, time_ns == self._time_ns[column])
        early = now_ns <= time_ns - used_ns < now_ns + self._period_ns
        if early:
            waiting = self._early.get(column)
            if waiting is not None and waiting.time_ns >= time_ns:
                return self._refuse(column, waiting.time_ns == time_ns)
            self._early[column] = message
        echo_us = None
        for robot, delay_us in message.heard:
            if robot == self._owner:
                echo_us = delay_us
                break
        if clock.take(now_ns, time_ns, echo_us):
            self._heard = None
        self.ahead_ns[column] = 0
        if not early:
            self._take(column, message, now_ns)
        return None

    def _refuse(self, column: int, same: bool) -> str:
        self.duplicated_by[column] += same
        return "duplicate" if same else "out_of_order"

    def _take(self, column: int, message: HandState, now_ns: int) -> None:
        """Makes `message` the latest of its sender; it is newer than the one before."""
        time_ns, period_ns = message.time_ns, self._period_ns
        if self._sequence[column] != _NEVER:
            # No more can be missing than there was time for, whatever the numbers say: a mission
            # sets them to its rounds, and a sender that starts again begins at 0.
            gap = message.sequence - self._sequence[column] - 1
            if gap > 0:
                between = (time_ns - self._time_ns[column] + period_ns // 2) // period_ns - 1
                self.lost_by[column] += max(0, min(gap, between))
        self.received_by[column] += 1
        if now_ns + self.clocks[column].used_ns - time_ns > 2 * period_ns:
            self.delayed_by[column] += 1
        self._time_ns[column] = time_ns
        self._sequence[column] = message.sequence
        self._latest[column] = message
        self._copies[column] = None
        for robot, value in message.multipliers:
            if robot == self._owner:
                self._copies[column] = value

    def ages_ns(self, now_ns: int) -> list[int | None]:
        """Age of each neighbour's hand state by its own clock, None where none has come.

        Below 0 where its clock is further ahead than is proven.
        """
        return [
            None if time_ns == _NEVER else now_ns + clock.used_ns - time_ns
            for time_ns, clock in zip(self._time_ns, self.clocks, strict=True)
        ]

    def heard(self) -> tuple[tuple[int, int], ...]:
        """What to echo: ``(neighbour, least apparent delay of its messages in us)``, where it is known."""
        if self._heard is None:
            self._heard = tuple(
                (robot, clock.least_us)
                for robot, clock in zip(self.ids, self.clocks, strict=True)
                if clock.least_us is not None
            )
        return self._heard

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

        `time_ns` is of the own clock; a neighbour whose clock is found to be ahead is further along
        the trajectory, for it follows by its own. A message from before `epoch_ns` is of a robot that
        stands until then. One that is ahead of that time is taken as it is.

        With prediction switched off the states are those of the messages.
        """
        if not self._predict:
            return [_as_it_came(message) for message in self._latest]
        c1, c2 = self._c1, self._c2
        ours = reference(time_ns)
        out = []
        for message, clock, (offset_x, offset_y) in zip(
            self._latest, self.clocks, self._offsets, strict=True
        ):
            assert message is not None
            _, _, stamp, following, x, y, vx, vy, _, _, fx, fy, _, _ = message
            used_ns = clock.used_ns
            then_ns = time_ns + used_ns
            if not following:
                out.append(_coasting(message, max(0, then_ns - stamp) * 1e-9))
                continue
            x1, y1, vx1, vy1, ax1, ay1 = reference(then_ns) if used_ns else ours
            since = min(max(stamp, epoch_ns), then_ns)
            a11, a12, a21, a22, b1, b2, remains = transition(c1, c2, self._decay, (then_ns - since) * 1e-9)
            x0, y0, vx0, vy0, _, _ = reference(since)
            ex, ey, edot_x, edot_y = x - offset_x - x0, y - offset_y - y0, vx - vx0, vy - vy0
            new_x, new_y = a11 * ex + a12 * edot_x + b1 * fx, a11 * ey + a12 * edot_y + b1 * fy
            new_vx, new_vy = a21 * ex + a22 * edot_x + b2 * fx, a21 * ey + a22 * edot_y + b2 * fy
            out.append(
                Prediction(
                    (x1 + offset_x + new_x, y1 + offset_y + new_y),
                    (vx1 + new_vx, vy1 + new_vy),
                    (ax1 - c1 * new_x - c2 * new_vx, ay1 - c1 * new_y - c2 * new_vy),
                    (remains * fx, remains * fy),
                )
            )
        return out


def _coasting(message: HandState, age: float) -> Prediction:
    """A neighbour that brakes, `age` seconds later: its speed dies away, and it feels no force."""
    remains = exp(-age / BRAKING_TIME_S)
    way = BRAKING_TIME_S * (1.0 - remains)
    position = message.x + way * message.vx, message.y + way * message.vy
    return Prediction(position, (remains * message.vx, remains * message.vy), (0.0, 0.0), (0.0, 0.0))


def _as_it_came(message: HandState | None) -> Prediction:
    """A neighbour where its message says, as if that had come at once."""
    assert message is not None
    _, _, _, following, x, y, vx, vy, nx, ny, fx, fy, _, _ = message
    if not following:
        nx = ny = fx = fy = 0.0
    return Prediction((x, y), (vx, vy), (nx, ny), (fx, fy))
