"""Estimates where a rover is now, from what it said of where it was (PURE).

Position and attitude come in messages of their own, valid at different instants and up to 0.15 s old. Both
are carried to the time asked for along the motion that a model of the rover
(`bridges.mavlink.ardupilot.dynamics`) makes of the commands that were sent since; what the measured speed
and yaw rate differed from those of the model is added as if it stayed. So a rover that nobody here commands
goes on as it was measured, and one that was just commanded to turn is already seen turning.

Poses are in W (world ENU), yaw rates counter-clockwise, times ns of the wall clock.
"""

from __future__ import annotations

from collections import deque
from math import cos, degrees, hypot, isfinite, sin
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.bridges.mavlink.ardupilot.dynamics import DEFAULTS, Limits, RoverDynamics
from handfast.bridges.mavlink.ardupilot.frames import wrapped

STALE_S: Final = 0.4
"""Nothing older than this is driven by."""
JUMP_M: Final = 0.5
JUMP_RAD: Final = 0.35
"""A sample further than this from what the last one let expect: the estimate has jumped."""
GROWTH: Final = 0.5
"""m/s and rad/s that a jump may be larger for every second since the last sample."""
CONSISTENT_NS: Final = NS_PER_S
"""So long must samples follow from one another before a jump is forgotten."""
KEPT_NS: Final = NS_PER_S
"""The model's past is kept for so long."""
BACK_NS: Final = NS_PER_S
"""A sample that is so much older than the last one is of a clock that was set: all begins anew."""
STEP_MAX_S: Final = 0.5
"""s. A model that had no command for longer goes on from there."""


class Motion(NamedTuple):
    """The model at one instant: position (m) and heading (rad) of no meaning but their differences,
    speed (m/s) and yaw rate (rad/s)."""

    x: float
    y: float
    heading: float
    speed: float
    yaw_rate: float


class Estimated(NamedTuple):
    """Pose (W) at the time asked for; `healthy` is False when it must not be driven by: `note` says why."""

    pose: Pose
    healthy: bool
    note: str


class Residual(NamedTuple):
    """Measured minus predicted, of the newest samples: speed, m/s, and yaw rate, rad/s."""

    speed: float
    yaw_rate: float


class Prediction:
    """What the commands sent so far do to a rover, by the model, and its near past."""

    def __init__(self) -> None:
        self._rover = RoverDynamics()
        self._past: deque[tuple[int, Motion]] = deque()
        self._found: dict[int, Motion] = {}  # by time, until the model goes on: each is asked for repeatedly
        self._asked = (0.0, 0.0)
        self._limits = DEFAULTS

    def command(self, now_ns: int, speed: float, yaw_rate: float, limits: Limits) -> None:
        """From `now_ns` on the rover is asked for this speed and yaw rate (FLU)."""
        self.advance(now_ns)
        self._asked, self._limits = (speed, yaw_rate), limits

    def advance(self, now_ns: int) -> None:
        """Brings the model to a time."""
        if self._past:
            dt = (now_ns - self._past[-1][0]) / NS_PER_S
            if dt == 0.0:
                return
            if dt < 0.0:
                self._past.clear()
            else:
                self._rover.step(min(dt, STEP_MAX_S), *self._asked, limits=self._limits)
        self._found.clear()
        rover = self._rover  # its north and clockwise are x and counter-clockwise here: the model has no hand
        self._past.append((now_ns, Motion(rover.north, rover.east, rover.yaw, rover.speed, rover.yaw_rate)))
        while self._past[0][0] < now_ns - KEPT_NS:
            self._past.popleft()

    def at(self, time_ns: int) -> Motion:
        """The model at a time; beyond what is known as at its end."""
        found = self._found.get(time_ns)
        if found is None:
            found = self._found[time_ns] = self._between(time_ns)
        return found

    def _between(self, time_ns: int) -> Motion:
        past = self._past
        if not past:
            return Motion(0.0, 0.0, 0.0, 0.0, 0.0)
        after = past[-1]
        if time_ns >= after[0]:
            return after[1]
        for before in reversed(past):
            if before[0] <= time_ns:
                share = (time_ns - before[0]) / (after[0] - before[0])
                a, b = before[1], after[1]
                return Motion(
                    a.x + share * (b.x - a.x),
                    a.y + share * (b.y - a.y),
                    a.heading + share * (b.heading - a.heading),
                    a.speed + share * (b.speed - a.speed),
                    a.yaw_rate + share * (b.yaw_rate - a.yaw_rate),
                )
            after = before
        return after[1]


class _Jump:
    """Whether one quantity's samples follow from one another; `note` says how not."""

    def __init__(self) -> None:
        self.note = ""
        self._until_ns = 0

    def found(self, valid_ns: int, note: str) -> None:
        self.note = note
        self._until_ns = valid_ns + CONSISTENT_NS

    def none(self, valid_ns: int) -> None:
        if self.note and valid_ns >= self._until_ns:
            self.note = ""


