"""A simulated unicycle (PURE), exact between ticks, with limits and actuator lag:

    x' = v cos(theta),  y' = v sin(theta),  theta' = w,  m v' = F,  J w' = tau    (1)

Poses are in W (world ENU): m and rad, counter-clockwise from x.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil, cos, exp, inf, sin
from typing import Final, NamedTuple

from handfast.agent.common.models import new
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import Robot
from handfast.agent.messages.types import ACTS_PERIODS
from handfast.plant.backend import COAST, Begin, Command, Reading, VirtualBody

TURN_MAX: Final = 0.5
"""Largest turn (rad) of one quadrature step; with five points its error is below 1e-12 of the path,
as long as an actuator's lag is not much shorter than the step."""
BRAKE_TIME_S: Final = 0.1
"""Time constant of the brake, at least."""
BRAKE_DECELERATION_MAX: Final = 5.0
BRAKE_SPIN_MAX: Final = 50.0
"""The most that the brake does: m/s^2, rad/s^2."""
REST: Final = 1e-6
"""m/s and rad/s: a braking body that is slower stands still."""
SPEED_MAX: Final = 1e3
YAW_RATE_MAX: Final = 1e3
"""m/s, rad/s: a simulated body that is driven beyond these is broken, and says so."""

# Gauss-Legendre on [0, 1], five points: exact for polynomials of degree 9.
_NODES: Final = (
    (0.04691007703066800, 0.11846344252809454),
    (0.23076534494715845, 0.23931433524968324),
    (0.5, 0.28444444444444444),
    (0.76923465505284155, 0.23931433524968324),
    (0.95308992296933200, 0.11846344252809454),
)


class Actuator(NamedTuple):
    """One actuator for one step: `start` is what it gives now, `target` what it was asked for.

    A first-order lag takes it there with time constant `lag` (s); without lag it is there at once.
    """

    start: float
    target: float
    lag: float

    def value(self, t: float) -> float:
        """What it gives (N or N m) after t seconds."""
        return (
            self.target + (self.start - self.target) * exp(-t / self.lag) if self.lag > 0.0 else self.target
        )

    def mean(self, t: float) -> float:
        """What it gives on average in the next t seconds."""
        return self.first_integral(t) / t if self.lag > 0.0 else self.target

    def first_integral(self, t: float) -> float:
        """Its integral over [0, t], t in s: an impulse (N s or N m s)."""
        if self.lag <= 0.0:
            return self.target * t
        return self.target * t + (self.start - self.target) * self.lag * (1.0 - exp(-t / self.lag))


def integrate(pose: Pose, force: Actuator, torque: Actuator, mass: float, inertia: float, dt: float) -> Pose:
    """The unicycle (1) after `dt` seconds, pose in W; mass in kg, inertia in kg m^2, actuators in N and N m.

    Speed, yaw rate and heading have closed forms; with a = target/m, b = (start - target) lag/m:
    v(t) = v + a t + b (1 - exp(-t/lag)), and likewise for the yaw rate and its integral, the heading.
    The position is the integral of v (cos theta, sin theta), by Gauss-Legendre quadrature in steps of
    at most `TURN_MAX` radians.
    """
    speed_end = pose.speed + force.first_integral(dt) / mass
    rate_end = pose.yaw_rate + torque.first_integral(dt) / inertia
    return _moved(pose, force, torque, mass, inertia, dt, speed_end, rate_end)


def _moved(
    pose: Pose,
    force: Actuator,
    torque: Actuator,
    mass: float,
    inertia: float,
    dt: float,
    speed_end: float,
    rate_end: float,
) -> Pose:
    """As `integrate`, to a speed and a yaw rate that are known."""
    x0, y0, heading0, speed0, rate0 = pose
    start, target, lag_a = force
    a, b = target / mass, (start - target) * lag_a / mass
    start, target, lag_c = torque
    spin, c = target / inertia, (start - target) * lag_c / inertia
    steps = max(1, ceil(max(abs(rate0), abs(rate_end)) * dt / TURN_MAX))
    h = dt / steps
    x = y = 0.0
    for number in range(steps):
        for node, weight in _NODES:
            t = (number + node) * h
            speed = speed0 + a * t
            heading = heading0 + (rate0 + 0.5 * spin * t) * t
            if b:
                speed += b * (1.0 - exp(-t / lag_a))
            if c:
                heading += c * (t - lag_c * (1.0 - exp(-t / lag_c)))
            x += weight * speed * cos(heading)
            y += weight * speed * sin(heading)
    heading = heading0 + (rate0 + 0.5 * spin * dt) * dt
    if c:
        heading += c * (dt - lag_c * (1.0 - exp(-dt / lag_c)))
    return new(Pose, (x0 + h * x, y0 + h * y, heading, speed_end, rate_end))


def _limited(value: float, limit: float | None) -> float:
    """`value` within -limit to limit; None: no limit."""
    return value if limit is None else min(limit, max(-limit, value))


