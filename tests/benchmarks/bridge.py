"""CPU of a bridge against a simulated plant and pymavlink's own decoding of what the vehicle sends.

One fleet of four drives at 25 Hz, two of its bodies simulated rovers behind bridges, two simulated plants;
they change places from round to round. At the ports of one rover are, beside the bridge, two bare programs
(`bare_mavlink.py`) that asked for the same messages as the bridge and only decode them. All are measured in
the same window, so what else the machine does falls on all. The other rover has its bridge alone: its
simulator's CPU is that of `handfast run rovers`.

Where the bridge's time goes is found in virtual time: its `step` and `checks` under cProfile, joined to a
simulated rover in memory.
"""

from __future__ import annotations

import cProfile
import json
import os
import pstats
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, sin
from pathlib import Path
from statistics import median
from typing import Final

import tomli_w

from agent.common.time import NS_PER_S
from agent.fleet.loading import load_fleet, to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from bridges.mavlink.bridge.authority import Holder
from bridges.mavlink.session.streams import wanted_messages
from bridges.mavlink.simulator.in_memory import SimulatedRoverPlant
from deploy.console.arguments import fleet_path
from deploy.processes.local import VEHICLE
from deploy.processes.placement import ADDRESS, Vehicle, place
from deploy.processes.ports import Reservation
from plant.backend import Command
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import ROOT, BenchmarkError, Group, Observer, cpu_s

RATE_HZ: Final = 25
TARGET: Final = 1.0
SIMULATOR_PERCENT: Final = 6.0
BARE: Final = Path(__file__).with_name("bare_mavlink.py")
READERS: Final = ("mavutil", "parser")
ROVERS: Final = ((1, 2), (3, 4))
"""Robots with rovers, by round; of each the first has the readers."""
CORNERS: Final = (1, 2, 3, 5)
"""Of the bundled rovers: a rhombus."""
EDGES: Final = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))
SETTLE_S: Final = 5.0
PROFILED_S: Final = 120.0
COUNT_TIMEOUT_S: Final = 2.0


@dataclass(frozen=True)
class Round:
    """CPU as shares of a core, by process; messages per second, by reader."""

    cpu: dict[str, float]
    messages: dict[str, float]
    load: float

    def ratio(self, reader: str) -> float:
        return self.cpu["bridge"] / (self.cpu["plant"] + self.cpu[reader])


def fleet_with(rovers: Sequence[int]) -> Fleet:
    """Four of the bundled rovers at 25 Hz; those not among `rovers` are simulated bodies."""
    whole = load_fleet(fleet_path("rovers"), [f"fleet.rate_hz={RATE_HZ}"])
    assert whole.formation.offsets is not None
    robots, offsets = [], []
    for number, corner in enumerate(CORNERS, start=1):
        robot = replace(whole.robot(corner), id=number)
        robots.append(robot if number in rovers else replace(robot, plant="unicycle", sections=()))
        offsets.append(whole.formation.offsets[whole.index(corner)])
    formation = replace(whole.formation, edges=EDGES, offsets=tuple(offsets))
    return resolved(replace(whole, robots=tuple(robots), formation=formation))


def _start(
    group: Group, fleet: Fleet, fleet_file: Path, vehicles: Sequence[Vehicle], reader_ports: Sequence[int]
) -> None:
    """All processes; of the same role as `Round.cpu` names them."""
    with_readers = vehicles[0].robot
    intervals = [
        (wanted.message, round(1e6 / wanted.rates_hz[0])) for wanted in wanted_messages(float(RATE_HZ))
    ]
    for how, port in zip(READERS, reader_ports, strict=True):
        order = {"host": ADDRESS, "port": port, "how": how, "intervals": intervals}
        group.start(with_readers, how, [sys.executable, "-P", str(BARE), json.dumps(order)], {})
    for vehicle in vehicles:
        arguments = list(vehicle.arguments)
        role, simulator = VEHICLE, fleet.robot(vehicle.robot).kind.simulator
        if vehicle.robot == with_readers:
            arguments += [f"--connect=udp:{ADDRESS}:{port}" for port in reader_ports]
            role = "busy vehicle"
        group.start(vehicle.robot, role, [sys.executable, "-P", "-m", simulator, *arguments], {})
    for robot in fleet.robots:
        start = ["--fleet", str(fleet_file), "--robot", str(robot.id), "--exit-with-parent"]
        group.start(robot.id, "agent", [sys.executable, "-P", "-m", "agent", *start], {})
        role = "bridge" if robot.kind.vehicle else "plant"
        group.start(robot.id, role, [sys.executable, "-P", "-m", robot.kind.program, *start], {})


ROLES: Final = ("agent", "bridge", "plant", VEHICLE, "busy vehicle", *READERS)


def _cpu(group: Group) -> dict[str, float]:
    return {role: sum(map(cpu_s, pids)) / len(pids) for role in ROLES if (pids := group.pids(role))}


def _decoded(group: Group, folder: Path) -> dict[str, int]:
    """Messages that each reader has decoded since its start."""
    counts = {}
    for how in READERS:
        log = next(folder.glob(f"*-{how}.log"))
        before = len(log.read_bytes())
        (pid,) = group.pids(how)
        os.kill(pid, signal.SIGUSR1)
        until = time.monotonic() + COUNT_TIMEOUT_S
        while not (said := log.read_bytes()[before:]).endswith(b"\n"):
            if time.monotonic() > until:
                raise BenchmarkError(f"the {how} reader does not say what it has decoded")
            time.sleep(0.01)
        counts[how] = int(said)
    return counts


