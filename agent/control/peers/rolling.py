"""Where a vehicle rolls that nothing commands any more: on the arc of its last setpoint (PURE).

Its own watchdog stops it, and no setting makes that faster (`agent.fleet.plants.Kind.rolls_on_s`). Until then
it keeps the speed and the yaw rate that it was asked for last. See (S3) of docs/theory.md.
"""

from __future__ import annotations

from math import cos, hypot, sin, tau
from typing import Final, NamedTuple

from agent.common.quantities import Vector
from agent.control.hand import Hand, Pose, hand
from agent.fleet.sections import Robot
from agent.messages.types import HandState, Setpoint

ROLLS: Final = 0.06
"""m/s: a body that is slower is at rest, as far as its estimate tells."""
STOPS_S: Final = 0.5
"""A body that stops by itself goes as far as at its speed in so long, s."""
SPEED_LEADS_S: Final = 0.2
TURN_LEADS_S: Final = 0.05
"""The setpoint that it obeys last is the speed, and the yaw rate, that what acted on it gives it in so long,
s. With these 54 simulated rovers whose bridges were killed in mid-drive came to rest 8 cm from where they
were to, and 18 cm at most."""
ROLL_ERROR: Final = 0.2
"""m: so far off that arc it may be."""
STEPS: Final = 12
"""In so many of them an arc is told."""

Way = list[tuple[float, float, float]]
"""Rows (s since it was heard, x, y), of the hand, m, W."""


class Rolls(NamedTuple):
    """What is known of the body of one that rolls on: for how long at its speed, s, until it has stopped by
    its watchdog; how far ahead of its axle its hand is, m."""

    for_s: float
    reach: float


def rolls_of(robot: Robot) -> Rolls | None:
    """What is known of this robot's body, None for one that does not roll on."""
    rolls_s = robot.kind.rolls_on_s
    return Rolls(rolls_s + STOPS_S, robot.hand_offset_m) if rolls_s else None


def moves(vx: float, vy: float) -> bool:
    """Whether a body of this velocity, m/s, is not at rest."""
    return hypot(vx, vy) > ROLLS


def setpoint(heading: float, speed: float, yaw_rate: float, along: float, spin: float) -> Setpoint:
    """What a body obeys that goes like this, when nothing commands it from now on.

    Args:
        along, spin: what acts on it, m/s^2 along its heading and rad/s^2.
    """
    return Setpoint(heading % tau, speed + SPEED_LEADS_S * along, yaw_rate + TURN_LEADS_S * spin)


def rolled(x: float, y: float, obeys: tuple[float, float, float], reach: float, t: float) -> Hand:
    """A hand that is in (x, y), `t` seconds later, of a body that obeys its last setpoint."""
    heading, speed, yaw_rate = obeys
    half = 0.5 * yaw_rate * t
    chord = speed * t * (sin(half) / half if abs(half) > 1e-6 else 1.0)
    x += chord * cos(heading + half) - reach * cos(heading)
    y += chord * sin(heading + half) - reach * sin(heading)
    return hand(Pose(x, y, heading + 2.0 * half, speed, yaw_rate), reach)


def arc(x: float, y: float, obeys: tuple[float, float, float], rolls: Rolls) -> Way:
    """The way of such a hand to where it rests."""
    times = [k / STEPS * rolls.for_s for k in range(STEPS + 1)]
    return [(t, *rolled(x, y, obeys, rolls.reach, t)[:2]) for t in times]


def middle(way: Way) -> Vector:
    """Of the box round a way: so a robot whose plant is lost says where it is (`OwnHand.lost`)."""
    _, xs, ys = zip(*way, strict=True)
    return 0.5 * (min(xs) + max(xs)), 0.5 * (min(ys) + max(ys))


def is_somewhere_on(message: HandState) -> bool:
    """Whether a message is of a body that went as it says when it was measured last, and is anywhere on that
    way since; its place is the `middle` of that."""
    if not message.obeys or message.following or message.doubt <= ROLL_ERROR:
        return False
    return not moves(message.vx, message.vy)


def arc_of(message: HandState, rolls: Rolls) -> Way:
    """The same from a message. One that does not say what its body obeys rolls straight on."""
    x, y, vx, vy = message.place
    if is_somewhere_on(message):
        mid_x, mid_y = middle(arc(0.0, 0.0, message.obeys[0], rolls))
        return [(0.0, at_x, at_y) for _, at_x, at_y in arc(x - mid_x, y - mid_y, message.obeys[0], rolls)]
    if message.obeys:
        return arc(x, y, message.obeys[0], rolls)
    times = (k / STEPS * rolls.for_s for k in range(STEPS + 1))
    return [(t, x + t * vx, y + t * vy) for t in times]
