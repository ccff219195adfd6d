"""What security costs a fleet across hosts: CPU and latency with it, as ratios to those without.

Two fleets, alike but for their security, are up side by side on the same hosts and drive in turns, so that
what else the machine does falls on both; one stands ready while the other is measured.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np

from tests.benchmarks.figures import Figure, spread
from tests.benchmarks.hand_latency import Heard
from tests.benchmarks.host_faults import SETTLE_S, drive_alone
from tests.benchmarks.processes import BenchmarkError, cpu_s
from tests.hosts.fleet_on_hosts import FleetOnHosts

MODULES: Final = {"agent": "-m agent ", "plant": "-m plant ", "recorder": "-m agent.recorder "}
SECURED: Final = "secured"
OPEN: Final = "open"
LISTEN_S: Final = 6.0
_SPARE_S: Final = 60.0
"""A drive is stopped when its windows are over, however slow the machine."""


@dataclass
class Costs:
    """One figure per window of each arm."""

    cpu: dict[str, dict[str, list[float]]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(list))
    )
    """By arm and role: per cent of a core for one process."""
    p50_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    p99_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    following: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Share of the hand states that were due, which came and were of robots that obeyed the law: where it is
    not near 1 the machine was too busy for the others to say anything."""


def measure(arms: Mapping[str, FleetOnHosts], rounds: int, window_s: float) -> Costs:
    """Drives the fleets of `arms` (`SECURED` and `OPEN`) in turns; they are up."""
    costs = Costs()
    for number in range(rounds):
        # The order of the arms changes from round to round.
        for arm in (SECURED, OPEN) if number % 2 == 0 else (OPEN, SECURED):
            _window(costs, arm, arms[arm], window_s)
    return costs


def _window(costs: Costs, arm: str, fleet: FleetOnHosts, window_s: float) -> None:
    pids = processes_of(fleet)
    drive_alone(fleet, SETTLE_S + window_s + LISTEN_S + _SPARE_S)
    before, begun = {role: sum(map(cpu_s, found)) for role, found in pids.items()}, time.monotonic()
    time.sleep(window_s)
    after, took_s = {role: sum(map(cpu_s, found)) for role, found in pids.items()}, time.monotonic() - begun
    for role, found in pids.items():
        costs.cpu[arm][role].append(100.0 * (after[role] - before[role]) / took_s / len(found))
    heard = hand_states(fleet)
    costs.p50_ms[arm].append(float(np.percentile(heard.ages_ms, 50)))
    costs.p99_ms[arm].append(float(np.percentile(heard.ages_ms, 99)))
    costs.following[arm].append(heard.following)
    fleet.handfast("stop")


def processes_of(fleet: FleetOnHosts) -> dict[str, list[int]]:
    """Processes of one fleet on all hosts, by role."""
    found = {
        role: [
            pid
            for host in fleet.hosts
            for pid, words in host.pids(module).items()
            if f"/fleets/{fleet.name}/" in words
        ]
        for role, module in MODULES.items()
    }
    if len({len(pids) for pids in found.values()}) != 1:
        raise BenchmarkError(f"processes of {fleet.name} are missing: {found}")
    return found


def hand_states(fleet: FleetOnHosts) -> Heard:
    """As they come to the operator's computer."""
    command = [sys.executable, "-P", "-m", "tests.benchmarks.hand_latency", str(fleet.file), f"{LISTEN_S:g}"]
    done = fleet.hosts.operator.run(command, env=fleet.environment())
    heard = Heard(**json.loads(done.stdout)) if done.returncode == 0 else None
    if heard is None or not heard.ages_ms:
        raise BenchmarkError(f"no hand state of {fleet.name} was heard: {done.stdout}{done.stderr}")
    return heard


def figures(costs: Costs) -> list[Figure]:
    """Medians, and ratios of windows of the same round."""
    found = []
    for role in MODULES:
        secured, bare = costs.cpu[SECURED][role], costs.cpu[OPEN][role]
        note = f"{spread(secured)} against {spread(bare)} % of a core"
        found.append(Figure(f"CPU of {role}s, secured / not", _ratio(secured, bare), note=note))
    for what, by_arm in (("median", costs.p50_ms), ("99th percentile", costs.p99_ms)):
        secured, bare = by_arm[SECURED], by_arm[OPEN]
        note = f"not secured {spread(bare)}; ratio {_ratio(secured, bare):.2f}"
        found.append(Figure(f"hand state to another host, secured, {what}", median(secured), "ms", note=note))
    least = 100.0 * min(min(costs.following[arm]) for arm in (SECURED, OPEN))
    note = "  ".join(
        f"{arm} {spread([100.0 * each for each in costs.following[arm]])}" for arm in (SECURED, OPEN)
    )
    found.append(Figure("hand states by the law of those due meanwhile, least", least, "%", note=note))
    return found


def _ratio(secured: list[float], bare: list[float]) -> float:
    return median(one / other for one, other in zip(secured, bare, strict=True))
