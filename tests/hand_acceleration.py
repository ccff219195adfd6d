"""How a hand point accelerates under a wrench: the equation that `agent.control.hand.wrench` inverts."""

from __future__ import annotations

from math import cos, sin

from agent.control.hand import Pose


def hand_acceleration(
    force: float, torque: float, pose: Pose, mass: float, inertia: float, offset: float
) -> tuple[float, float]:
    """Acceleration of the hand (m/s^2, W) under a force (N) and a torque (N m): G + H [F, tau], (4)."""
    c, s = cos(pose.heading), sin(pose.heading)
    along = force / mass - offset * pose.yaw_rate * pose.yaw_rate
    across = offset * torque / inertia + pose.speed * pose.yaw_rate
    return along * c - across * s, along * s + across * c
