"""Scenarios of fast formations whose messages are all late, and many lost, all the time (PURE).

What links do never changes, nothing else fails and nothing is ordered: such a fleet is in formation in the
end (`deploy.verdict.oracles_drive.formed`). In some, agents or plants start again, or wrenches do not come,
where there is room: a body brakes then, and the others learn of it late.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import dist, pi
from typing import Final

from agent.common.quantities import Vector
from agent.control.peers.beliefs import said_doubt
from agent.fleet.safety import AvoidanceSection
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import apart_m, draw_shape
from deploy.chaos.profiles import pieces

ROBOTS: Final = (2, 8)
SHARES: Final = (0.4, 0.9)
"""Least and most of the greatest speed."""
DELAY_MAX_MS: Final = 1000
LOSS_MAX: Final = 50.0
ROOM: Final = 1.05
"""Places are so many times as far apart as one behind another has to be."""
DURATION_S: Final = 90.0
"""Robots that want through each other may need several tries."""
ERROR_M: Final = 0.7
"""So far from their places they start, each axis: from rest, behind a course that does not wait."""
RESTARTS: Final = 0.25
"""Share of the scenarios in which agents start again."""
RESTART_S: Final = (25.0, 50.0)
_RATES_HZ: Final = ((15, 2.0), (20, 3.0), (25, 2.0))


def draw_fast(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("fast", seed)
    safe_m = dice.between(0.2, 0.35, 2)
    control = pieces.draw_control(Dice("control", seed))
    control["max_speed_mps"] = top = dice.between(0.8, 1.5, 2)
    control["max_acceleration"] = max(control["max_acceleration"], 2.0 * top)
    control.pop("prediction_horizon_s", None)
    rate_hz = dice.weighted(_RATES_HZ)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    late_s, links = _links(dice)
    speed = dice.between(*SHARES) * top
    places = Dice("shape", seed)
    behind_m = ROOM * _behind_m(safe_m, speed, late_s, control)
    again = Dice("again", seed)
    restarts = _restarts(again, ids) if again.chance(RESTARTS) else []
    if restarts:
        behind_m += top * late_s
    shape = draw_shape(places, ids, safe_m, max(places.between(1.0, 1.8) * apart_m(safe_m), behind_m))
    reach_m = dice.between(0.1, 0.2, 2)
    tables: Tables = {
        "fleet": pieces.fleet(seed, rate_hz, DURATION_S),
        "formation": pieces.formation(shape, ids, safe_m, assign=True),
        "control": control,
        "trajectory": _trajectory(dice, speed, control["max_acceleration"]),
        "robot_defaults": pieces.plain_body(reach_m),
    }
    tables["robot"] = pieces.robots_at(dice, _starts(dice, shape.offsets, safe_m), (), reach_m)
    tables["faults"] = links | ({"rule": restarts} if restarts else {})
    return tables


def _restarts(dice: Dice, ids: list[int]) -> list[Tables]:
    """Agents and plants that start again on the way, when the formation has formed, and wrenches that do not
    come for a while."""
    rules: list[Tables] = []
    for number, robot in enumerate(dice.some(ids, dice.whole(1, 3)), 1):
        rule: Tables = {"name": f"process {number}", "robot": robot, "at": dice.between(*RESTART_S, 2)}
        what = dice.pick(("agent", "plant", "wrench"))
        if what == "wrench":
            rule |= {"topic": "wrench", "loss": "100%", "for": dice.between(0.5, 3.0, 1)}
        elif what == "plant":
            rule |= {"kill": "plant", "for": dice.between(0.5, 4.0, 1)}
        else:
            rule["restart"] = "agent"
        rules.append(rule)
    return rules


def _behind_m(safe_m: float, speed: float, late_s: float, control: Tables) -> float:
    """How far the safety filter keeps a robot behind another, that it can brake when that does, (F4)."""
    rate: float = min(3.0, control["max_acceleration"] / control["max_speed_mps"])
    return safe_m + AvoidanceSection().margin_m + said_doubt(late_s) + speed / rate


def _trajectory(dice: Dice, speed: float, acceleration: float) -> Tables:
    angle = 2.0 * pi * dice.share()
    if dice.chance(0.7):
        return pieces.line(speed, angle)
    radius = max(dice.between(3.0, 8.0), speed**2 / (0.25 * acceleration))
    return pieces.circle(dice, (0.0, 0.0), round(radius, 2), speed, angle)


def _starts(dice: Dice, places: Mapping[int, Vector], safe_m: float) -> dict[int, Vector]:
    """Near the places, `pieces.START_FACTOR` safe distances from each other."""
    starts: dict[int, Vector] = {}
    for robot, (x, y) in places.items():
        while True:
            place = x + dice.between(-ERROR_M, ERROR_M), y + dice.between(-ERROR_M, ERROR_M)
            if all(dist(place, other) > pieces.START_FACTOR * safe_m for other in starts.values()):
                break
        starts[robot] = place
    return starts


def _links(dice: Dice) -> tuple[float, Tables]:
    """How late messages are at most, s, and ``[faults]``: for all between robots, all the time."""
    delay_ms, jitter_ms = dice.whole(0, DELAY_MAX_MS), 0
    faults: Tables = {}
    if delay_ms:
        jitter_ms = dice.whole(0, delay_ms // 4)
        if dice.chance(0.6):
            jitter_ms = 0
        faults["delay"] = f"{delay_ms}ms {jitter_ms}ms" if jitter_ms else f"{delay_ms}ms"
    if dice.chance(0.7):
        faults["loss"] = f"{dice.between(1.0, LOSS_MAX, 1):g}%"
    return (delay_ms + jitter_ms) / 1e3, faults