class Unicycle(VirtualBody):
    """The simulated body of one robot, a `plant.backend.VirtualBody`.

    Args:
        body: its mass, inertia, limits, lag and start.
        period_s: time between two steps, s; a brake takes at least one.
        timeout_s: it brakes by itself when no step follows for so long, s; what was asked of it acts for two
            periods then. inf: as long as it takes.
    """

    def __init__(self, body: Robot, period_s: float, timeout_s: float = inf) -> None:
        self._body = body
        self._pose = Pose(body.x_m, body.y_m, body.heading_rad, 0.0, 0.0)
        self._force = self._torque = Actuator(0.0, 0.0, 0.0)
        self._gives = 0.0, 0.0
        """What the actuators give now."""
        self._time_ns: int | None = None
        self._period_s, self._timeout_s = period_s, timeout_s
        self._acts_s = ACTS_PERIODS * period_s if timeout_s < inf else inf
        self._brake_time_s = max(BRAKE_TIME_S, period_s)
        self._driving = False
        self._broken = ""

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        if self._time_ns is not None and now_ns > self._time_ns:
            self._move((now_ns - self._time_ns) / NS_PER_S)
        self._time_ns = now_ns
        self._driving = command is not None and not self._broken
        if command is not None and self._driving:
            self._actuate(command, self._body.actuator_lag_s)
        else:
            self._actuate(self._brake(), 0.0)  # a brake is not the motor: it has no lag
        force, torque = self._force, self._torque
        gives = force.mean(self._period_s) if force.lag > 0.0 else force.target
        twists = torque.mean(self._period_s) if torque.lag > 0.0 else torque.target
        broken = self._broken
        return new(Reading, (now_ns, self._pose, gives, twists, not broken, broken, True, None))

    @property
    def pose(self) -> Pose:
        """Where it was (W) at the last step."""
        return self._pose

    def _actuate(self, command: Command, lag: float) -> None:
        """From now on the actuators go from what they give to `command`, within their limits."""
        body = self._body
        force, torque = command
        gives, twists = self._gives
        self._force = new(Actuator, (gives, _limited(force, body.max_force_n), lag))
        self._torque = new(Actuator, (twists, _limited(torque, body.max_torque_nm), lag))

    def _move(self, dt: float) -> None:
        """The body `dt` seconds on, with what was asked of it last.

        A step that comes late (its process was frozen) finds a body that did what it was asked to for two
        periods, drove on without a force for the timeout of a motor's own watchdog, and then braked.
        """
        if self._driving:
            driven = min(dt, self._timeout_s)
            acted = min(driven, self._acts_s)
            self._integrate(acted)
            if driven > acted:
                self._actuate(COAST, self._body.actuator_lag_s)
                self._integrate(driven - acted)
            dt -= driven
            if dt > 0.0:
                self._actuate(self._brake(), 0.0)
        while dt > 0.0 and (self._pose.speed or self._pose.yaw_rate):
            held = min(dt, self._period_s)
            self._integrate(held)
            dt -= held
            if abs(self._pose.speed) < REST and abs(self._pose.yaw_rate) < REST:
                self._pose = self._pose._replace(speed=0.0, yaw_rate=0.0)
            self._actuate(self._brake(), 0.0)

    def _integrate(self, dt: float) -> None:
        """The body `dt` seconds on under the actuators as they are; broken where that is too fast."""
        body, pose, force, torque = self._body, self._pose, self._force, self._torque
        mass, inertia = body.mass_kg, body.inertia_kgm2
        impulse = force.first_integral(dt) if force.lag > 0.0 else force.target * dt
        spin = torque.first_integral(dt) if torque.lag > 0.0 else torque.target * dt
        speed, yaw_rate = pose.speed + impulse / mass, pose.yaw_rate + spin / inertia
        if abs(speed) <= SPEED_MAX and abs(yaw_rate) <= YAW_RATE_MAX:
            self._pose = _moved(pose, force, torque, mass, inertia, dt, speed, yaw_rate)
            self._gives = (
                force.value(dt) if force.lag > 0.0 else force.target,
                torque.value(dt) if torque.lag > 0.0 else torque.target,
            )
        else:  # also when they are not numbers
            self._broken = f"driven to {speed:.3g} m/s and {yaw_rate:.3g} rad/s: no such body holds together"
            self._pose = pose._replace(speed=0.0, yaw_rate=0.0)
            self._gives = 0.0, 0.0

    def _brake(self) -> Command:
        """Force and torque that take speed and yaw rate to zero in a few brake times, and hold them there."""
        body, pose = self._body, self._pose
        deceleration = _limited(-pose.speed / self._brake_time_s, BRAKE_DECELERATION_MAX)
        spin = _limited(-pose.yaw_rate / self._brake_time_s, BRAKE_SPIN_MAX)
        return new(Command, (body.mass_kg * deceleration, body.inertia_kgm2 * spin))

    def close(self) -> None:
        """Nothing: the body is this object."""


def from_fleet(fleet: Fleet, robot: int, at: tuple[float, float, float] | None = None) -> Unicycle:
    """The simulated body of robot `robot`, at its start in the fleet file or at `at` (x, y in m, heading in
    rad, W).

    Raises:
        handfast.agent.fleet.model.FleetError: the fleet has no such robot.
    """
    body = fleet.robot(robot)
    if at is not None:
        x, y, heading = at
        body = replace(body, x_m=x, y_m=y, heading_rad=heading)
    return Unicycle(body, fleet.period_ns / NS_PER_S, fleet.control.wrench_timeout_s)


def begin(fleet: Fleet, robot: int, how: Begin) -> Unicycle:
    """The simulated body of a robot; see `agent.fleet.plants.Kind.body`."""
    return from_fleet(fleet, robot, how.at)
