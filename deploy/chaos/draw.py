"""A random scenario from a seed: a whole fleet file, as tables that can be written as TOML (PURE).

What is drawn is what handfast claims to survive, and no more (docs/chaos.md says where the borders are and
why). Robots, formation and trajectory are drawn here, faults and orders in modules of their own. Lengths in
m, W.
"""

from __future__ import annotations

from functools import partial
from math import cos, hypot, pi, sin
from typing import Final

import tomli_w

from agent.fleet.loading import parse_fleet
from agent.formation.trajectory import make_trajectory
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_faults import draw_faults
from deploy.chaos.draw_formation import Shape, draw_shape
from deploy.chaos.draw_obstacles import draw_obstacles, fence_round
from deploy.chaos.draw_orders import draw_orders
from deploy.check.braking import MARGIN_M

ROBOTS_MAX: Final = 12
RESERVE_MAX: Final = 3
MASS_KG: Final = 10.0
INERTIA_KGM2: Final = 0.13
QUIET_S: Final = 12.0
"""Nothing is ordered and nothing fails in so much at the end, where the drive must be what it was to be."""
RECOVERED_S: Final = 21.0
"""So much in some, long enough for the oracle that looks whether all are in formation again."""
TROUBLE_S: Final = (8.0, 18.0)
"""Least and most of the time in which things happen."""
_RATES_HZ: Final = ((20, 3.0), (25, 3.0), (30, 2.0), (40, 1.0), (50, 1.0))
_START_FACTOR: Final = 1.5
"""Least distance of two hands at the start, in safe distances."""


def name_of(seed: int) -> str:
    """The name of a scenario, of its fleet and of its file."""
    return f"chaos-{seed}"


def draw(seed: int) -> Tables:
    """The tables of the fleet file of this scenario."""
    dice = Dice("scenario", seed)
    trouble_s = dice.between(*TROUBLE_S, 1)
    quiet_s = RECOVERED_S if dice.chance(0.5) else QUIET_S
    members = 2 + int((ROBOTS_MAX - 1) * dice.share() ** 1.5)
    spares = dice.whole(0, RESERVE_MAX) if dice.chance(0.7) else 0
    safe_m = dice.between(0.2, 0.4, 2)
    ids = list(range(1, members + spares + 1))
    reserve = set(dice.some(ids, spares))
    places = [robot for robot in ids if robot not in reserve]
    shape = draw_shape(Dice("shape", seed), places, safe_m)
    control = _control(Dice("control", seed))
    trajectory = draw_trajectory(Dice("trajectory", seed), (0.0, 0.0), control["max_speed_mps"])
    tables: Tables = {
        "fleet": {
            "name": name_of(seed),
            "rate_hz": dice.weighted(_RATES_HZ),
            "duration_s": round(trouble_s + quiet_s, 1),
            "seed": seed,
        },
        "formation": {
            "edges": [list(edge) for edge in shape.edges],
            "offsets": [list(shape.offsets[robot]) for robot in places],
            "safe_distance_m": safe_m,
            "assign": dice.chance(0.5),
        },
        "control": control,
        "trajectory": trajectory,
        "robot_defaults": _body(Dice("body", seed), control["max_acceleration"]),
        "robot": [],
    }
    lag_s = tables["robot_defaults"].get("actuator_lag_s", 0.0)
    if lag_s:
        # The safety filter does not know of the lag: its margin has to allow for it.
        tables["avoidance"] = {"margin_m": round(MARGIN_M + lag_s * control["max_speed_mps"], 3)}
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    if dice.chance(0.2):
        tables.setdefault("supervision", {})["deadman_s"] = dice.between(0.5, 2.0, 1)
    tables["robot"] = _robots(Dice("robots", seed), ids, reserve, shape, tables)
    obstacles = draw_obstacles(Dice("obstacles", seed), tables, _way(tables))
    if obstacles:
        tables["obstacle"] = obstacles
    further = partial(draw_trajectory, speed_max=control["max_speed_mps"])
    orders, reach = draw_orders(Dice("orders", seed), tables, trouble_s, further)
    if orders:
        tables["order"] = orders
    if dice.chance(0.3):
        tables["geofence"] = fence_round(Dice("geofence", seed), reach)
    rules = draw_faults(Dice("faults", seed), ids, trouble_s, reach)
    if rules:
        tables["faults"] = {"rule": rules}
    return tables


