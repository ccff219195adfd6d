"""Scenarios with a little of everything: many robots, short trouble of every kind, then quiet (PURE)."""

from __future__ import annotations

from functools import partial
from typing import Final

from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_faults import draw_faults
from deploy.chaos.draw_formation import draw_shape
from deploy.chaos.draw_obstacles import draw_obstacles, fence_round
from deploy.chaos.draw_orders import draw_orders
from deploy.chaos.profiles import pieces
from deploy.check.braking import MARGIN_M

ROBOTS_MAX: Final = 12
RESERVE_MAX: Final = 3
QUIET_S: Final = 12.0
"""Nothing is ordered and nothing fails in so much at the end, where the drive must be what it was to be."""
RECOVERED_S: Final = 21.0
"""So much in some, long enough for the oracle that looks whether all are in formation again."""
TROUBLE_S: Final = (8.0, 18.0)
"""Least and most of the time in which things happen."""
_RATES_HZ: Final = ((20, 3.0), (25, 3.0), (30, 2.0), (40, 1.0), (50, 1.0))


def draw_mixed(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
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
    control = pieces.draw_control(Dice("control", seed))
    trajectory = pieces.draw_trajectory(Dice("trajectory", seed), (0.0, 0.0), control["max_speed_mps"])
    rate_hz = dice.weighted(_RATES_HZ)
    tables: Tables = {
        "fleet": pieces.fleet(seed, rate_hz, trouble_s + quiet_s),
        "formation": pieces.formation(shape, places, safe_m, assign=dice.chance(0.5)),
        "control": control,
        "trajectory": trajectory,
        "robot_defaults": pieces.draw_body(Dice("body", seed), control["max_acceleration"]),
    }
    lag_s = tables["robot_defaults"].get("actuator_lag_s", 0.0)
    if lag_s:
        # The safety filter does not know of the lag: its margin has to allow for it.
        tables["avoidance"] = {"margin_m": round(MARGIN_M + lag_s * control["max_speed_mps"], 3)}
    if dice.chance(0.2):
        tables["supervision"] = {"silence": "hold"}
    if dice.chance(0.2):
        tables.setdefault("supervision", {})["deadman_s"] = dice.between(0.5, 2.0, 1)
    apart = pieces.START_FACTOR * safe_m
    side = max(3.0, 1.2 * shape.span, 2.5 * apart * len(ids) ** 0.5)
    reach_m = tables["robot_defaults"]["hand_offset_m"]
    tables["robot"] = pieces.robots_about(Dice("robots", seed), ids, reserve, side, apart, reach_m)
    obstacles = draw_obstacles(Dice("obstacles", seed), tables, pieces.places_of(tables))
    if obstacles:
        tables["obstacle"] = obstacles
    further = partial(pieces.draw_trajectory, speed_max=control["max_speed_mps"])
    orders, reach = draw_orders(Dice("orders", seed), tables, trouble_s, further)
    if orders:
        tables["order"] = orders
    if dice.chance(0.3):
        tables["geofence"] = fence_round(Dice("geofence", seed), reach)
    rules = draw_faults(Dice("faults", seed), ids, trouble_s, reach)
    if rules:
        tables["faults"] = {"rule": rules}
    return tables
