"""Scenarios of robots that think seldom, 2 to 15 times a second, as `handfast check` lets them (PURE)."""

from __future__ import annotations

from typing import Final

import tomli_w

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolved
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_faults import draw_faults
from deploy.chaos.draw_formation import draw_shape
from deploy.chaos.draw_obstacles import Reach
from deploy.chaos.profiles import pieces
from deploy.check.braking import MARGIN_M
from deploy.check.check import check
from deploy.check.finding import Finding

RATES_HZ: Final = (2, 3, 4, 5, 6, 8, 10, 12, 15)
ROBOTS: Final = (2, 6)
TROUBLE_S: Final = (6.0, 14.0)
QUIET_S: Final = 12.0
RECOVERED_S: Final = 21.0
CALM_S: Final = 90.0
"""Where nothing happens all are in formation by then, though some want through each other."""
LAG_MAX: Final = 0.5
"""Of a period: so late are actuators at most."""
_TURN_RAD: Final = 0.45
"""Least that V / (L rate) is below: `handfast check` warns from 0.5 on."""
_HORIZON_PERIODS: Final = 8.0


def draw_low_rate(seed: int) -> Tables:
    """The tables of the fleet file of this seed, at the least rate from the drawn one on in which `handfast
    check` finds no error; where nothing happens, nor a place that cannot be kept up with."""
    rate_hz = Dice("rate", seed).pick(RATES_HZ)
    for higher_hz in [each for each in RATES_HZ if each >= rate_hz]:
        tables = _draw(seed, higher_hz)
        fleet = resolved(parse_fleet(tomli_w.dumps(tables), source="scenario"))
        calm = "faults" not in tables
        if not any(each.level == "error" or (calm and _is_too_fast(each)) for each in check(fleet)):
            return tables
    return tables


def _is_too_fast(finding: Finding) -> bool:
    """Whether a formation on its course is not quite in formation, as is foreseen."""
    return finding.level == "warning" and finding.place.startswith("trajectory.")


def _draw(seed: int, rate_hz: float) -> Tables:
    dice = Dice("low-rate", seed)
    safe_m = dice.between(0.2, 0.6, 2)
    control = pieces.draw_control(Dice("control", seed)) | pieces.timeouts(rate_hz)
    control["max_speed_mps"] = speed = dice.between(0.3, 1.5, 2)
    control["prediction_horizon_s"] = round(max(2.0, _HORIZON_PERIODS / rate_hz), 1)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    shape = draw_shape(Dice("shape", seed), ids, safe_m)
    reach_m = round(max(0.1, speed / (_TURN_RAD * rate_hz)), 2)
    trouble_s = dice.between(*TROUBLE_S, 1)
    quiet_s = RECOVERED_S if dice.chance(0.5) else QUIET_S
    has_faults = dice.chance(0.5)
    tables: Tables = {
        "fleet": pieces.fleet(seed, rate_hz, trouble_s + quiet_s if has_faults else CALM_S),
        "formation": pieces.formation(shape, ids, safe_m, assign=dice.chance(0.5)),
        "control": control,
        "trajectory": pieces.draw_trajectory(Dice("trajectory", seed), (0.0, 0.0), speed),
        "robot_defaults": {
            "mass_kg": pieces.MASS_KG,
            # Of a body as long as its hand is far ahead.
            "inertia_kgm2": round(pieces.MASS_KG * (0.3 * reach_m) ** 2 + pieces.INERTIA_KGM2, 2),
            "hand_offset_m": reach_m,
        },
    }
    lags = Dice("lag", seed)
    if lags.chance(0.3):
        lag_s = round(lags.between(0.1, 1.0) * LAG_MAX / rate_hz, 4)
        tables["robot_defaults"]["actuator_lag_s"] = lag_s
        tables["avoidance"] = {"margin_m": round(MARGIN_M + lag_s * speed, 3)}
    apart = pieces.START_FACTOR * safe_m
    side = max(3.0, 1.2 * shape.span, 2.5 * apart * len(ids) ** 0.5)
    tables["robot"] = pieces.robots_about(Dice("robots", seed), ids, (), side, apart, reach_m)
    box = Reach((-0.5 * side, -0.5 * side), (0.5 * side, 0.5 * side))
    rules = draw_faults(Dice("faults", seed), ids, trouble_s, box) if has_faults else []
    if rules:
        tables["faults"] = {"rule": rules}
    return tables
