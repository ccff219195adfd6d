"""Turns wrenches into the forward speed and yaw rate that a rover is asked for (PURE).

The agent drives a body with v' = F/m and w' = tau/J (`agent.control.hand`). A rover takes speeds and follows
them late. So that body is kept here as a *reference*: its speed and yaw rate are what the wrenches integrate
to. The rover is made to track it by a *lead*: what is sent is where the reference will be when the rover gets
there,

    speed = v_r + (T_v + dt/2) a_r,    yaw rate = w_r + (T_w + dt/2) w_r',

with dt/2 for a command that is held for a period. The reference cannot run away from the rover: what the
measured motion lacks of what the commands should have made of it
(`bridges.mavlink.bridge.estimate.Residual`, which ordinary lag does not show in) pulls it back, and it stays
within a band about the estimate.

What the agent gets is the reference's speed and yaw rate, with which its double integrator is an exact one;
but where the rover's own differ by more than a dead band, those, less that band. With the measured ones alone
a formation that stands would be pushed about by the phantom speed that an EKF reports at rest (errors of
7 cm, not 1); with the reference alone, rovers that are slower than they should be come nearer to each other
on the way.

Everything is FLU: forward and counter-clockwise are positive. SI units.
"""

from __future__ import annotations

from math import isfinite
from typing import Final, NamedTuple

from handfast.agent.control.hand import Pose
from handfast.agent.supervision.state_machine import REST_SPEED
from handfast.bridges.mavlink.ardupilot.dynamics import (
    DEFAULTS,
    GRAVITY,
    STEERING_ACCELERATION_MAX,
    limited,
    or_inf,
)
from handfast.bridges.mavlink.bridge.estimate import Residual
from handfast.plant.backend import Command

LEAD_SPEED_S: Final = 0.15
LEAD_YAW_S: Final = 0.02
"""T_v and T_w."""
REPORT_DEAD_BAND: Final = (0.06, 0.05)
"""m/s, rad/s by which the rover's motion may differ from the reference before the agent sees it."""
PULL: Final = 1.0
"""1/s: how fast the reference gives way to what the rover does."""
SPEED_DEAD_BAND: Final = 0.1
YAW_RATE_DEAD_BAND: Final = 0.15
"""m/s, rad/s: less residual than this is an estimator's error or a loop's; at rest the EKF reports up to
0.05 m/s, and a reference that followed that would push the formation out of shape."""
SPEED_BAND: Final = 0.5
YAW_RATE_BAND: Final = 0.8
"""m/s, rad/s: the reference is never further from the estimate."""
YAW_RATE_NOISE: Final = 0.03
"""rad/s: a rover that brakes and is measured turning slower than this does not turn."""
STEP_MAX_S: Final = 0.2

DISAGREES_S: Final = 3.0
SPEED_DISAGREES: Final = 0.15
YAW_RATE_DISAGREES: Final = 0.25
SHARE_DISAGREES: Final = 0.6
"""The rover does not follow when for so long its speed or yaw rate has been so far from that predicted: by
this much (m/s, rad/s), and by this share of it. A slope or tall grass slows it by less."""


class Bounds(NamedTuple):
    """What the fleet file allows: m/s, m/s^2, rad/s."""

    speed: float = 1.0
    acceleration: float = 0.8
    yaw_rate: float = 1.0


