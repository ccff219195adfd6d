"""Dynamics of a rover under the speeds and yaw rates that it is asked for (PURE).

The structure is ArduRover's: a command that takes `DELAY_S` to act, a speed reference limited in
acceleration, a proportional-integral loop with feed-forward on a motor of first order, and a yaw-rate
reference limited likewise in front of a loop of second order. The numbers are fitted to the step
responses of a skid-steering rover that were measured on the autopilot itself, to within their reading
errors (tests/unit/bridges/mavlink/ardupilot/test_dynamics.py has the figures).

Frames are the vehicle's: NED about its origin, yaw clockwise from north, FRD in the body. SI units.
"""

from __future__ import annotations

from collections import deque
from math import ceil, cos, inf, radians, sin
from typing import Final, NamedTuple

from handfast.bridges.mavlink.ardupilot import constants

GRAVITY: Final = 9.80665
STEP_S: Final = 0.005
"""Longest step of the integration: the fitted numbers go with it."""

DELAY_S: Final = 0.03
"""From sending to acting; with the rise that follows, a tenth of a yaw rate is there after 0.06 s."""
SPEED_FEED_FORWARD: Final = 1.056
SPEED_P: Final = 1.678
SPEED_I: Final = 1.144
THROTTLE_LAG_S: Final = 0.076
MOTOR_LAG_S: Final = 0.467
STOP_SPEED: Final = 0.1
"""m/s. Asked to stand and slower than this, the autopilot lets go of the throttle (ATC_STOP_SPEED)."""
STANDING: Final = 0.02
"""m/s. Without throttle, friction holds a rover that is slower."""

STEERING_ACCELERATION_MAX: Final = radians(120.0)
"""rad/s^2 (ATC_STR_ACC_MAX)."""
STEERING_FREQUENCY: Final = 25.57
STEERING_DAMPING: Final = 0.505
STEERING_LEAD_S: Final = 0.0518
_STIFFNESS: Final = STEERING_FREQUENCY * STEERING_FREQUENCY
_RESISTANCE: Final = 2.0 * STEERING_DAMPING * STEERING_FREQUENCY


class Limits(NamedTuple):
    """What a rover's parameters allow: WP_SPEED m/s, ATC_ACCEL_MAX m/s^2, ATC_STR_RAT_MAX rad/s and
    ATC_TURN_MAX_G in g; 0 means no limit, as the autopilot has it."""

    speed: float = constants.DEFAULT_WP_SPEED_MPS
    acceleration: float = constants.DEFAULT_ATC_ACCEL_MAX_MPS2
    yaw_rate: float = radians(constants.DEFAULT_ATC_STR_RAT_MAX_DPS)
    turn_g: float = constants.DEFAULT_ATC_TURN_MAX_G


DEFAULTS: Final = Limits()


def limited(value: float, limit: float) -> float:
    """`value` within -limit to limit."""
    return min(limit, max(-limit, value))


def or_inf(limit: float) -> float:
    """A parameter's limit, of which 0 means none."""
    return limit if limit > 0.0 else inf


class RoverDynamics:
    """The motion of one rover, integrated in steps of `STEP_S` at most.

    Args:
        north, east: start, m, NED about the vehicle's origin.
        yaw: rad, clockwise from north; it is not wrapped.

    Attributes: `north`, `east`, `yaw`; `speed` (m/s along the heading, negative in reverse) and
    `yaw_rate` (rad/s, clockwise): the truth.
    """

    def __init__(self, north: float = 0.0, east: float = 0.0, yaw: float = 0.0) -> None:
        self.north, self.east, self.yaw = north, east, yaw
        self.speed = self.yaw_rate = 0.0
        self._time = 0.0
        self._commands: deque[tuple[float, float, float]] = deque()  # when each acts, s; speed; yaw rate
        self._speed_asked = self._yaw_rate_asked = 0.0
        self._speed_reference = self._speed_integral = self._throttle = 0.0
        self._turn_reference = self._turn = self._turn_slope = 0.0

    def step(
        self,
        dt: float,
        speed: float,
        yaw_rate: float,
        *,
        powered: bool = True,
        limits: Limits = DEFAULTS,
    ) -> None:
        """Moves it on by `dt` (s), while it is asked for `speed` (m/s) and `yaw_rate` (rad/s, clockwise).

        Without power (disarmed, HOLD's motors off) what is asked for is nothing, and it rolls out.
        """
        count = max(1, ceil(dt / STEP_S - 1e-9))
        h = dt / count
        top, change = or_inf(limits.speed), or_inf(limits.acceleration) * h
        rate_max, sideways_max = or_inf(limits.yaw_rate), or_inf(limits.turn_g) * GRAVITY
        commands = self._commands
        last = commands[-1] if commands else (0.0, self._speed_asked, self._yaw_rate_asked)
        if last[1:] != (speed, yaw_rate):
            commands.append((self._time + DELAY_S, speed, yaw_rate))
        if not powered:
            self._speed_reference = self._speed_integral = self._throttle = 0.0
            self._turn_reference = self._turn = self._turn_slope = 0.0
        for _ in range(count):
            while commands and commands[0][0] <= self._time + 1e-9:
                _, self._speed_asked, self._yaw_rate_asked = commands.popleft()
            before = self.speed
            if powered:
                self._accelerate(h, top, change, before)
                self._steer(h, rate_max, sideways_max, before)
            self._move(h, before)
            self._time += h

    def _accelerate(self, h: float, top: float, change: float, speed: float) -> None:
        # `limited` in place, here and below: all this runs 200 times a second in every bridge and every
        # simulated rover.
        reference = self._speed_reference
        asked = self._speed_asked
        off = (asked if -top <= asked <= top else top if asked > 0.0 else -top) - reference
        reference += off if -change <= off <= change else change if off > 0.0 else -change
        self._speed_reference = reference
        if reference == 0.0 and -STOP_SPEED <= speed <= STOP_SPEED:
            self._speed_integral = drive = 0.0
        else:
            error = reference - speed
            self._speed_integral = integral = self._speed_integral + SPEED_I * error * h
            drive = SPEED_FEED_FORWARD * reference + SPEED_P * error + integral
        self._throttle += (drive - self._throttle) * h / THROTTLE_LAG_S

    def _steer(self, h: float, most: float, sideways: float, speed: float) -> None:
        if not -STOP_SPEED <= speed <= STOP_SPEED:
            most = min(most, sideways / abs(speed))
        change = STEERING_ACCELERATION_MAX * h
        reference = self._turn_reference
        asked = self._yaw_rate_asked
        off = (asked if -most <= asked <= most else most if asked > 0.0 else -most) - reference
        reference += off if -change <= off <= change else change if off > 0.0 else -change
        self._turn_reference = reference
        slope, turn = self._turn_slope, self._turn
        slope += (_STIFFNESS * (reference - turn) - _RESISTANCE * slope) * h
        self._turn_slope = slope
        self._turn = turn + slope * h

    def _move(self, h: float, before: float) -> None:
        throttle, yaw = self._throttle, self.yaw
        speed = before + (throttle - before) * h / MOTOR_LAG_S
        if self._speed_reference == 0.0 and -STANDING < speed < STANDING and -STANDING < throttle < STANDING:
            speed = self._throttle = 0.0
        self.speed = speed
        self.yaw_rate = rate = self._turn + STEERING_LEAD_S * self._turn_slope
        self.yaw = after = yaw + rate * h
        middle, way = 0.5 * (yaw + after), 0.5 * (before + speed) * h
        self.north += way * cos(middle)
        self.east += way * sin(middle)
