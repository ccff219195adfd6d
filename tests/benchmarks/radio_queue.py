"""A fleet whose emulated radios carry less and less, in virtual time: what is late, lost, and what becomes of
the formation; and what the emulation costs.

Below the budget not a byte of what robots say to each other may differ.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from math import cos, hypot, inf, sin
from statistics import median
from typing import Final

import numpy as np

from agent.common.time import NS_PER_S
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve, resolved
from agent.messages.codec import decode
from agent.messages.types import Beacon, HandState, PlantState, Status
from deploy.check.load.radio_load import kbit, worst_load
from deploy.console.arguments import fleet_path
from deploy.simulate.simulation import Simulation
from tests.benchmarks.figures import Figure, Options, Result, number, table

RATE_HZ: Final = 20.0
SHARES: Final = (1.5, 1.2, 1.0, 0.9, 0.75, 0.5, 0.25)
"""Budgets, by what the busiest radio needs as `check` says."""
DURATION_S: Final = 40.0
WITHIN: Final = 0.05
DROPPED: Final = ("radio.dropped.said", "radio.dropped.heard")


@dataclass
class Drive:
    """What an operator sees of a drive, who has no part in the budget."""

    said: list[bytes] = field(default_factory=list)
    ages_ms: list[float] = field(default_factory=list)
    counters: dict[int, dict[str, int]] = field(default_factory=dict)
    closest_m: float = inf
    off_s: float = 0.0
    took_s: float = 0.0


def delta(*sets: str) -> Fleet:
    sets = (f"fleet.rate_hz={RATE_HZ}", f"fleet.duration_s={DURATION_S}", *sets)
    return resolved(load_fleet(fleet_path("delta"), sets))


def drive(fleet: Fleet) -> Drive:
    """Drives in virtual time; what was said is kept, and looked at when it is over."""
    heard: list[tuple[int, bytes]] = []
    simulation = Simulation(fleet, lambda time_ns, _, payload: heard.append((time_ns, payload)))
    begun = time.process_time()
    simulation.run(lambda _: True)
    found = Drive(took_s=time.process_time() - begun)
    geometry = resolve(fleet)
    wanted = {
        frozenset((geometry.ids[i], geometry.ids[j])): distance
        for (i, j), distance in zip(geometry.edges.tolist(), geometry.distances.tolist(), strict=True)
    }
    hands: dict[int, tuple[float, float]] = {}
    for time_ns, payload in heard:
        message = decode(payload)
        t = (time_ns - simulation.epoch_ns) / NS_PER_S
        if isinstance(message, HandState | Beacon):
            found.said.append(payload)
        elif isinstance(message, Status):
            found.counters[message.robot] = dict(message.counters)
            if t > DURATION_S / 4:
                found.ages_ms += [age / 1e3 for age in message.ages_us]
        elif isinstance(message, PlantState):
            ahead = fleet.robot(message.robot).hand_offset_m
            own = message.x + ahead * cos(message.heading), message.y + ahead * sin(message.heading)
            for robot, other in hands.items():
                if robot == message.robot:
                    continue
                apart = hypot(own[0] - other[0], own[1] - other[1])
                found.closest_m = min(found.closest_m, apart)
                distance = wanted.get(frozenset((robot, message.robot)))
                if distance is not None and t < DURATION_S and abs(apart - distance) > WITHIN * distance:
                    found.off_s = t
            hands[message.robot] = own
    return found


def lost(found: Drive) -> float:
    """Share of the hand states and beacons that were dropped, said or heard, per cent."""
    total: Counter[str] = Counter()
    for counters in found.counters.values():
        total.update(counters)
    dropped = sum(total[name] for name in DROPPED)
    return 100.0 * dropped / max(1, dropped + total["received"])


def run(options: Options) -> Result:
    plain = delta()
    needed = worst_load(plain, resolve(plain)).most
    free = drive(plain)
    rows = []
    same = True
    ages = []
    for share in SHARES if not options.quick else SHARES[::2]:
        emulated = (f"network.budget={share * needed}", "network.emulate_budget=true")
        found = drive(delta(*emulated))
        unchanged = found.said == free.said
        same = same and (unchanged or share < 1.2)
        ages.append(float(np.median(found.ages_ms)))
        rows.append(
            [
                f"{share:g} ({kbit(share * needed)})",
                "yes" if unchanged else "no",
                *(number(float(np.percentile(found.ages_ms, q))) for q in (50, 99)),
                f"{lost(found):.0f} %",
                f"{found.off_s:.1f}" if found.off_s < DURATION_S - 1.0 else "not",
                f"{found.closest_m:.3f}",
            ]
        )
    spent: list[float] = []
    for turn in range(3 if options.quick else 7):
        both = {}
        for which in ("plain", "ample") if turn % 2 else ("ample", "plain"):
            more = ("network.budget=1e9", "network.emulate_budget=true") if which == "ample" else ()
            both[which] = drive(delta(*more)).took_s
        spent.append(both["ample"] / both["plain"])
    result = Result()
    result.figures = [
        Figure("what the busiest radio needs, by check", needed / 1e3, "kbit/s"),
        Figure("with 1.2 of it and more, messages that differ", 0.0 if same else 1.0, limit=0.0),
        Figure("the less the later", float(all(a <= b for a, b in pairwise(ages))), limit=1.0, at_most=False),
        Figure("CPU of a simulation with radios that carry all, to one without", median(spent)),
    ]
    heading = ["budget / needed", "same", "age, ms, p50", "p99", "lost", "within 5 % after, s", "closest, m"]
    result.details = table(heading, rows)
    return result
