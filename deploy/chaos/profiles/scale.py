"""Scenarios of small and of large formations, that are taken up from anywhere about them (PURE).

Nothing fails and nothing is ordered: such a fleet is in formation in the end
(`deploy.verdict.oracles_drive.formed`). Lengths in m, W.
"""

from __future__ import annotations

from math import exp, log, pi
from typing import Final

from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import draw_lattice, draw_shape
from deploy.chaos.profiles import pieces

ROBOTS: Final = (2, 9)
SPACING_M: Final = (0.3, 10.0)
"""Least and most between two places."""
SMALL_M: Final = (0.3, 0.8)
"""In half of them: the smaller a formation is, the stiffer its edges are beside the pull to its places."""
SAFE_SHARES: Final = (0.2, 0.45)
"""Least and most of that is the safe distance, and `SAFE_MAX_M` at most."""
SAFE_MAX_M: Final = 1.0
SETTLE_S: Final = 40.0
_RATES_HZ: Final = ((20, 2.0), (25, 1.0))


def draw_scale(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("scale", seed)
    low, high = (log(each) for each in (SPACING_M if dice.chance(0.5) else SMALL_M))
    spacing = round(exp(low + (high - low) * dice.share()), 3)
    safe_m = round(min(SAFE_MAX_M, dice.between(*SAFE_SHARES) * spacing), 3)
    rate_hz = dice.weighted(_RATES_HZ)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    if dice.chance(0.7):
        shape = draw_lattice(Dice("shape", seed), ids, spacing)
    else:
        shape = draw_shape(Dice("shape", seed), ids, safe_m, spacing)
    # A robot's hand is within what its safe distance leaves, and its speed what its hand can follow.
    reach_m = round(min(0.3, max(0.05, 0.4 * safe_m)), 3)
    speed = round(min(dice.between(0.5, 1.5), 0.45 * reach_m * rate_hz), 2)
    apart = pieces.START_FACTOR * safe_m
    side = max(1.5 * shape.span, 2.5 * apart * len(ids) ** 0.5)
    tables: Tables = {
        "fleet": pieces.fleet(seed, rate_hz, SETTLE_S + 2.0 * side / speed),
        "formation": pieces.formation(shape, ids, safe_m, assign=dice.chance(0.5)),
        "control": {"max_speed_mps": speed, "max_acceleration": dice.between(1.5, 5.0, 1)},
        "trajectory": _trajectory(dice, spacing, speed),
        "robot_defaults": pieces.plain_body(reach_m),
    }
    tables["robot"] = pieces.robots_about(Dice("robots", seed), ids, (), side, apart, reach_m)
    return tables


def _trajectory(dice: Dice, spacing: float, speed: float) -> Tables:
    if dice.chance(0.4):
        return {"kind": "hold"}
    slow, angle = dice.between(0.1, 0.4) * speed, 2.0 * pi * dice.share()
    if dice.chance(0.6):
        return pieces.line(slow, angle)
    return pieces.circle(dice, (0.0, 0.0), round(max(1.0, 2.0 * spacing), 2), slow, angle)
