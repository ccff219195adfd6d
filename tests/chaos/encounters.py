"""Vehicles that roll on without commands, aimed at others. Lengths in m, frame W, times in s.

Few faults that are drawn at random matter here: in none of 160 such scenarios did a rolling vehicle come near
another. So a robot dies when it is on its path towards another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import permutations
from math import dist, hypot
from typing import Final, NamedTuple

from handfast.agent.common.quantities import Vector
from handfast.agent.control.peers.rolling import room_to_know
from handfast.agent.fleet.plants import KINDS
from tests.chaos.dice import Tables
from tests.chaos.layout import draw_near
from tests.chaos.scene import Scene

_STEP_S: Final = 0.1
_DIES: Final = tuple(range(5, 71, 3))
"""When a robot dies, in steps."""
_CUT_LATER: Final = (2, 5, 8, 11)
"""How much later the other one is cut off, in steps."""
_ROLLS: Final = tuple(range(10, 36))
"""How long it rolls, in steps. Nobody can evade a vehicle within the first second."""
_MEETS_M: Final = 1.0
_GAIN: Final = 0.6
"""Speed towards the place over distance from it, 1/s."""
_DRAWS: Final = 8
_CROWD: Final = 6
_DOWN_S: Final = (0.3, 8.0)
_EVADABLE: Final = 0.85
"""Minimum distance of the other robot, in shares of what it takes to stop before the vehicle comes."""
_ROLLED_S: Final = 4.5
"""Minimum time from the death of a vehicle to a stop: stopped robots do not evade it."""


class Encounter(NamedTuple):
    """`rolls` dies at `at_s` and rolls at `other`, `apart_m` away then, which may be cut off at `cut_s`."""

    rolls: int
    other: int
    at_s: float
    cut_s: float
    apart_m: float


def encounters(starts: Mapping[int, Vector], places: Mapping[int, Vector], speed: float) -> list[Encounter]:
    """Find encounters of robots that drive straight from `starts` to `places` at up to `speed` (m/s)."""
    steps = max(_DIES) + max(_CUT_LATER) + 1
    paths = {robot: list(_path(starts[robot], places[robot], speed, steps)) for robot in starts}
    found = []
    for rolls, other in permutations(paths, 2):
        for at in _DIES:
            (x, y), (x1, y1) = paths[rolls][at : at + 2]
            rolled = [(x + k * (x1 - x), y + k * (y1 - y)) for k in _ROLLS]
            apart_m = dist((x, y), paths[other][at])
            for later in _CUT_LATER:
                stands = paths[other][at + later]
                if dist((x, y), stands) > _MEETS_M and any(dist(each, stands) < _MEETS_M for each in rolled):
                    times = round(at * _STEP_S, 1), round((at + later) * _STEP_S, 1)
                    found.append(Encounter(rolls, other, *times, apart_m))
    return found


def _path(start: Vector, place: Vector, speed: float, steps: int) -> Iterator[Vector]:
    x, y = start
    for _ in range(steps + 1):
        yield x, y
        dx, dy = place[0] - x, place[1] - y
        share = min(_GAIN, speed / max(hypot(dx, dy), 1e-9)) * _STEP_S
        x, y = x + share * dx, y + share * dy


def draw_rolling(scene: Scene) -> None:
    """End bridges or agents of rovers while robots come together; then an operator may resume all."""
    dice = scene.dice
    crowd = len(scene.members) >= _CROWD
    kind = dice.weighted((
        ("any", 3.0), ("head on", 2.0), ("cut off", 3.0 * crowd), ("missed", 3.0 * crowd),
    ))  # fmt: skip
    if kind == "missed":
        _missed(scene)
    elif kind == "any" or not _aimed(scene, cuts=kind == "cut off"):
        first, second = dice.some(scene.members, 2)
        at = dice.between(0.5, 7.0, 2)
        _ended(scene, first, at)
        if len(scene.members) >= 4 and dice.chance(0.3):
            _ended(scene, second, round(at + dice.between(0.0, 3.0), 2))
    if dice.chance(0.6):
        resume_s = round(scene.last_s + dice.between(1.0, 6.0), 2)
        rolled_s = max(rule["at"] for rule in scene.rules) + _ROLLED_S
        if rolled_s < resume_s - 0.5 and dice.chance(0.5):
            scene.add_order({"at": dice.between(rolled_s, resume_s - 0.5, 2), "kind": "stop"})
        scene.add_order({"at": resume_s, "kind": "resume"})
    if kind == "missed":
        scene.last_s += 6.0  # it comes past there later


def _ended(scene: Scene, robot: int, at: float) -> None:
    """End a robot's bridge, its agent or both for a while, or for good; pause them; or cut it off."""
    dice = scene.dice
    role = dice.weighted((("plant", 4.0), ("both", 4.0), ("agent", 1.0)))
    what = dice.weighted((("kill", 5.0), ("pause", 1.0), ("for good", 1.0), ("partition", 1.0)))
    if what == "partition":
        _cut_off(scene, robot, at, dice.between(*_DOWN_S, 2))
    elif what == "for good":
        scene.add_rule("process", {"robot": robot, "kill": role, "at": at})
    else:
        scene.add_rule("process", {"robot": robot, what: role, "at": at, "for": dice.between(*_DOWN_S, 2)})


