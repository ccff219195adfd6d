"""Where another robot is by now: its last message carried forward in time (PURE).

A robot's navigation loop is linear and known, so with its last constraint force dying away as an edge's
error does it is carried forward exactly over the age of its message (docs/theory.md, P1).
"""

from __future__ import annotations

from math import cos, exp, expm1, hypot, sin, sqrt
from typing import Final

from handfast.agent.common.quantities import DISTANCE_MIN, Vector
from handfast.agent.control.law import acting_error, firmness
from handfast.agent.formation.trajectory import Sample
from handfast.agent.messages.types import HandState

BRAKING_TIME_S: Final = 0.2
"""A robot that brakes is taken to lose its speed with this time constant."""

Transition = tuple[float, float, float, float, float, float, float]
"""What `transition` returns: (a11, a12, a21, a22, b1, b2, remains)."""
Place = tuple[float, float, float, float]
"""Where a robot is, m, and how fast, m/s, W: (x, y, vx, vy)."""


def constraint_decay(kd: float, kp: float) -> float:
    """How fast a neighbour's constraint force is taken to die away, 1/s: as the edges' own errors do (J1).

    The slower root of s^2 + kd s + kp; 0 for kp = 0, where nothing pulls an edge's error back.
    """
    root = kd * kd - 4.0 * kp
    if root <= 0.0:
        return 0.5 * kd
    return 2.0 * kp / (kd + sqrt(root)) if kd > 0.0 else 0.0


def transition(c1: float, c2: float, decay: float, age: float) -> Transition:
    """Exact step of e'' = -c1 e - c2 e' + F_c exp(-decay t) over `age` seconds, (P1).

    Returns (a11, a12, a21, a22, b1, b2, remains) with [e; e'] <- [[a11, a12], [a21, a22]] [e; e'] +
    [b1; b2] F_c, and F_c <- remains F_c. c1 > 0, decay >= 0.
    """
    # c and s are cos and sin / omega (or cosh and sinh / omega, or 1 and age) with the decay in them:
    # of two real roots each keeps its own exponential, for cosh would overflow.
    sigma = 0.5 * c2
    discriminant = sigma * sigma - c1
    omega = sqrt(abs(discriminant))
    if discriminant < 0.0:
        shrunk = exp(-sigma * age)
        c, s = shrunk * cos(omega * age), shrunk * sin(omega * age) / omega
    elif discriminant > 0.0:
        slow, fast = exp((omega - sigma) * age), exp(-(omega + sigma) * age)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / omega
    else:
        c = exp(-sigma * age)
        s = age * c
    a11, a22 = c + sigma * s, c - sigma * s
    # A particular solution is F_c exp(-decay t) / (decay^2 - c2 decay + c1). At a root of that there is
    # none of this form, and the solution of a decay beside it is the same to six digits.
    divisor = decay * decay - c2 * decay + c1
    if abs(divisor) < 1e-9 * (c1 + decay * decay):
        return transition(c1, c2, decay * (1.0 + 1e-5), age)
    remains = exp(-decay * age)
    b1 = (remains - a11 + decay * s) / divisor
    b2 = (-decay * remains + c1 * s + decay * a22) / divisor
    return a11, s, -c1 * s, a22, b1, b2, remains


class Prediction:
    """One robot at one instant, vectors (x, y) in W.

    position m, velocity m/s, navigation force F_n with what is left of its correction, and constraint
    force F_c, m/s^2.
    """

    __slots__ = "constraint", "navigation", "position", "velocity"

    def __init__(self, position: Vector, velocity: Vector, navigation: Vector, constraint: Vector) -> None:
        self.position: Final = position
        self.velocity: Final = velocity
        self.navigation: Final = navigation
        self.constraint: Final = constraint


