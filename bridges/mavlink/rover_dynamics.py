"""How a rover moves under the speeds and yaw rates that it is asked for (PURE).

The structure is ArduRover's: a command that takes `DELAY_S` to act, a speed reference limited in
acceleration, a proportional-integral loop with feed-forward on a motor of first order, and a yaw-rate
reference limited likewise in front of a loop of second order. The numbers are fitted to the step
responses of a skid-steering rover that were measured on the autopilot itself, to within their reading
errors (tests/unit/test_rover_dynamics.py has the figures).

Frames are the vehicle's: NED about its origin, yaw clockwise from north, FRD in the body. SI units.
"""

from __future__ import annotations

from collections import deque
from math import ceil, cos, inf, radians, sin
from typing import Final, NamedTuple

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


class Limits(NamedTuple):
    """What a rover's parameters allow: WP_SPEED m/s, ATC_ACCEL_MAX m/s^2, ATC_STR_RAT_MAX rad/s and
    ATC_TURN_MAX_G in g; 0 means no limit, as the autopilot has it."""

    speed: float = 3.0
    acceleration: float = 1.0
    yaw_rate: float = radians(120.0)
    turn_g: float = 0.6


DEFAULTS: Final = Limits()


def limited(value: float, limit: float) -> float:
    """`value` within -limit to limit."""
    return min(limit, max(-limit, value))


def or_inf(limit: float) -> float:
    """A parameter's limit, of which 0 means none."""
    return limit if limit > 0.0 else inf


class RoverDynamics:
    """One rover.

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
        last = self._commands[-1] if self._commands else (0.0, self._speed_asked, self._yaw_rate_asked)
        if last[1:] != (speed, yaw_rate):
            self._commands.append((self._time + DELAY_S, speed, yaw_rate))
        for _ in range(count):
            while self._commands and self._commands[0][0] <= self._time + 1e-9:
                _, self._speed_asked, self._yaw_rate_asked = self._commands.popleft()
            if powered:
                self._drive(h, limits)
            else:
                self._roll_out()
            self._move(h)
            self._time += h

    def _drive(self, h: float, limits: Limits) -> None:
        top = or_inf(limits.speed)
        change = or_inf(limits.acceleration) * h
        asked = limited(self._speed_asked, top)
        self._speed_reference += limited(asked - self._speed_reference, change)
        reference = self._speed_reference
        if reference == 0.0 and abs(self.speed) <= STOP_SPEED:
            self._speed_integral = drive = 0.0
        else:
            error = reference - self.speed
            self._speed_integral += SPEED_I * error * h
            drive = SPEED_FEED_FORWARD * reference + SPEED_P * error + self._speed_integral
        self._throttle += (drive - self._throttle) * h / THROTTLE_LAG_S

        most = or_inf(limits.yaw_rate)
        if abs(self.speed) > STOP_SPEED:
            most = min(most, or_inf(limits.turn_g) * GRAVITY / abs(self.speed))
        asked = limited(self._yaw_rate_asked, most)
        self._turn_reference += limited(asked - self._turn_reference, STEERING_ACCELERATION_MAX * h)
        omega = STEERING_FREQUENCY
        error = self._turn_reference - self._turn
        self._turn_slope += (omega * omega * error - 2.0 * STEERING_DAMPING * omega * self._turn_slope) * h
        self._turn += self._turn_slope * h

    def _roll_out(self) -> None:
        self._speed_reference = self._speed_integral = self._throttle = 0.0
        self._turn_reference = self._turn = self._turn_slope = 0.0

    def _move(self, h: float) -> None:
        before, yaw = self.speed, self.yaw
        self.speed += (self._throttle - self.speed) * h / MOTOR_LAG_S
        if self._speed_reference == 0.0 and abs(self.speed) < STANDING and abs(self._throttle) < STANDING:
            self.speed = self._throttle = 0.0
        self.yaw_rate = self._turn + STEERING_LEAD_S * self._turn_slope
        self.yaw += self.yaw_rate * h
        middle, way = 0.5 * (yaw + self.yaw), 0.5 * (before + self.speed) * h
        self.north += way * cos(middle)
        self.east += way * sin(middle)
