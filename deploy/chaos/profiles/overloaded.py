"""Scenarios on machines that have too much to do: each process stands now and then, and others go on (PURE).

Many drive close together and fast for that: a robot whose plant does not hear its agent for its timeout
brakes amid others that go on, and who follows it has to know. Links are whole, or lose a little and are late.
Lengths in m, W.
"""

from __future__ import annotations

from math import pi
from typing import Final

from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_formation import draw_lattice
from deploy.chaos.profiles import pieces

ROBOTS: Final = (8, 16)
SPACING_M: Final = (0.8, 1.2)
SAFE_M: Final = (0.2, 0.3)
SCATTER_M: Final = 0.1
"""Robots start so far beside their places in x and in y at most."""
COURSE_SHARES: Final = (0.3, 0.7)
"""Least and most of the greatest speed that the course has."""
STALL_MS: Final = (600, 1500)
"""Least and most of the longest that a process stands."""
STALLS_HZ: Final = (0.2, 0.6)
"""So often each process does. All stand where most processes of a fleet are late: this is seldom enough."""
STALLS_S: Final = (20.0, 30.0)
RECOVERED_S: Final = 21.0
LATE_LINKS: Final = 0.4
LINK_DELAY_MS: Final = (10, 150)
LINK_LOSS: Final = (0.5, 10.0)
"""Share of the scenarios in which all links are late and lossy, by how much, ms, %."""
_RATES_HZ: Final = ((10, 3.0), (15, 1.0), (20, 1.0))
_TIMEOUT_PERIODS: Final = 3.0
PATIENT: Final = 0.4
PATIENT_PERIODS: Final = 10.0
"""Share of the scenarios in which a plant waits for so many periods until it brakes."""
BUSY: Final = 0.5
BUSY_MS: Final = (300, 900)
BUSY_SHARES: Final = (10, 40)
BUSY_S: Final = (8.0, 12.0)
"""Share of those in which processes are late all the time, by up to how much, in so many ticks, %: for how
long until all stand for it nobody can say, and what they do until then is what matters."""


def draw_overloaded(seed: int) -> Tables:
    """The tables of the fleet file of this seed."""
    dice = Dice("overloaded", seed)
    rate_hz = dice.weighted(_RATES_HZ)
    timeout_s = round(max(0.2, _TIMEOUT_PERIODS / rate_hz), 2)
    speed = dice.between(0.7, 1.2, 2)
    control: Tables = {
        "max_speed_mps": speed,
        "max_acceleration": dice.between(1.5, 4.0, 1),
        "plant_timeout_s": timeout_s,
        "wrench_timeout_s": timeout_s,
    }
    reach_m = pieces.draw_reach(dice, speed, rate_hz)
    ids = list(range(1, dice.whole(*ROBOTS) + 1))
    shape = draw_lattice(Dice("shape", seed), ids, dice.between(*SPACING_M))
    course_mps, angle = dice.between(*COURSE_SHARES) * speed, 2.0 * pi * dice.share()
    if dice.chance(0.7):
        course = pieces.circle(dice, (0.0, 0.0), dice.between(3.0, 5.0, 1), course_mps, angle)
    else:
        course = pieces.line(course_mps, angle)
    stalls_s = dice.between(*STALLS_S, 1)
    duration_s = stalls_s + (RECOVERED_S if dice.chance(0.2) else 0.0)
    tables = pieces.meeting(
        seed, rate_hz, duration_s, shape, dice.between(*SAFE_M, 2), control, course, reach_m
    )
    starts = {
        robot: (x + dice.between(-SCATTER_M, SCATTER_M), y + dice.between(-SCATTER_M, SCATTER_M))
        for robot, (x, y) in shape.offsets.items()
    }
    tables["robot"] = pieces.robots_at(dice, starts, (), reach_m)
    rules = [_stalls(dice, rate_hz, stalls_s)]
    patient = Dice("patient", seed)
    if patient.chance(PATIENT):
        control["plant_timeout_s"] = control["wrench_timeout_s"] = round(PATIENT_PERIODS / rate_hz, 2)
        if patient.chance(BUSY):
            rules[0] |= _busy(patient)
    if dice.chance(LATE_LINKS):
        rules.append(_late_links(dice))
    tables["faults"] = {"rule": rules}
    return tables


def _stalls(dice: Dice, rate_hz: float, until_s: float) -> Tables:
    """Of all processes, each by itself; many that follow one another soon, or few."""
    share = 100.0 * dice.between(*STALLS_HZ) / rate_hz
    return {
        "name": "stalls 1",
        "tick_jitter": f"{dice.whole(*STALL_MS)}ms",
        "tick_jitter_share": f"{share:.2g}%",
        "at": 0.0,
        "for": until_s,
    }


def _busy(dice: Dice) -> Tables:
    """What is other than with `_stalls` where all processes are late all the time."""
    return {
        "tick_jitter": f"{dice.whole(*BUSY_MS)}ms",
        "tick_jitter_share": f"{dice.whole(*BUSY_SHARES)}%",
        "for": dice.between(*BUSY_S, 1),
    }


def _late_links(dice: Dice) -> Tables:
    """Of all links, all the time."""
    delay = f"{dice.whole(*LINK_DELAY_MS)}ms"
    return {"name": "links 1", "delay": delay, "loss": f"{dice.between(*LINK_LOSS, 1):g}%"}
