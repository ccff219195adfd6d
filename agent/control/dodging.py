"""The way out of the way of a body that rolls on, though nothing commands it (PURE).

Who only keeps away along the line between the two drives back in front of it, and is overtaken where that is
as fast. So what the own body can do is followed until the other one rests, and what keeps furthest away is
done. See (S3) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import cos, inf, sin
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.control.hand import PoseTuple

Way = Sequence[Vector]
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


def clearance(body: PoseTuple, move: Move, ways: Sequence[tuple[Way, float]], can: Ability) -> float:
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
    body: PoseTuple, ways: Sequence[tuple[Way, float]], can: Ability, before: Move = STAND
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
