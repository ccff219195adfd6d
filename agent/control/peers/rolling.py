"""Where a vehicle rolls that nothing commands any more: on the arc of its last setpoint (PURE).

Its own watchdog stops it, and no setting makes that faster (`agent.fleet.plants.Kind.rolls_on_s`). Until then
it keeps the speed and the yaw rate that it was asked for last. See (S3) of docs/theory.md.
"""

from __future__ import annotations

from math import cos, hypot, sin, tau
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.control.hand import Hand, hand
from handfast.agent.fleet.sections import Robot
from handfast.agent.messages.types import HandState, Setpoint

ROLLS: Final = 0.06
"""m/s: a body that is slower is at rest, as far as its estimate tells."""
STOPS_S: Final = 0.65
"""A body that stops by itself goes as far as at its speed in so long, s."""
SPEED_LAGS: Final = 0.1
TURN_SHARE: Final = 0.95
"""Of an arc at the speed and the yaw rate that it was asked for last: while it takes up that speed it loses
so much of the difference, and so much of the yaw rate it has on average. With these 144 simulated rovers that
were lost in mid-drive, some right after a stop or a resume, came to rest 9 cm from where they were to, and 25
cm at most."""
SPEED_LEADS_S: Final = 0.2
TURN_LEADS_S: Final = 0.05
"""Of one that does not say what it was asked for: the speed, and the yaw rate, that what acted on it gives it
in so long, s. Where it had been stopped just before, that is metres off."""
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


def room_to_know(rolls: float, speed: float, timeout: float, hardest: float, keep: float) -> float:
    """From how far away (m) whoever hears of a body that is lost stands before that comes, if both drive at
    each other: what it rolls, and what the other one drives until it knows of it, and brakes.

    Args:
        rolls: for how long its watchdog has it go on, s.
        speed, hardest: of both, m/s and m/s^2.
        timeout: until it is known, s.
        keep: the distance to keep, m.
    """
    return (rolls + STOPS_S + timeout) * speed + 0.5 * speed * speed / hardest + keep


def moves(vx: float, vy: float) -> bool:
    """Whether a body of this velocity, m/s, is not at rest."""
    return hypot(vx, vy) > ROLLS


def asked(heading: float, speed: float, aim: float, turn: float) -> Setpoint:
    """What a body obeys of this heading and speed, when nothing commands it from now on.

    Args:
        speed: m/s. aim, turn: speed and yaw rate that it was asked for last, m/s and rad/s.
    """
    return Setpoint(heading % tau, aim + SPEED_LAGS * (speed - aim), TURN_SHARE * turn)


def setpoint(heading: float, speed: float, yaw_rate: float, along: float, spin: float) -> Setpoint:
    """The same of one that does not say what it was asked for, by how it goes.

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
    return hand((x, y, heading + 2.0 * half, speed, yaw_rate), reach)


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


def begin_of(message: HandState, rolls: Rolls) -> Vector:
    """Where the hand of such a body was when it was measured last, m, W."""
    mid_x, mid_y = middle(arc(0.0, 0.0, message.obeys[0], rolls))
    return message.x - mid_x, message.y - mid_y


def arc_of(message: HandState, rolls: Rolls) -> Way:
    """The same from a message. One that does not say what its body obeys rolls straight on."""
    x, y, vx, vy = message.place
    if is_somewhere_on(message):
        way = arc(*begin_of(message, rolls), message.obeys[0], rolls)
        return [(0.0, at_x, at_y) for _, at_x, at_y in way]
    if message.obeys:
        return arc(x, y, message.obeys[0], rolls)
    times = (k / STEPS * rolls.for_s for k in range(STEPS + 1))
    return [(t, x + t * vx, y + t * vy) for t in times]
