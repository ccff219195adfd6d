"""The table of random starts: which law keeps six robots apart, and how soon it brings them into formation.

Six robots of the delta, uniform in a square, the formation turned at random, slots assigned; the
whole chain (plants, messages, agents) in virtual time, on all cores. The same seeds for every law.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from agent import keys
from agent.clock import NS_PER_S
from agent.fleet import Fleet, load_fleet
from agent.formation import resolve
from agent.messages import PlantState, decode
from agent.supervision import State
from deploy.arguments import fleet_path
from deploy.random_starts import random_fleet
from deploy.simulation import Simulation
from deploy.stability import SETTLED
from tests.benchmarks.figures import Figure, Options, Result, number, table

LAWS: Final = ("joint", "edge", "paper", "penalty")
REPAIRED: Final = ("joint", "edge")
SIDE_M: Final = 4.0
GAP_M: Final = 0.3
DURATION_S: Final = 40.0
SAFE_M: Final = 0.22
COUNT: Final = 1000
COUNT_QUICK: Final = 60
SETTLING_TARGET_S: Final = 8.5
CHUNK: Final = 4


@dataclass(frozen=True)
class Outcome:
    """One start under one law. Distances m, between hand points; `settling_s` None when never settled."""

    law: str
    seed: int
    edge_m: float
    any_m: float
    settling_s: float | None
    faults: int

    @property
    def safe(self) -> bool:
        return self.edge_m > SAFE_M


def bases() -> dict[str, Fleet]:
    """The fleet under each law."""
    fields = [f"fleet.duration_s={DURATION_S}", f"formation.safe_distance_m={SAFE_M}"]
    return {law: load_fleet(fleet_path("delta"), fields, law) for law in LAWS}


def drive(fleet: Fleet) -> tuple[np.ndarray, int]:
    """Hand points (times, robots, 2) m from the epoch to the end, and how many robots ended in FAULT.

    `fleet` is resolved. Taken from the plants' messages, the only ones that are decoded here.
    """
    rows: dict[str, list[tuple[int, float, float, float]]] = {
        keys.plant_state(fleet.fleet.name, robot): [] for robot in fleet.ids
    }

    def sink(_: int, key: str, payload: bytes) -> None:
        row = rows.get(key)
        if row is not None:
            state = decode(payload)
            assert type(state) is PlantState
            row.append((state.time_ns, state.x, state.y, state.heading))

    simulation = Simulation(fleet, sink)
    duration_ns = round(fleet.fleet.duration_s * NS_PER_S)
    simulation.start(duration_ns)
    simulation.run_until(simulation.epoch_ns + duration_ns)
    points = []
    for robot, row in zip(fleet.robots, rows.values(), strict=True):
        driven = np.array([entry[1:] for entry in row if entry[0] >= simulation.epoch_ns])
        x, y, heading = driven.T
        points.append((x + robot.hand_offset_m * np.cos(heading), y + robot.hand_offset_m * np.sin(heading)))
    faults = sum(agent.state is State.FAULT for agent in simulation.agents)
    return np.array(points).transpose(2, 0, 1), faults


def outcome(law: str, seed: int, base: Fleet) -> Outcome:
    fleet = random_fleet(base, seed, SIDE_M, GAP_M)
    geometry = resolve(fleet)
    hands, faults = drive(fleet)
    first, second = np.triu_indices(len(fleet.robots), 1)
    pairs = np.hypot(*np.moveaxis(hands[:, first] - hands[:, second], -1, 0))
    i, j = geometry.edges.T
    edges = np.hypot(*np.moveaxis(hands[:, i] - hands[:, j], -1, 0))
    off = (np.abs(edges - geometry.distances) > SETTLED * geometry.distances).any(axis=1)
    last = np.flatnonzero(off)
    settling_s = None if off[-1] else float(last[-1]) * fleet.period_ns / NS_PER_S if len(last) else 0.0
    return Outcome(law, seed, float(edges.min()), float(pairs.min()), settling_s, faults)


_bases: dict[str, Fleet] = {}


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's: it ends the workers
    _bases.update(bases())


def _work(task: tuple[str, int]) -> Outcome:
    law, seed = task
    return outcome(law, seed, _bases[law])


def outcomes(tasks: Sequence[tuple[str, int]]) -> Iterable[Outcome]:
    """All tasks on all cores, in whatever order they end."""
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    context = multiprocessing.get_context("spawn")
    with context.Pool(len(os.sched_getaffinity(0)), _begin) as pool:
        yield from pool.imap_unordered(_work, tasks, CHUNK)


def row(law: str, found: Sequence[Outcome]) -> list[str]:
    settled = sorted(each.settling_s for each in found if each.settling_s is not None)
    times = (
        [number(float(np.percentile(settled, percent))) for percent in (50, 95, 100)]
        if settled
        else ["-"] * 3
    )
    return [
        law,
        _share(sum(each.safe for each in found), len(found)),
        _share(len(settled), len(found)),
        *times,
        f"{min(each.edge_m for each in found):.4f}",
        f"{min(each.any_m for each in found):.4f}",
        str(sum(each.faults > 0 for each in found)),
    ]


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.1f}"


def run(options: Options) -> Result:
    count = options.count or (COUNT_QUICK if options.quick else COUNT)
    tasks = [(law, seed) for seed in range(count) for law in LAWS]
    found: dict[str, list[Outcome]] = {law: [] for law in LAWS}
    begun = told = time.monotonic()
    for done, each in enumerate(outcomes(tasks), 1):
        found[each.law].append(each)
        if time.monotonic() - told > 20.0:
            told = time.monotonic()
            left_s = (told - begun) * (len(tasks) - done) / done
            print(f"  {done} of {len(tasks)} runs, {left_s / 60.0:.1f} min left", file=sys.stderr, flush=True)
    took_s = time.monotonic() - begun
    result = Result()
    for law in REPAIRED:
        settled = [each.settling_s for each in found[law] if each.settling_s is not None]
        safe = sum(each.safe for each in found[law])
        result.figures += [
            Figure(f"{law}: starts that stay above r_s", 100.0 * safe / count, "%", 100.0, at_most=False),
            Figure(f"{law}: starts that settle", 100.0 * len(settled) / count, "%", 100.0, at_most=False),
        ]
        if settled:
            result.figures.append(
                Figure(f"{law}: settling time, median", float(np.median(settled)), "s", SETTLING_TARGET_S)
            )
        bad = sorted(each.seed for each in found[law] if not each.safe or each.settling_s is None)
        if bad:
            result.details.append(f"{law}: seeds not safe or not settled: {', '.join(map(str, bad[:20]))}")
    heading = [
        "law",
        "above r_s %",
        "settled %",
        "median s",
        "p95 s",
        "max s",
        "closest edge m",
        "closest pair m",
        "faults",
    ]
    result.details += table(heading, [row(law, found[law]) for law in LAWS])
    result.details.append(
        f"{count} starts each, seeds 0 to {count - 1}, {SIDE_M:g} m square, {GAP_M:g} m apart, "
        f"{DURATION_S:g} s; {len(tasks)} runs in {took_s:.0f} s"
    )
    return result
