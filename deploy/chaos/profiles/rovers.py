"""Scenarios of rovers whose bridges, agents or computers die while they drive (PURE). Lengths in m, W.

A vehicle that nothing commands rolls on for seconds (`agent.fleet.plants.Kind.rolls_on_s`): others have to
keep away from where it goes, though nobody hears it. They come together from anywhere about their places, so
their ways cross and they turn hard; some are told to go on later, as an operator would.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from agent.common.quantities import Vector
from agent.control.peers.rolling import room_to_know
from agent.fleet.plants import KINDS
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import draw_lattice
from deploy.chaos.profiles import pieces
from deploy.chaos.profiles.encounters import Encounter, encounters

ROBOTS: Final = (2, 6)
SAFE_M: Final = 1.0
SPACING_M: Final = (2.6, 3.2)
SCATTER_M: Final = 5.0
"""Hands start so far beside their places in x and in y at most..."""
APART_M: Final = 2.0
"""...and so far from each other at least."""
REACH_M: Final = 0.4
SPEED_MPS: Final = (0.6, 0.9)
COURSE_SHARES: Final = (0.0, 0.4)
"""Least and most of the greatest speed that the course has."""
RATE_HZ: Final = 20
DIES_S: Final = (0.5, 7.0)
DOWN_S: Final = (0.3, 8.0)
SECOND: Final = 0.3
"""Share of the scenarios in which something happens to another one soon after..."""
SECOND_OF: Final = 4
"""...of so many robots at least: two that nobody commands may roll into each other."""
CUT_OFF: Final = 0.4
"""Share of the scenarios in which one dies that rolls at another, who hears nobody, and nobody it, soon
after..."""
CUT_OFF_OF: Final = 6
"""In a crowd: who hears nobody has to keep away from where each of them may be..."""
CUT_OFF_S: Final = (1.0, 6.0)
"""...for so long: it knows that this one rolls, and not what the others do."""
MISSED: Final = 0.5
"""Of those, such where another one misses how it dies, as it is cut off or has ended..."""
MISSED_BEFORE_S: Final = (0.1, 1.0)
"""...from so long before..."""
MISSED_S: Final = (2.0, 6.0)
"""...for so long: it has it from others where that one may be..."""
MISSED_QUIET_S: Final = 12.0
"""...and comes past there later."""
HEAD_ON: Final = 0.4
"""Share of the others in which one dies that rolls at another, who hears it..."""
STARTS: Final = 8
"""...as far as one of so many draws of where they start has that..."""
FROM: Final = 0.85
"""...from so large a share at least of where it could just stop before it comes: it has to get out of its
way, and can."""
ACCELERATION: Final = 0.8
TIMEOUT_S: Final = 0.5
STOPPED: Final = 0.5
ROLLED_S: Final = 4.5
"""Share of those in which an operator stops all before, so long at least after the last that happens: whom
he has stopped stands, though a vehicle rolls at it."""
ORDERED: Final = 0.6
"""Share of the scenarios in which an operator tells all to go on..."""
ORDERED_S: Final = (1.0, 6.0)
"""...so long after the last of them is back."""
QUIET_S: Final = 6.0
_KIND: Final = next(name for name, kind in KINDS.items() if kind.rolls_on_s)
_DATUM: Final = {"latitude_deg": -35.363261, "longitude_deg": 149.16523, "altitude_m": 584.0}


def draw_rovers(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("rovers", seed)
    aimed = Dice("rovers cut off", seed)
    cuts = aimed.chance(CUT_OFF)
    ids = list(range(1, (CUT_OFF_OF if cuts else dice.whole(*ROBOTS)) + 1))
    shape = draw_lattice(Dice("shape", seed), ids, dice.between(*SPACING_M, 1))
    speed = dice.between(*SPEED_MPS, 2)
    course = pieces.line(dice.between(*COURSE_SHARES) * speed, dice.between(0.0, 6.283))
    first, second = dice.some(ids, 2)
    rules = [_rule(dice, 1, first, dice.between(*DIES_S, 2))]
    if dice.chance(SECOND) and len(ids) >= SECOND_OF:
        rules.append(_rule(dice, 2, second, round(rules[0]["at"] + dice.between(0.0, 3.0), 2)))
    hands: Mapping[int, Vector] = {}
    met: list[Encounter] = []
    for _ in range(1 if cuts else STARTS if aimed.chance(HEAD_ON) else 0):
        hands = pieces.scattered(aimed, shape.offsets, SCATTER_M, APART_M)
        if met := _met(hands, shape.offsets, speed, cuts=cuts):
            break
    missed = cuts and aimed.chance(MISSED)
    if missed:
        rules = _missed(aimed, *aimed.some(ids, 2))
    orders: list[Tables] = []
    if met and not missed:
        rules = _aimed(aimed, aimed.pick(met), cuts=cuts)
        if not cuts and aimed.chance(STOPPED):
            orders = _stopped_before(aimed, rules[0])
    last_s = max(rule["at"] + rule.get("for", 0.0) for rule in rules)
    if dice.chance(ORDERED):
        last_s = round(last_s + dice.between(*ORDERED_S), 2)
        rolled_s = max(rule["at"] for rule in rules) + ROLLED_S
        if rolled_s < last_s - 0.5 and dice.chance(STOPPED):
            orders.append({"at": dice.between(rolled_s, last_s - 0.5, 2), "kind": "stop"})
        orders.append({"at": last_s, "kind": "resume"})
    control: Tables = {
        "kp": 1.0, "c1": 0.6, "c2": 1.0, "kd": 1.8, "k2": 5.0,
        "max_speed_mps": speed, "max_acceleration": ACCELERATION,
        "plant_timeout_s": TIMEOUT_S, "wrench_timeout_s": 0.25,
    }  # fmt: skip
    vehicle = {
        "connection": "simulator",
        "max_speed_mps": speed, "max_acceleration": ACCELERATION, "max_yaw_rate_radps": 1.0,
    }  # fmt: skip
    hands = hands or pieces.scattered(dice, shape.offsets, SCATTER_M, APART_M)
    body = {"mass_kg": 20.0, "inertia_kgm2": 1.2, "hand_offset_m": REACH_M}
    tables: Tables = {
        "fleet": pieces.fleet(seed, RATE_HZ, last_s + (MISSED_QUIET_S if missed else QUIET_S)),
        "datum": dict(_DATUM),
        "formation": pieces.formation(shape, ids, SAFE_M, assign=False),
        "control": control,
        "trajectory": course,
        "robot_defaults": {"plant": _KIND, **body, _KIND: vehicle},
        "robot": pieces.robots_at(dice, hands, (), REACH_M),
        "faults": {"rule": rules},
    }
    if orders:
        tables["order"] = orders
    return tables


def _rule(dice: Dice, number: int, robot: int, at: float) -> Tables:
    """What happens to one robot: its bridge, its agent or both end for a while, or for good, or stand; or
    nobody hears it, and it nobody."""
    role = dice.weighted((("plant", 4.0), ("both", 4.0), ("agent", 1.0)))
    what = dice.weighted((("kill", 5.0), ("pause", 1.0), ("for good", 1.0), ("partition", 1.0)))
    rule: Tables = {"name": f"process {number}", "robot": robot, "at": at}
    if what == "for good":
        return rule | {"kill": role}
    down_s = dice.between(*DOWN_S, 2)
    if what == "partition":
        return _cut_off(f"links {number}", robot, at, down_s)
    return rule | {what: role, "for": down_s}


def _met(
    hands: Mapping[int, Vector], places: Mapping[int, Vector], speed: float, *, cuts: bool
) -> list[Encounter]:
    """Who meets whom; of those that hear each other, from far enough away."""
    met = encounters(hands, places, speed)
    if cuts:
        return met
    room = FROM * room_to_know(KINDS[_KIND].rolls_on_s, speed, TIMEOUT_S, ACCELERATION, SAFE_M)
    return [each for each in met if each.apart_m > room]


def _aimed(dice: Dice, met: Encounter, *, cuts: bool) -> list[Tables]:
    """One that rolls at another, which is cut off, or is not."""
    kill = {"robot": met.rolls, "kill": dice.pick(("plant", "both")), "at": met.at_s}
    lasts = {"for": dice.between(*DOWN_S, 2)} if dice.chance(0.7) else {}
    rolls = {"name": "rolls", **kill, **lasts}
    if not cuts:
        return [rolls]
    return [rolls, _cut_off("links of whom it meets", met.other, met.cut_s, dice.between(*CUT_OFF_S, 2))]


def _stopped_before(dice: Dice, rolls: Tables) -> list[Tables]:
    """A stop and a resume after which it takes up its speed again, when it dies: by how it goes then nobody
    could tell how fast it will be."""
    stop_s = round(max(0.1, rolls["at"] - dice.between(0.2, 0.6)), 2)
    resume_s = round(stop_s + dice.between(0.2, 0.6), 2)
    rolls["at"] = round(resume_s + dice.between(0.3, 1.0), 2)
    return [{"at": stop_s, "kind": "stop"}, {"at": resume_s, "kind": "resume"}]


def _missed(dice: Dice, one: int, other: int) -> list[Tables]:
    """One dies, and another hears that from others alone."""
    rolls, misses = dice.pick(((one, other), (other, one)))
    before_s = dice.between(*MISSED_BEFORE_S, 2)
    at_s, for_s = round(before_s + dice.between(0.2, 2.0), 2), dice.between(*MISSED_S, 2)
    kill = {"name": "rolls", "robot": rolls, "kill": dice.pick(("plant", "both")), "at": at_s}
    begins_s = round(at_s - before_s, 2)
    if dice.chance(0.7):
        return [kill, _cut_off("links of who misses it", misses, begins_s, for_s)]
    return [kill, {"name": "misses it", "robot": misses, "kill": "agent", "at": begins_s, "for": for_s}]


def _cut_off(name: str, robot: int, at_s: float, for_s: float) -> Tables:
    return {"name": name, "partition": f"alone {robot}", "at": at_s, "for": for_s}