def following(
    message: HandState,
    then: Sample,
    since: Sample,
    age: float,
    c1: float,
    c2: float,
    decay: float,
    most: float | None,
    speeding: float,
    step: Transition,
) -> Prediction:
    """A robot that follows the law, `age` seconds after its message.

    Args:
        message: its last.
        then: its desired motion at the instant that is asked for.
        since: its desired motion at the message's time.
        c1, c2: its navigation gains (21).
        decay: of its constraint force, 1/s.
        most: speed limit (m/s) by which it makes for its place (N1), None without one.
        speeding: how fast it comes to that from far, 1/s, (N2).
        step: `transition` of these.
    """
    fx, fy, gx, gy = message.constraint_x, message.constraint_y, message.correction_x, message.correction_y
    x0, y0, vx0, vy0, _, _ = since
    x1, y1, vx1, vy1, ax1, ay1 = then
    ex, ey, edot_x, edot_y = message.x - x0, message.y - y0, message.vx - vx0, message.vy - vy0
    if most is not None:
        acting_x, acting_y = acting_error((ex, ey), (vx1, vy1), c1, c2, most)
        if acting_x != ex or acting_y != ey:
            acting = acting_x, acting_y
            firm = firmness((ex, ey), acting, (vx1, vy1), c1, c2, most, speeding)
            c1, c2 = firm * c1, firm * c2
            return _approaching(message, then, (ex, ey), (edot_x, edot_y), age, c1, c2, decay, acting)
    a11, a12, a21, a22, b1, b2, remains = step
    force_x, force_y = fx + gx, fy + gy
    new_x, new_y = a11 * ex + a12 * edot_x + b1 * force_x, a11 * ey + a12 * edot_y + b1 * force_y
    new_vx, new_vy = a21 * ex + a22 * edot_x + b2 * force_x, a21 * ey + a22 * edot_y + b2 * force_y
    return Prediction(
        (x1 + new_x, y1 + new_y),
        (vx1 + new_vx, vy1 + new_vy),
        (
            ax1 - c1 * new_x - c2 * new_vx + remains * gx,
            ay1 - c1 * new_y - c2 * new_vy + remains * gy,
        ),
        (remains * fx, remains * fy),
    )


def unforced(
    place: Place,
    then: Sample,
    since: Sample,
    age: float,
    c1: float,
    c2: float,
    most: float | None,
    speeding: float,
    step: Transition,
) -> Place:
    """Where a robot is on which no forces act but those of navigation, and how fast, by (P1) and (N2): to the
    bit what `following` says of it, in half of the time.

    Args:
        place: where it was `age` seconds ago, m, and how fast, m/s, W; the others as there.
        step: `transition` of c1, c2 and `age` without a decay.
    """
    x, y, vx, vy = place
    x0, y0, vx0, vy0, _, _ = since
    x1, y1, vx1, vy1, _, _ = then
    ex, ey, edot_x, edot_y = x - x0, y - y0, vx - vx0, vy - vy0
    if most is not None:
        acting_x, acting_y = acting_error((ex, ey), (vx1, vy1), c1, c2, most)
        if acting_x != ex or acting_y != ey:
            firm = firmness((ex, ey), (acting_x, acting_y), (vx1, vy1), c1, c2, most, speeding)
            c1, c2 = firm * c1, firm * c2
            left, rise = _fading(c2, age)
            aim_x, aim_y = -c1 * acting_x / c2, -c1 * acting_y / c2
            return (
                x1 + (ex + aim_x * age + (edot_x - aim_x) * rise),
                y1 + (ey + aim_y * age + (edot_y - aim_y) * rise),
                vx1 + (aim_x + (edot_x - aim_x) * left),
                vy1 + (aim_y + (edot_y - aim_y) * left),
            )
    a11, a12, a21, a22, _, _, _ = step
    return (
        x1 + (a11 * ex + a12 * edot_x),
        y1 + (a11 * ey + a12 * edot_y),
        vx1 + (a21 * ex + a22 * edot_x),
        vy1 + (a21 * ey + a22 * edot_y),
    )


def _fading(c2: float, age: float) -> Vector:
    """What is left after `age` seconds of a speed that fades by c2 (1/s), and how far it has led, s: both for
    each m/s of it."""
    return exp(-c2 * age), -expm1(-c2 * age) / c2