class Setpoint:
    """The reference of one rover.

    Args:
        mass, inertia: kg, kg m^2, of the body that the agent drives.
        bounds: of what is asked for. The rover's own limits (`vehicle`) hold as well.
        lead_speed_s, lead_yaw_s: T_v and T_w.
        report_dead_band: see `REPORT_DEAD_BAND`.

    Attributes:
        speed, yaw_rate: what the agent gets, m/s, rad/s.
        force, torque: N, N m, that act on it from now on, after limits.
        vehicle: what the rover's parameters allow.
        note: "" or why nothing was asked for although there was a command.
    """

    def __init__(
        self,
        mass: float,
        inertia: float,
        bounds: Bounds,
        *,
        lead_speed_s: float = LEAD_SPEED_S,
        lead_yaw_s: float = LEAD_YAW_S,
        report_dead_band: tuple[float, float] = REPORT_DEAD_BAND,
    ) -> None:
        self._mass, self._inertia, self._bounds = mass, inertia, bounds
        self._lead_speed_s, self._lead_yaw_s = lead_speed_s, lead_yaw_s
        self._report_dead_band = report_dead_band
        self.vehicle = DEFAULTS
        self.speed = self.yaw_rate = 0.0
        self.force = self.torque = 0.0
        self.note = ""
        self._speed = self._yaw_rate = 0.0
        self._acceleration = self._spin = 0.0

    def step(self, dt: float, command: Command | None, pose: Pose, residual: Residual) -> tuple[float, float]:
        """Speed and yaw rate to ask for now.

        Args:
            dt: since the last step, s.
            command: force and torque from now on; None to brake. One that is not finite brakes too.
            pose: the estimate now (`bridges.mavlink.bridge.estimate.Estimate.pose_at`).
            residual: of that estimate.
        """
        self.note = ""
        if command is not None and not all(map(isfinite, (*command, pose.speed, pose.yaw_rate, *residual))):
            command, self.note = None, "asked for a force or torque that is not a number: braking"
        if command is None:
            self._stand(pose)
            return 0.0, 0.0
        dt = min(max(dt, 0.0), STEP_MAX_S)
        top, acceleration_max, yaw_rate_max, spin_max = self._limits()

        acceleration = limited(command.force / self._mass, acceleration_max)
        spin = limited(command.torque / self._inertia, spin_max)
        speed = _followed(
            self._speed + self._acceleration * dt, pose.speed, residual.speed, SPEED_DEAD_BAND, SPEED_BAND, dt
        )
        yaw_rate = _followed(
            self._yaw_rate + self._spin * dt,
            pose.yaw_rate,
            residual.yaw_rate,
            YAW_RATE_DEAD_BAND,
            YAW_RATE_BAND,
            dt,
        )
        speed, yaw_rate = limited(speed, top), limited(yaw_rate, yaw_rate_max)
        # At a limit nothing acts that would drive the reference over it.
        self._acceleration = 0.0 if abs(speed) >= top and acceleration * speed > 0.0 else acceleration
        self._spin = 0.0 if abs(yaw_rate) >= yaw_rate_max and spin * yaw_rate > 0.0 else spin
        self._speed, self._yaw_rate = speed, yaw_rate
        self.speed = speed + beyond_dead_band(pose.speed - speed, self._report_dead_band[0])
        self.yaw_rate = yaw_rate + beyond_dead_band(pose.yaw_rate - yaw_rate, self._report_dead_band[1])
        self.force, self.torque = self._mass * self._acceleration, self._inertia * self._spin
        return (
            limited(speed + (self._lead_speed_s + 0.5 * dt) * self._acceleration, top),
            limited(yaw_rate + (self._lead_yaw_s + 0.5 * dt) * self._spin, yaw_rate_max),
        )

    def _limits(self) -> tuple[float, float, float, float]:
        """Of speed, acceleration, yaw rate and spin."""
        bounds, vehicle = self._bounds, self.vehicle
        top = min(bounds.speed, or_inf(vehicle.speed))
        sideways = or_inf(vehicle.turn_g) * GRAVITY / max(abs(self._speed), 1e-3)
        return (
            top,
            min(bounds.acceleration, or_inf(vehicle.acceleration)),
            min(bounds.yaw_rate, or_inf(vehicle.yaw_rate), sideways),
            STEERING_ACCELERATION_MAX,
        )

    def _stand(self, pose: Pose) -> None:
        """The reference is where the rover is, so that taking up again is without a jerk."""
        speed = pose.speed if isfinite(pose.speed) else 0.0
        yaw_rate = pose.yaw_rate if isfinite(pose.yaw_rate) else 0.0
        self.speed = self._speed = speed if abs(speed) > REST_SPEED else 0.0
        self.yaw_rate = self._yaw_rate = yaw_rate if abs(yaw_rate) > YAW_RATE_NOISE else 0.0
        self.force = self.torque = self._acceleration = self._spin = 0.0


def beyond_dead_band(value: float, dead: float) -> float:
    """What `value` has outside a dead band of -dead to dead; 0 within it."""
    return value - limited(value, dead)


def _followed(
    reference: float, estimate: float, residual: float, dead: float, band: float, dt: float
) -> float:
    """The reference, pulled towards what the rover does."""
    reference += PULL * dt * beyond_dead_band(residual, dead)
    return limited(reference - estimate, band) + estimate


class MotionCheck:
    """Confirms commands by the motion that follows."""

    def __init__(self) -> None:
        self._for_s = 0.0
        self._note = ""

    def step(self, dt: float, driving: bool, predicted: tuple[float, float], residual: Residual) -> str:
        """What the rover does instead of what it is told; empty while it does that.

        Args:
            dt: since the last step, s.
            driving: False while nothing is asked of it.
            predicted: speed (m/s) and yaw rate (rad/s) that the commands should have made by then.
            residual: measured minus predicted, of the same instants.
        """
        if not driving:
            self._for_s, self._note = 0.0, ""
            return ""
        speed, yaw_rate = predicted
        note = ""
        if abs(residual.speed) > max(SPEED_DISAGREES, SHARE_DISAGREES * abs(speed)):
            note = f"asked for {speed:.2f} m/s, moves at {round(speed + residual.speed, 2) + 0.0:.2f} m/s"
        elif abs(residual.yaw_rate) > max(YAW_RATE_DISAGREES, SHARE_DISAGREES * abs(yaw_rate)):
            turns = round(yaw_rate + residual.yaw_rate, 2) + 0.0  # no -0.00
            note = f"asked for {yaw_rate:.2f} rad/s, turns at {turns:.2f} rad/s"
        # Forgotten as slowly as it is found: a rover whose wheels grip now and then is still stuck.
        self._for_s = min(DISAGREES_S, self._for_s + dt) if note else max(0.0, self._for_s - dt)
        if note and self._for_s >= DISAGREES_S - 1e-9:
            self._note = f"does not follow its commands: {note}"
        elif self._for_s == 0.0:
            self._note = ""
        return self._note