def _control(dice: Dice) -> Tables:
    control: Tables = {
        "coupling": dice.weighted((("joint", 4.0), ("edge", 1.0))),
        "max_speed_mps": dice.between(0.5, 1.5, 2),
        "max_acceleration": dice.between(1.5, 5.0, 1),
    }
    if dice.chance(0.3):
        control["prediction_horizon_s"] = dice.between(1.0, 3.0, 1)
    return control


def _body(dice: Dice, acceleration: float) -> Tables:
    """A robot's body. The safety filter counts on a body that brakes as it may accelerate: its actuators can
    do more."""
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


def draw_trajectory(dice: Dice, here: tuple[float, float], speed_max: float) -> Tables:
    """A trajectory that begins at or near `here`, of any kind, no faster than two fifths of `speed_max`."""
    kind = dice.weighted((("hold", 1.0), ("line", 3.0), ("circle", 2.0), ("waypoints", 2.0)))
    x, y = here
    speed = dice.between(0.1, 0.4, 2) * speed_max
    angle = 2.0 * pi * dice.share()
    if kind == "hold":
        return {"kind": kind}
    if kind == "line":
        return {"kind": kind, "velocity_mps": [round(speed * cos(angle), 3), round(speed * sin(angle), 3)]}
    if kind == "circle":
        radius = dice.between(1.5, 4.0, 2)
        return {
            "kind": kind,
            "centre_m": [round(x - radius * cos(angle), 3), round(y - radius * sin(angle), 3)],
            "radius_m": radius,
            "speed_mps": round(speed, 3),
            "phase_rad": round(angle, 3),
            "clockwise": dice.chance(0.5),
        }
    points = [[round(x, 3), round(y, 3)]]
    for _ in range(dice.whole(1, 4)):
        angle += dice.between(-2.0, 2.0)
        way = dice.between(1.0, 5.0)
        x, y = x + way * cos(angle), y + way * sin(angle)
        points.append([round(x, 3), round(y, 3)])
    return {"kind": kind, "waypoints_m": points, "speed_mps": round(speed, 3)}


def _robots(dice: Dice, ids: list[int], reserve: set[int], shape: Shape, tables: Tables) -> list[Tables]:
    """Starts: hands apart, near the formation's first place, headings as they come."""
    apart = _START_FACTOR * tables["formation"]["safe_distance_m"]
    length = tables["robot_defaults"]["hand_offset_m"]
    side = max(3.0, 1.2 * shape.span, 2.5 * apart * len(ids) ** 0.5)
    hands: list[tuple[float, float]] = []
    robots: list[Tables] = []
    for robot in ids:
        x, y = _somewhere(dice, side)
        while any(hypot(x - a, y - b) < apart for a, b in hands):
            x, y = _somewhere(dice, side)
        hands.append((x, y))
        heading = dice.between(-pi, pi)
        row: Tables = {
            "id": robot,
            "x_m": round(x - length * cos(heading), 4),
            "y_m": round(y - length * sin(heading), 4),
            "heading_rad": heading,
        }
        if robot in reserve:
            row["reserve"] = True
        robots.append(row)
    return robots


def _way(tables: Tables) -> list[tuple[float, float]]:
    """Where the reference is from second to second."""
    fleet = parse_fleet(tomli_w.dumps(tables), source="scenario")
    trajectory = make_trajectory(fleet.trajectory)
    return [trajectory.at(float(t))[:2] for t in range(int(fleet.fleet.duration_s))]


def _somewhere(dice: Dice, side: float) -> tuple[float, float]:
    return dice.between(-0.5 * side, 0.5 * side), dice.between(-0.5 * side, 0.5 * side)