def slowed(
    found: Prediction, message: HandState, then: Sample, since: Sample, age: float, most: float
) -> Prediction:
    """A robot that goes no faster than `most` as seen from its place, (P3).

    Args:
        found: where it would be, from its message on by (P1).
        then, since: its reference at the time of `found` and at that of its message, m, m/s, W.
        age: between the two, s; `most`: m/s.
    """
    ex, ey = message.x - since[0], message.y - since[1]
    dx, dy = found.position[0] - then[0] - ex, found.position[1] - then[1] - ey
    share = min(1.0, most * age / max(hypot(dx, dy), DISTANCE_MIN))
    vx, vy = found.velocity[0] - then[2], found.velocity[1] - then[3]
    part = min(1.0, most / max(hypot(vx, vy), DISTANCE_MIN)) if share < 1.0 else 1.0
    return Prediction(
        (then[0] + ex + share * dx, then[1] + ey + share * dy),
        (then[2] + part * vx, then[3] + part * vy),
        found.navigation,
        found.constraint,
    )


def _approaching(
    message: HandState,
    then: Sample,
    error: Vector,
    rate: Vector,
    age: float,
    c1: float,
    c2: float,
    decay: float,
    acting: Vector,
) -> Prediction:
    """As `following`, of one that is too far from its place for (21): its pull c1 `acting` is constant (N1).

    edot' = -c1 acting - c2 edot + F_c exp(-decay t), exactly; the pull is that at the start, and so is how
    firm it is (N2), which is in the gains.
    """
    if (
        abs(c2 - decay) < 1e-5 * c2
    ):  # the quotients below are 0 / 0: a decay beside it has the limit to five digits
        decay = (1.0 - 1e-5) * c2
    left, rise = _fading(c2, age)
    remains = exp(-decay * age)
    faded = -expm1(-decay * age) / decay if decay > 0.0 else age
    # Integrals of the force's part.
    of_speed, of_place = (remains - left) / (c2 - decay), (faded - rise) / (c2 - decay)
    fx, fy, gx, gy = message.constraint_x, message.constraint_y, message.correction_x, message.correction_y
    force_x, force_y = fx + gx, fy + gy
    (ex, ey), (edot_x, edot_y) = error, rate
    aim_x, aim_y = -c1 * acting[0] / c2, -c1 * acting[1] / c2
    speed_x = aim_x + (edot_x - aim_x) * left + force_x * of_speed
    speed_y = aim_y + (edot_y - aim_y) * left + force_y * of_speed
    place_x = ex + aim_x * age + (edot_x - aim_x) * rise + force_x * of_place
    place_y = ey + aim_y * age + (edot_y - aim_y) * rise + force_y * of_place
    x, y, vx, vy, ax, ay = then
    return Prediction(
        (x + place_x, y + place_y),
        (vx + speed_x, vy + speed_y),
        (ax + (c2 * (aim_x - speed_x) + remains * gx), ay + (c2 * (aim_y - speed_y) + remains * gy)),
        (remains * fx, remains * fy),
    )


def coasting(message: HandState, age: float) -> Prediction:
    """A robot that brakes, `age` seconds later: its speed dies away, whatever the law would ask of it.

    What brakes it stands as its navigation force, so that law and safety filter take it into account.
    """
    remains = exp(-age / BRAKING_TIME_S)
    way = BRAKING_TIME_S * (1.0 - remains)
    vx, vy = remains * message.vx, remains * message.vy
    position = message.x + way * message.vx, message.y + way * message.vy
    return Prediction(position, (vx, vy), (-vx / BRAKING_TIME_S, -vy / BRAKING_TIME_S), (0.0, 0.0))


def as_it_came(message: HandState) -> Prediction:
    """A robot where its message says, as if that had come at once."""
    if not message.following:
        return coasting(message, 0.0)
    return Prediction(
        (message.x, message.y),
        (message.vx, message.vy),
        (message.navigation_x + message.correction_x, message.navigation_y + message.correction_y),
        (message.constraint_x, message.constraint_y),
    )
