"""How a hand point accelerates under a wrench: the equation that `agent.control.hand.wrench` inverts."""

from __future__ import annotations

from math import cos, sin

from handfast.agent.control.hand import PoseTuple


def hand_acceleration(
    force: float, torque: float, pose: PoseTuple, mass: float, inertia: float, offset: float
) -> tuple[float, float]:
    """Acceleration of the hand (m/s^2, W) under a force (N) and a torque (N m): G + H [F, tau], (4)."""
    _, _, heading, speed, yaw_rate = pose
    c, s = cos(heading), sin(heading)
    along = force / mass - offset * yaw_rate * yaw_rate
    across = offset * torque / inertia + speed * yaw_rate
    return along * c - across * s, along * s + across * c
