"""Does what says when hand states are sent suit the fleet: noise, rate, horizon, law."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, pi, sqrt
from typing import Final

from handfast.agent.control.event_trigger import LOOKAHEAD_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import SEND_BOUND_M, Robot
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.wording import robots

QUIET: Final = 2.5
"""A bound so many times as large as what noise makes of predictions on average is seldom exceeded by it."""


def check_sending(fleet: Fleet) -> Iterator[Finding]:
    """What makes event-sent hand states pointless, or dangerous."""
    control = fleet.control
    if control.send == "periodic":
        return
    if not control.prediction:
        yield Finding(
            "warning",
            "control.prediction",
            "false: neighbours expect a robot to stay where its last hand state left it, so it sends one in "
            "every period in which it moves",
        )
    if control.law is not None:
        yield Finding(
            "info",
            "control.law",
            "what a law of others will ask for nobody can predict: a robot sends a hand state in every "
            "period in which the law asks for more than navigation does, or changes its numbers; and all "
            "keep further from a robot, the longer it is silent",
        )
    yield from _check_noise(fleet)


def _check_noise(fleet: Fleet) -> Iterator[Finding]:
    off = {robot.id: _off(fleet, robot) for robot in fleet.robots}
    noisy = [robot for robot, by in off.items() if QUIET * by > SEND_BOUND_M]
    if not noisy:
        return
    worst = max(noisy, key=lambda robot: off[robot])
    yield Finding(
        "warning",
        "control.send",
        f"measurement noise alone puts predictions of {robots(noisy)} off by {off[worst]:.2g} m on average: "
        'they send hand states in nearly every period, as with "periodic"',
    )


def _off(fleet: Fleet, robot: Robot) -> float:
    """How far noise puts a prediction off on average by the measure of (E1), m."""
    control, reach = fleet.control, robot.hand_offset_m
    place = hypot(robot.position_noise_m, reach * robot.heading_noise_rad)
    velocity = hypot(robot.speed_noise_mps, reach * robot.yaw_rate_noise_radps)
    force = hypot(max(control.c1, control.kp) * place, max(control.c2, control.kd) * velocity)
    # Of the difference of two draws, each of two axes: the mean of a Rayleigh distribution.
    mean = sqrt(2.0) * sqrt(0.5 * pi)
    return mean * (place + LOOKAHEAD_S * velocity + 0.5 * LOOKAHEAD_S * LOOKAHEAD_S * force)
