"""A simulated unicycle, eq. (1): exact between ticks, with limits, actuator lag and measurement noise.

Pure. Poses are in W (world ENU).
"""

from __future__ import annotations

from math import ceil, cos, exp, sin
from typing import Final, NamedTuple

from agent import draws
from agent.clock import NS_PER_S
from agent.fleet import Fleet, Robot
from agent.hand import Pose
from plant.backend import Command, Reading

TURN_MAX: Final = 0.5
"""Largest turn (rad) of one quadrature step; with five points its error is below 1e-12 of the path."""
BRAKE_TIME_S: Final = 0.1
BRAKE_DECELERATION_MAX: Final = 5.0
BRAKE_SPIN_MAX: Final = 50.0

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
        """What it gives at time t."""
        return (
            self.target + (self.start - self.target) * exp(-t / self.lag) if self.lag > 0.0 else self.target
        )

    def first_integral(self, t: float) -> float:
        """Its integral over [0, t]: an impulse, for a speed."""
        if self.lag <= 0.0:
            return self.target * t
        return self.target * t + (self.start - self.target) * self.lag * (1.0 - exp(-t / self.lag))

    def second_integral(self, t: float) -> float:
        """The integral of `first_integral` over [0, t], for an angle."""
        if self.lag <= 0.0:
            return 0.5 * self.target * t * t
        rest = t - self.lag * (1.0 - exp(-t / self.lag))
        return 0.5 * self.target * t * t + (self.start - self.target) * self.lag * rest


def integrate(pose: Pose, force: Actuator, torque: Actuator, mass: float, inertia: float, dt: float) -> Pose:
    """The unicycle (1) after `dt` seconds.

    Speed, yaw rate and heading have closed forms. The position is the integral of
    v (cos theta, sin theta), by Gauss-Legendre quadrature in steps of at most `TURN_MAX` radians.
    """
    rate_end = pose.yaw_rate + torque.first_integral(dt) / inertia
    turn = max(abs(pose.yaw_rate), abs(rate_end)) * dt
    steps = max(1, ceil(turn / TURN_MAX))
    h = dt / steps
    x = y = 0.0
    for number in range(steps):
        for node, weight in _NODES:
            t = (number + node) * h
            heading = pose.heading + pose.yaw_rate * t + torque.second_integral(t) / inertia
            length = weight * (pose.speed + force.first_integral(t) / mass)
            x += length * cos(heading)
            y += length * sin(heading)
    return Pose(
        pose.x + h * x,
        pose.y + h * y,
        pose.heading + pose.yaw_rate * dt + torque.second_integral(dt) / inertia,
        pose.speed + force.first_integral(dt) / mass,
        rate_end,
    )


def _limited(value: float, limit: float | None) -> float:
    return value if limit is None else min(limit, max(-limit, value))


class Unicycle:
    """The simulated body of one robot, a `plant.backend.PlantBackend`.

    Args:
        body: its mass, inertia, limits, lag, noise and start.
        period_s: time between two steps; a brake takes at least one.
        seed: of the measurement noise; each robot's and each step's draw is its own.
    """

    def __init__(self, body: Robot, period_s: float, seed: int) -> None:
        self._body = body
        self._pose = Pose(body.x_m, body.y_m, body.heading_rad, 0.0, 0.0)
        self._force = self._torque = Actuator(0.0, 0.0, 0.0)
        self._time_ns: int | None = None
        self._brake_time_s = max(BRAKE_TIME_S, period_s)
        self._noise = (
            body.position_noise_m,
            body.position_noise_m,
            body.heading_noise_rad,
            body.speed_noise_mps,
            body.yaw_rate_noise_radps,
        )
        self._streams = [
            draws.stream(seed, "plant", body.id, quantity)
            for quantity in ("x", "y", "heading", "speed", "yaw rate")
        ]
        self._steps = 0

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """See `PlantBackend.step`."""
        body = self._body
        force_now = torque_now = 0.0
        if self._time_ns is not None and now_ns > self._time_ns:
            dt = (now_ns - self._time_ns) / NS_PER_S
            self._pose = integrate(self._pose, self._force, self._torque, body.mass_kg, body.inertia_kgm2, dt)
            force_now, torque_now = self._force.value(dt), self._torque.value(dt)
        self._time_ns = now_ns
        if command is None:
            force, torque, lag = *self._brake(), 0.0  # a brake is not the motor: it has no lag
        else:
            force, torque, lag = *command, body.actuator_lag_s
        force, torque = _limited(force, body.max_force_n), _limited(torque, body.max_torque_nm)
        self._force, self._torque = Actuator(force_now, force, lag), Actuator(torque_now, torque, lag)
        pose, truth = self._measured()
        self._steps += 1
        return Reading(now_ns, pose, self._force.value(0.0), self._torque.value(0.0), truth=truth)

    def _brake(self) -> tuple[float, float]:
        """Force and torque that take speed and yaw rate to zero in a few brake times, and hold them there."""
        body, pose = self._body, self._pose
        deceleration = _limited(-pose.speed / self._brake_time_s, BRAKE_DECELERATION_MAX)
        spin = _limited(-pose.yaw_rate / self._brake_time_s, BRAKE_SPIN_MAX)
        return body.mass_kg * deceleration, body.inertia_kgm2 * spin

    def _measured(self) -> tuple[Pose, Pose | None]:
        if not any(self._noise):
            return self._pose, None
        noisy = [
            value + deviation * draws.normal(stream, self._steps)
            for value, deviation, stream in zip(self._pose, self._noise, self._streams, strict=True)
        ]
        return Pose._make(noisy), self._pose

    def close(self) -> None:
        """Nothing to let go of: the body is this object."""


def from_fleet(fleet: Fleet, robot: int) -> Unicycle:
    """The simulated body of robot `robot`, as the fleet file has it."""
    return Unicycle(fleet.robot(robot), fleet.period_ns / NS_PER_S, fleet.fleet.seed)