def measure(number: int, folder: Path, window_s: float) -> Round:
    """One round: starts everything, drives, measures one window, ends everything."""
    folder.mkdir()
    fleet, ports, vehicles = place(fleet_with(ROVERS[number % len(ROVERS)]))
    readers = Reservation(ADDRESS, ports.base + 128, len(READERS))
    try:
        fleet_file = folder / "fleet.toml"
        fleet_file.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
        with Group(folder) as group:
            _start(group, fleet, fleet_file, vehicles, range(readers.base, readers.base + len(READERS)))
            with Observer(fleet, group) as observer:
                observer.wait_alive()
                observer.drive()
                observer.watch(SETTLE_S)
                decoded, before, begun = _decoded(group, folder), _cpu(group), time.monotonic()
                observer.watch(window_s)
                after, took = _cpu(group), time.monotonic() - begun
                heard = {how: count - decoded[how] for how, count in _decoded(group, folder).items()}
                load = os.getloadavg()[0]
        cpu = {role: (after[role] - before[role]) / took for role in before}
        return Round(cpu, {how: count / took for how, count in heard.items()}, load)
    finally:
        ports.close()
        readers.close()


def profile(window_s: float) -> tuple[list[str], float]:
    """A driving bridge in virtual time: a table of where its time goes, and microseconds per tick."""
    fleet = fleet_with((1,))
    body = fleet.robot(1)
    now_ns = 1_800_000_000 * NS_PER_S
    joined = SimulatedRoverPlant(fleet, 1, now_ns)
    profiler = cProfile.Profile()
    command: Command | None = None
    obeying, spent_ns, ticks = False, 0, {True: 0, False: 0}
    for tick in range(round((SETTLE_S + 2.0 * window_s) * RATE_HZ)):
        time_s = tick / RATE_HZ
        now_ns += fleet.period_ns
        joined.transport.advance(now_ns)
        settled, profiled = time_s >= SETTLE_S, time_s >= SETTLE_S + window_s
        if profiled:
            profiler.enable()
        begun_ns = time.perf_counter_ns()
        reading = joined.plant.step(now_ns, command)
        joined.plant.checks(now_ns)
        took_ns = time.perf_counter_ns() - begun_ns
        profiler.disable()
        if settled:
            ticks[profiled] += 1
            spent_ns += 0 if profiled else took_ns
        if reading.obeying and not obeying:
            obeying = True
            joined.plant.clear_to_drive()
        if obeying:
            command = Command(
                body.mass_kg * 0.3 * sin(0.5 * time_s), body.inertia_kgm2 * 0.3 * cos(0.7 * time_s)
            )
    if joined.plant.authority.holder is not Holder.BRIDGE:
        raise BenchmarkError(f"the bridge did not drive: {joined.plant.authority.why}")
    return _by_module(profiler, ticks[True]), spent_ns / ticks[False] / 1000.0


def _by_module(profiler: cProfile.Profile, ticks: int) -> list[str]:
    """Own time of each module, with builtins counted to their callers."""
    own: dict[str, float] = defaultdict(float)
    calls: dict[str, int] = defaultdict(int)
    found = pstats.Stats(profiler)
    for (file, _, _), (_, count, total_s, _, callers) in found.stats.items():  # type: ignore[attr-defined]
        if file == "~":
            for (caller, _, _), (_, _, own_s, _) in callers.items():
                own[_module(caller)] += own_s
        else:
            own[_module(file)] += total_s
            calls[_module(file)] += count
    whole = sum(own.values())
    rows = [
        [name, f"{100.0 * seconds / whole:.0f} %", f"{calls[name] / ticks:.1f}"]
        for name, seconds in sorted(own.items(), key=lambda item: -item[1])
        if seconds > 0.01 * whole
    ]
    return table(["own time of", "share", "calls a tick"], rows)


def _module(file: str) -> str:
    path = Path(file)
    if path.is_relative_to(ROOT):
        return str(path.relative_to(ROOT))
    return "pymavlink" if "pymavlink" in path.parts else path.name


def run(options: Options) -> Result:
    window_s = 10.0 if options.quick else 15.0
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        rounds = [
            measure(number, Path(folder) / str(number), window_s)
            for number in range(2 if options.quick else 6)
        ]
    where, tick_us = profile(PROFILED_S / 4 if options.quick else PROFILED_S)
    result = Result()
    for reader in READERS:
        ratios = [one.ratio(reader) for one in rounds]
        note = f"rounds {' '.join(f'{ratio:.2f}' for ratio in ratios)}"
        name = f"CPU bridge / (simulated plant + pymavlink, {reader})"
        result.figures.append(Figure(name, median(ratios), "", TARGET, note=note))
    simulator = [100.0 * one.cpu[VEHICLE] for one in rounds]
    result.figures.append(Figure("CPU of a simulated rover", median(simulator), "%", SIMULATOR_PERCENT))
    result.figures.append(Figure("bridge's step and checks in memory", tick_us, "us"))
    rows = [[role, spread([100.0 * one.cpu[role] for one in rounds])] for role in ROLES]
    for row, role in zip(rows, ROLES, strict=True):
        row.append(spread([one.messages[role] for one in rounds]) if role in READERS else "")
    result.details += table(["process", "CPU %", "messages/s decoded"], rows)
    result.details.append(f"load {spread([one.load for one in rounds])}")
    result.details += ["", *where]
    return result
