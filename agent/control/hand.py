"""The unicycle and its hand point, eqs (1)-(6).

Pure scalars: one robot has one body. Poses are in W (world ENU), heading counter-clockwise from x.
"""

from __future__ import annotations

from math import cos, exp, sin
from typing import NamedTuple


class Pose(NamedTuple):
    """State of a unicycle (1): x, y (m, W), heading (rad), speed (m/s), yaw rate (rad/s)."""

    x: float
    y: float
    heading: float
    speed: float
    yaw_rate: float


class Hand(NamedTuple):
    """Hand point: position (m, W) and velocity (m/s, W)."""

    x: float
    y: float
    vx: float
    vy: float


def hand(pose: Pose, offset: float) -> Hand:
    """Hand point `offset` = L (m) ahead of the robot's centre, (2)-(3), and its velocity."""
    c, s = cos(pose.heading), sin(pose.heading)
    across = offset * pose.yaw_rate
    return Hand(
        pose.x + offset * c,
        pose.y + offset * s,
        pose.speed * c - across * s,
        pose.speed * s + across * c,
    )


def wrench(
    ux: float, uy: float, pose: Pose, mass: float, inertia: float, offset: float
) -> tuple[float, float]:
    """Force (N) and torque (N m) that give the hand the acceleration (ux, uy), m/s^2, W: (5), (39).

    H^-1 (u - G) written out: along the heading F/m = u.c - (-L w^2), across it L tau/J = u.s - v w.
    """
    c, s = cos(pose.heading), sin(pose.heading)
    along = c * ux + s * uy + offset * pose.yaw_rate * pose.yaw_rate
    across = c * uy - s * ux - pose.speed * pose.yaw_rate
    return mass * along, inertia * across / offset


def advance(pose: Pose, force: float, torque: float, mass: float, inertia: float, dt: float) -> Pose:
    """The body `dt` seconds later under a constant force (N) and torque (N m), from (1).

    Speed, yaw rate and heading are exact; the position is Simpson's rule on the path, whose error
    is of order dt^5: an agent looks at most a few ticks ahead.
    """
    acceleration, spin = force / mass, torque / inertia
    speed, yaw_rate, heading = pose.speed, pose.yaw_rate, pose.heading
    half = 0.5 * dt
    speed_mid = speed + acceleration * half
    speed_end = speed + acceleration * dt
    heading_mid = heading + yaw_rate * half + 0.5 * spin * half * half
    heading_end = heading + yaw_rate * dt + 0.5 * spin * dt * dt
    weight = dt / 6.0
    return Pose(
        pose.x
        + weight * (speed * cos(heading) + 4.0 * speed_mid * cos(heading_mid) + speed_end * cos(heading_end)),
        pose.y
        + weight * (speed * sin(heading) + 4.0 * speed_mid * sin(heading_mid) + speed_end * sin(heading_end)),
        heading_end,
        speed_end,
        yaw_rate + spin * dt,
    )


def braked(pose: Pose, brake_time_s: float, dt: float) -> Pose:
    """The body `dt` seconds later while it brakes: speed and yaw rate die away with a time constant, s, and
    never turn round. It goes along the mean of its headings, which at rest is exact for a body that does not
    turn, and short of that by less than a tenth of the way for one that turns by a radian until it stands.
    """
    remains = exp(-dt / brake_time_s)
    way_s = brake_time_s * (1.0 - remains)
    turn = pose.yaw_rate * way_s
    heading = pose.heading + 0.5 * turn
    return Pose(
        pose.x + pose.speed * way_s * cos(heading),
        pose.y + pose.speed * way_s * sin(heading),
        pose.heading + turn,
        remains * pose.speed,
        remains * pose.yaw_rate,
    )