class Estimate:
    """The pose of one rover.

    Feed it samples and commands as they come and ask for the pose at a tick. Samples that are older than the
    newest of their kind are passed over.
    """

    def __init__(self) -> None:
        self.prediction: Final = Prediction()
        self._position: tuple[int, float, float, float] | None = None
        self._attitude: tuple[int, float, float] | None = None
        self._moved, self._turned = _Jump(), _Jump()
        self._not_finite: set[str] = set()

    def command(self, now_ns: int, speed: float, yaw_rate: float, limits: Limits = DEFAULTS) -> None:
        """Told at every tick what the rover is asked for (m/s, rad/s, FLU); zeros when nothing is sent."""
        self.prediction.command(now_ns, speed, yaw_rate, limits)

    def forget(self) -> None:
        """The vehicle's estimate begins anew (a reboot, another origin): nothing before counts."""
        self._position = self._attitude = None
        self._moved, self._turned = _Jump(), _Jump()

    def position(self, valid_ns: int, x: float, y: float, speed: float) -> None:
        """Takes a position (m, W) with the speed along the heading (m/s), both valid at `valid_ns`."""
        if not self._finite("position", x, y, speed):
            return
        last = self._position
        if last is not None:
            if valid_ns < last[0] - BACK_NS:
                self.forget()
            elif valid_ns <= last[0]:
                return
            elif self._attitude is not None:
                then, now = self._heading_at(last[0]), self._heading_at(valid_ns)
                expected_x, expected_y = self._carried(last, then, valid_ns, now)
                off = hypot(x - expected_x, y - expected_y)
                if off > JUMP_M + GROWTH * (valid_ns - last[0]) / NS_PER_S:
                    self._moved.found(valid_ns, f"its position jumped by {off:.2f} m")
                else:
                    self._moved.none(valid_ns)
        self._position = (valid_ns, x, y, speed)

    def attitude(self, valid_ns: int, heading: float, yaw_rate: float) -> None:
        """Takes a heading (rad, W) and a yaw rate (rad/s, counter-clockwise), both valid at `valid_ns`."""
        if not self._finite("attitude", heading, yaw_rate):
            return
        last = self._attitude
        if last is not None:
            if valid_ns < last[0] - BACK_NS:
                self.forget()
            elif valid_ns <= last[0]:
                return
            else:
                off = abs(wrapped(heading - self._heading_at(valid_ns)))
                if off > JUMP_RAD + GROWTH * (valid_ns - last[0]) / NS_PER_S:
                    self._turned.found(valid_ns, f"its heading jumped by {degrees(off):.0f} degrees")
                else:
                    self._turned.none(valid_ns)
        self._attitude = (valid_ns, heading, yaw_rate)

    @property
    def predicted(self) -> tuple[float, float]:
        """Speed (m/s) and yaw rate (rad/s) that the commands should have made by the newest samples."""
        return (
            0.0 if self._position is None else self.prediction.at(self._position[0]).speed,
            0.0 if self._attitude is None else self.prediction.at(self._attitude[0]).yaw_rate,
        )

    @property
    def residual(self) -> Residual:
        """How the newest measured speed and yaw rate differ from those `predicted`."""
        speed, yaw_rate = self.predicted
        return Residual(
            0.0 if self._position is None else self._position[3] - speed,
            0.0 if self._attitude is None else self._attitude[2] - yaw_rate,
        )

    def pose_at(self, now_ns: int) -> Estimated:
        """The pose (W) at a time near the newest samples; the speed and yaw rate are the likely true ones."""
        if self._position is None or self._attitude is None:
            missing = "position" if self._position is None else "attitude"
            return Estimated(Pose(0.0, 0.0, 0.0, 0.0, 0.0), False, f"no {missing} from the vehicle yet")
        self.prediction.advance(now_ns)
        heading = self._heading_at(now_ns)
        x, y = self._carried(self._position, self._heading_at(self._position[0]), now_ns, heading)
        model, residual = self.prediction.at(now_ns), self.residual
        pose = Pose(x, y, wrapped(heading), model.speed + residual.speed, model.yaw_rate + residual.yaw_rate)
        note = self._trouble(now_ns)
        return Estimated(pose, not note, note)

    def _trouble(self, now_ns: int) -> str:
        assert self._position is not None
        assert self._attitude is not None
        if self._not_finite:
            return f"not a number in its {' and '.join(sorted(self._not_finite))}"
        for name, then_ns in (("position", self._position[0]), ("attitude", self._attitude[0])):
            age_s = (now_ns - then_ns) / NS_PER_S
            if age_s > STALE_S:
                return f"its {name} is {age_s:.1f} s old"
        return self._moved.note or self._turned.note

    def _finite(self, name: str, *values: float) -> bool:
        if all(map(isfinite, values)):
            self._not_finite.discard(name)
            return True
        self._not_finite.add(name)
        return False

    def _heading_at(self, time_ns: int) -> float:
        """The newest heading carried to a time before or after it."""
        assert self._attitude is not None
        then_ns, heading, yaw_rate = self._attitude
        then, now = self.prediction.at(then_ns), self.prediction.at(time_ns)
        since = (time_ns - then_ns) / NS_PER_S
        return heading + now.heading - then.heading + (yaw_rate - then.yaw_rate) * since

    def _carried(
        self, sample: tuple[int, float, float, float], heading: float, time_ns: int, heading_now: float
    ) -> tuple[float, float]:
        """A position with the heading there, carried to a time with the heading then, along the model's path
        turned to the first of the two."""
        then_ns, x, y, speed = sample
        then, now = self.prediction.at(then_ns), self.prediction.at(time_ns)
        turn = heading - then.heading
        c, s = cos(turn), sin(turn)
        dx, dy = now.x - then.x, now.y - then.y
        middle = 0.5 * (heading + heading_now)
        beyond = (speed - then.speed) * (time_ns - then_ns) / NS_PER_S
        return (
            x + c * dx - s * dy + beyond * cos(middle),
            y + s * dx + c * dy + beyond * sin(middle),
        )