def _cut_off(scene: Scene, robot: int, at: float, lasts: float) -> None:
    scene.add_rule("cut", {"partition": f"alone {robot}", "at": at, "for": lasts})


def _aimed(scene: Scene, *, cuts: bool) -> bool:
    """Have a vehicle roll at a robot that is cut off, or at one that can evade it; False if none can."""
    dice, speed, offsets = scene.dice, scene.speed, scene.shape.offsets
    rolls_s = KINDS["mavlink"].rolls_on_s
    room_m = 0.0 if cuts else _EVADABLE * room_to_know(rolls_s, speed, 0.5, scene.acceleration, scene.safe_m)
    met: list[Encounter] = []
    for _ in range(_DRAWS):
        scene.starts = draw_near(dice, offsets, scene.preset.scatter_m, scene.preset.apart_m)
        met = [each for each in encounters(scene.starts, offsets, speed) if each.apart_m > room_m]
        if met:
            break
    else:
        return False
    one = dice.pick(met)
    rule: Tables = {"robot": one.rolls, "kill": dice.pick(("plant", "both")), "at": one.at_s}
    if not cuts and dice.chance(0.5):  # it speeds up again when it dies
        stop_s = round(max(0.1, one.at_s - dice.between(0.2, 0.6)), 2)
        resume_s = round(stop_s + dice.between(0.2, 0.6), 2)
        scene.add_order({"at": stop_s, "kind": "stop"})
        scene.add_order({"at": resume_s, "kind": "resume"})
        rule["at"] = round(resume_s + dice.between(0.3, 1.0), 2)
    scene.add_rule("rolls", rule | ({"for": dice.between(*_DOWN_S, 2)} if dice.chance(0.7) else {}))
    if cuts:
        _cut_off(scene, one.other, one.cut_s, dice.between(1.0, 6.0, 2))
    return True


def _missed(scene: Scene) -> None:
    """Have one vehicle roll, and another robot learn of that only from others."""
    dice = scene.dice
    rolls, misses = dice.pick(list(permutations(dice.some(scene.members, 2))))
    begins_s, lasts = dice.between(0.2, 2.0, 2), dice.between(2.0, 6.0, 2)
    at = round(begins_s + dice.between(0.1, 1.0, 2), 2)
    scene.add_rule("rolls", {"robot": rolls, "kill": dice.pick(("plant", "both")), "at": at})
    if dice.chance(0.7):
        _cut_off(scene, misses, begins_s, lasts)
    else:
        scene.add_rule("process", {"robot": misses, "kill": "agent", "at": begins_s, "for": lasts})
