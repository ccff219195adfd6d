"""Runaway vehicles: where one rolls that nothing commands any more, and how to evade it (PURE).

Such a vehicle moves on the arc of its last setpoint: it keeps the speed and the yaw rate that it was asked
for last until its own watchdog stops it, and no setting makes that faster
(`agent.fleet.plants.Kind.rolls_on_s`).

A robot that only keeps away along the line between the two drives back in front of the vehicle, which
overtakes it. So the moves that the own body can make are followed until the vehicle rests, and the one that
keeps furthest away is taken. See (S3) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import cos, hypot, inf, sin, tau
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.control.hand import Hand, PoseTuple, hand
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


Track = Sequence[Vector]
"""Where a body is every `STEP_S` from now on, until it rests; m, W."""


class Move(NamedTuple):
    """Shares, -1 to 1, of the greatest speed and yaw rate to make for. (A class: of a pair of numbers, which
    is compiled, what other modules take was never set.)"""

    speed: float
    turn: float


STEP_S: Final = 0.1
"""Between two places that are compared."""
TURN_MAX: Final = 1.0
"""rad/s: a body turns no faster to get out of the way."""
TURNS_S: Final = 0.2
"""In so long it takes up a yaw rate, as far as its acceleration allows."""
CLEAR_M: Final = 0.3
"""So much more than has to be kept is as good as more."""
BETTER_M: Final = 0.02
"""A move is better by so much, or is not taken..."""
KEEPS_M: Final = 0.1
"""...and what it does already is as good as one that is better by so much."""
STAND: Final = Move(0.0, 0.0)
MOVES: Final = (STAND, *(Move(*each) for each in product((0.0, 1.0, -1.0), (0.0, 1.0, -1.0)) if any(each)))


class Ability(NamedTuple):
    """What the own body can do: m/s^2, m/s, rad/s; how far ahead of its axle its hand is, m."""

    hardest: float
    most: float
    turns: float
    reach: float


def clearance(body: PoseTuple, move: Move, ways: Sequence[tuple[Track, float]], can: Ability) -> float:
    """By how much more than it has to be, at least, the hand of a body keeps from others, m, at such a move.

    Args:
        move: of `MOVES`.
        ways: of each other one, where it is every `STEP_S` from now on, m, W; and the distance to keep, m.
    """
    x, y, heading, speed, turn = body
    reach, hardest = can.reach, can.hardest
    aim, aim_turn = move.speed * can.most, move.turn * can.turns
    least = inf
    for k in range(max(len(way) for way, _ in ways)):
        c, s = cos(heading), sin(heading)
        hand_x, hand_y = x + reach * c, y + reach * s
        for way, gap in ways:
            there_x, there_y = way[k] if k < len(way) else way[-1]
            apart = ((hand_x - there_x) ** 2 + (hand_y - there_y) ** 2) ** 0.5 - gap
            if apart < least:
                least = apart
        along, spin = (aim - speed) / STEP_S, (aim_turn - turn) / TURNS_S
        along = hardest if along > hardest else -hardest if along < -hardest else along
        bias, across = -reach * turn * turn, reach * spin + speed * turn
        size = ((along + bias) ** 2 + across * across) ** 0.5 / hardest
        if size > 1.0:
            along, spin = (along + bias) / size - bias, (across / size - speed * turn) / reach
        speed += STEP_S * along
        turn += STEP_S * spin
        heading += STEP_S * turn
        x, y = x + STEP_S * speed * c, y + STEP_S * speed * s
    return least


def acceleration(body: PoseTuple, move: Move, can: Ability) -> Vector:
    """What such a move is for the hand at first, m/s^2, W; no more than `hardest`."""
    _, _, heading, speed, turn = body
    along = max(-can.hardest, min(can.hardest, (move.speed * can.most - speed) / STEP_S))
    across = can.reach * (move.turn * can.turns - turn) / TURNS_S
    along, across = along - can.reach * turn * turn, across + speed * turn
    size = max(1.0, (along * along + across * across) ** 0.5 / can.hardest)
    c, s = cos(heading), sin(heading)
    return (along * c - across * s) / size, (along * s + across * c) / size


def out_of_the_way(
    body: PoseTuple, ways: Sequence[tuple[Track, float]], can: Ability, before: Move = STAND
) -> Move:
    """Which of `MOVES` keeps away from bodies that roll on; `STAND` where that does.

    Args:
        before: what it did so far: half way round it does not turn back for little.
    """
    best = clearance(body, STAND, ways, can)
    if best >= 0.0:
        return STAND
    found = STAND
    for move in MOVES[1:]:
        apart = min(clearance(body, move, ways, can), CLEAR_M)
        if move == before:
            apart += KEEPS_M
        if apart > best + BETTER_M:
            best, found = apart, move
    return found
