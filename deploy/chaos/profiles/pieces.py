"""What profiles draw alike: limits of speed, bodies, courses, rows of robots (PURE). Lengths in m, W."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import cos, dist, pi, sin
from typing import Final

import tomli_w

from agent.common.quantities import Vector
from agent.fleet.loading import parse_fleet
from agent.formation.trajectory import make_trajectory
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import Shape

MASS_KG: Final = 10.0
INERTIA_KGM2: Final = 0.13
START_FACTOR: Final = 1.5
"""Least distance of two hands at the start, in safe distances."""
_TIMEOUT_S: Final = 0.2
"""Of a plant and of a wrench by default."""
_TIMEOUT_PERIODS: Final = 2.5
"""`handfast check` wants at least two."""
_FAST_MPS: Final = (0.7, 1.5)
_REACH_M: Final = (0.1, 0.2)
_TURN_RAD: Final = 0.3
"""V / (L rate) of a fast robot is below it."""


def name_of(seed: int) -> str:
    """The name of a scenario, of its fleet and of its file."""
    return f"chaos-{seed}"


def fleet(seed: int, rate_hz: float, duration_s: float) -> Tables:
    """``[fleet]``."""
    return {"name": name_of(seed), "rate_hz": rate_hz, "duration_s": round(duration_s, 1), "seed": seed}


def draw_control(dice: Dice) -> Tables:
    """``[control]``: how multipliers are found, and limits."""
    control: Tables = {
        "coupling": dice.weighted((("joint", 4.0), ("edge", 1.0))),
        "max_speed_mps": dice.between(0.5, 1.5, 2),
        "max_acceleration": dice.between(1.5, 5.0, 1),
    }
    if dice.chance(0.3):
        control["prediction_horizon_s"] = dice.between(1.0, 3.0, 1)
    return control


def draw_fast_control(dice: Dice, seed: int) -> tuple[Tables, float]:
    """``[control]`` of a fleet whose robots may be fast, and its greatest speed, m/s."""
    control = draw_control(Dice("control", seed))
    control["max_speed_mps"] = speed = dice.between(*_FAST_MPS, 2)
    return control, speed


def draw_reach(dice: Dice, speed: float, rate_hz: float) -> float:
    """L of robots that go so fast (m/s): the hand of one at so low a rate has to be further out."""
    return round(max(dice.between(*_REACH_M), speed / (_TURN_RAD * rate_hz)), 2)


def timeouts(rate_hz: float) -> Tables:
    """Fields of ``[control]`` that a low rate needs; none at a rate that the defaults suit."""
    enough_s = round(_TIMEOUT_PERIODS / rate_hz, 2)
    return {} if enough_s <= _TIMEOUT_S else {"plant_timeout_s": enough_s, "wrench_timeout_s": enough_s}


def plain_body(reach_m: float) -> Tables:
    """``[robot_defaults]`` of a body that does at once whatever it is asked."""
    return {"mass_kg": MASS_KG, "inertia_kgm2": INERTIA_KGM2, "hand_offset_m": reach_m}


def draw_body(dice: Dice, acceleration: float) -> Tables:
    """``[robot_defaults]``. The safety filter counts on a body that brakes as it may accelerate: its
    actuators can do more."""
    reach = dice.between(0.1, 0.2, 2)
    body: Tables = {"mass_kg": MASS_KG, "inertia_kgm2": INERTIA_KGM2, "hand_offset_m": reach}
    if dice.chance(0.4):
        enough = dice.between(1.0, 2.0)
        body["max_force_n"] = round(enough * MASS_KG * acceleration, 1)
        body["max_torque_nm"] = round(enough * INERTIA_KGM2 * acceleration / reach + 0.01, 2)
    if dice.chance(0.3):
        body["actuator_lag_s"] = dice.between(0.0, 0.1)
    if dice.chance(0.3):
        body["position_noise_m"] = dice.between(0.0, 0.005, 4)
        body["heading_noise_rad"] = dice.between(0.0, 0.01, 4)
        body["speed_noise_mps"] = dice.between(0.0, 0.02, 4)
        body["yaw_rate_noise_radps"] = dice.between(0.0, 0.05, 4)
    return body


def draw_trajectory(dice: Dice, here: Vector, speed_max: float) -> Tables:
    """A trajectory that begins at or near `here`, of any kind, no faster than two fifths of `speed_max`."""
    kind = dice.weighted((("hold", 1.0), ("line", 3.0), ("circle", 2.0), ("waypoints", 2.0)))
    x, y = here
    speed = dice.between(0.1, 0.4, 2) * speed_max
    angle = 2.0 * pi * dice.share()
    if kind == "hold":
        return {"kind": kind}
    if kind == "line":
        return line(speed, angle)
    if kind == "circle":
        return circle(dice, here, dice.between(1.5, 4.0, 2), speed, angle)
    points = [[round(x, 3), round(y, 3)]]
    for _ in range(dice.whole(1, 4)):
        angle += dice.between(-2.0, 2.0)
        way = dice.between(1.0, 5.0)
        x, y = x + way * cos(angle), y + way * sin(angle)
        points.append([round(x, 3), round(y, 3)])
    return {"kind": kind, "waypoints_m": points, "speed_mps": round(speed, 3)}


def line(speed: float, angle: float) -> Tables:
    """Straight on from the origin."""
    return {"kind": "line", "velocity_mps": [round(speed * cos(angle), 3), round(speed * sin(angle), 3)]}


def circle(dice: Dice, here: Vector, radius: float, speed: float, angle: float) -> Tables:
    """Round a centre, from `here` on, either way; `angle` is that of `here` as seen from the centre."""
    x, y = here
    return {
        "kind": "circle",
        "centre_m": [round(x - radius * cos(angle), 3), round(y - radius * sin(angle), 3)],
        "radius_m": radius,
        "speed_mps": round(speed, 3),
        "phase_rad": round(angle, 3),
        "clockwise": dice.chance(0.5),
    }


def places_of(tables: Tables) -> list[tuple[float, float]]:
    """Where the reference is from second to second."""
    scenario = parse_fleet(tomli_w.dumps(tables), source="scenario")
    trajectory = make_trajectory(scenario.trajectory)
    return [trajectory.at(float(t))[:2] for t in range(int(scenario.fleet.duration_s))]


def formation(shape: Shape, members: Sequence[int], safe_m: float, *, assign: bool) -> Tables:
    """``[formation]``."""
    return {
        "edges": [list(edge) for edge in shape.edges],
        "offsets": [list(shape.offsets[robot]) for robot in members],
        "safe_distance_m": safe_m,
        "assign": assign,
    }


def meeting(
    seed: int,
    rate_hz: float,
    duration_s: float,
    shape: Shape,
    safe_m: float,
    control: Tables,
    trajectory: Tables,
    reach_m: float,
) -> Tables:
    """A fleet of plain bodies whose places are their own, so that their ways may meet; without robots yet."""
    return {
        "fleet": fleet(seed, rate_hz, duration_s),
        "formation": formation(shape, sorted(shape.offsets), safe_m, assign=False),
        "control": control,
        "trajectory": trajectory,
        "robot_defaults": plain_body(reach_m),
    }


# --- starts ---------------------------------------------------------------------------------------


def robots_about(
    dice: Dice, ids: Sequence[int], reserve: Collection[int], side: float, apart: float, reach: float
) -> list[Tables]:
    """Rows of robots whose hands, `reach` ahead, are in a square of this side about the origin, no two nearer
    than `apart`; headings as they come."""
    hands: list[Vector] = []
    for _ in ids:
        place = _somewhere(dice, side)
        while any(dist(place, other) < apart for other in hands):
            place = _somewhere(dice, side)
        hands.append(place)
    return robots_at(dice, dict(zip(ids, hands, strict=True)), reserve, reach)


def robots_at(
    dice: Dice, hands: Mapping[int, Vector], reserve: Collection[int], reach: float
) -> list[Tables]:
    """Rows of robots with their hands at these places; headings as they come."""
    rows: list[Tables] = []
    for robot, (x, y) in hands.items():
        heading = dice.between(-pi, pi)
        row: Tables = {
            "id": robot,
            "x_m": round(x - reach * cos(heading), 4),
            "y_m": round(y - reach * sin(heading), 4),
            "heading_rad": heading,
        }
        if robot in reserve:
            row["reserve"] = True
        rows.append(row)
    return rows


def scattered(dice: Dice, places: Mapping[int, Vector], off: float, apart: float) -> dict[int, Vector]:
    """Places drawn up to `off` beside these in x and in y, no two nearer than `apart`."""
    hands: dict[int, Vector] = {}
    for robot, (x, y) in places.items():
        while True:
            hand = x + dice.between(-off, off), y + dice.between(-off, off)
            if all(dist(hand, other) >= apart for other in hands.values()):
                break
        hands[robot] = hand
    return hands


def _somewhere(dice: Dice, side: float) -> tuple[float, float]:
    return dice.between(-0.5 * side, 0.5 * side), dice.between(-0.5 * side, 0.5 * side)


def turned(place: Vector, angle: float) -> Vector:
    """A place turned about the origin, counter-clockwise."""
    x, y = place
    return x * cos(angle) - y * sin(angle), x * sin(angle) + y * cos(angle)
