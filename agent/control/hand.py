"""The unicycle and its hand point, eqs (1)-(6).

Pure scalars: one robot has one body. Poses are in W (world ENU), heading counter-clockwise from x.
"""

from __future__ import annotations

from math import cos, exp, sin
from typing import NamedTuple

from handfast.agent.common.models import new


class Pose(NamedTuple):
    """State of a unicycle (1): x, y (m, W), heading (rad), speed (m/s), yaw rate (rad/s)."""

    x: float
    y: float
    heading: float
    speed: float
    yaw_rate: float


PoseTuple = tuple[float, float, float, float, float]
"""A `Pose` without its names, (x, y, heading, speed, yaw rate), in the same units and frame: what a tick
makes several of and computes with."""


class Hand(NamedTuple):
    """Hand point: position (m, W) and velocity (m/s, W)."""

    x: float
    y: float
    vx: float
    vy: float


def hand(pose: PoseTuple, offset: float) -> Hand:
    """Hand point `offset` = L (m) ahead of the robot's centre, (2)-(3), and its velocity."""
    x, y, heading, speed, yaw_rate = pose
    c, s = cos(heading), sin(heading)
    across = offset * yaw_rate
    return new(Hand, (x + offset * c, y + offset * s, speed * c - across * s, speed * s + across * c))


def wrench(
    ux: float, uy: float, pose: PoseTuple, mass: float, inertia: float, offset: float
) -> tuple[float, float]:
    """Force (N) and torque (N m) that give the hand the acceleration (ux, uy), m/s^2, W: (5), (39).

    H^-1 (u - G) written out: along the heading F/m = u.c - (-L w^2), across it L tau/J = u.s - v w.
    """
    _, _, heading, speed, yaw_rate = pose
    c, s = cos(heading), sin(heading)
    along = c * ux + s * uy + offset * yaw_rate * yaw_rate
    across = c * uy - s * ux - speed * yaw_rate
    return mass * along, inertia * across / offset


def advance(
    pose: PoseTuple, force: float, torque: float, mass: float, inertia: float, dt: float
) -> PoseTuple:
    """The body `dt` seconds later under a constant force (N) and torque (N m), from (1).

    Speed, yaw rate and heading are exact; the position is Simpson's rule on the path, whose error
    is of order dt^5: an agent looks at most a few ticks ahead.
    """
    acceleration, spin = force / mass, torque / inertia
    x, y, heading, speed, yaw_rate = pose
    half = 0.5 * dt
    speed_mid = speed + acceleration * half
    speed_end = speed + acceleration * dt
    heading_mid = heading + yaw_rate * half + 0.5 * spin * half * half
    heading_end = heading + yaw_rate * dt + 0.5 * spin * dt * dt
    weight, mid = dt / 6.0, 4.0 * speed_mid
    return (
        x + weight * (speed * cos(heading) + mid * cos(heading_mid) + speed_end * cos(heading_end)),
        y + weight * (speed * sin(heading) + mid * sin(heading_mid) + speed_end * sin(heading_end)),
        heading_end,
        speed_end,
        yaw_rate + spin * dt,
    )


def braked(pose: PoseTuple, brake_time_s: float, dt: float) -> PoseTuple:
    """The body `dt` seconds later while it brakes: speed and yaw rate die away with a time constant, s, and
    never turn round. It goes along the mean of its headings, which at rest is exact for a body that does not
    turn, and short of that by less than a tenth of the way for one that turns by a radian until it stands.
    """
    remains = exp(-dt / brake_time_s)
    way_s = brake_time_s * (1.0 - remains)
    x, y, heading, speed, yaw_rate = pose
    turn = yaw_rate * way_s
    along = heading + 0.5 * turn
    return (
        x + speed * way_s * cos(along),
        y + speed * way_s * sin(along),
        heading + turn,
        remains * speed,
        remains * yaw_rate,
    )
