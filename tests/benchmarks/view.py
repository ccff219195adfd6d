"""The page of a running fleet: what its server costs, what a frame is, what pages cost the fleet, and how
soon a STOP on a page is obeyed.

Of 6 robots on real processes, with and without pages in turns; of 100 by a server that is fed what they would
say, without links.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Final, cast

import numpy as np

from agent.common.time import NS_PER_S
from agent.fleet.loading import digest, parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.types import Mission, NeighbourStatus, PlantState, Status, Total
from deploy.session.joined_bus import OperatorBus
from deploy.view.live_fleet import FRAME_NS, LiveFleet
from deploy.view.pages import _Page
from tests.benchmarks.driven_fleet import driving
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import Observer, cpu_s, environment
from tests.benchmarks.view_server import served
from tests.benchmarks.view_stops import Stops, stops

SETTLE_S: Final = 3.0
MANY: Final = 100
SERVER_CPU: Final = 2.0
FRAME_BYTES: Final = 5000
STOP_MS: Final = 100.0
ARMS: Final = {"no page": (0, 0), "1 page": (1, 0), "10 pages, 1 frozen": (10, 1)}


@dataclass
class _Found:
    """One figure per window, by arm."""

    server: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    tick_us: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    missed: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    stops: dict[str, Stops] = field(default_factory=dict)


def run(options: Options) -> Result:
    rounds, window_s, count = (2, 8.0, 10) if options.quick else (5, 20.0, 20)
    found = _Found()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        _live(found, Path(name), rounds, window_s, count)
    step_ms, frame_bytes, turn_bytes = _fed(MANY)
    few_ms, few_bytes, _ = _fed(6)
    per_cent = 100.0 * NS_PER_S / FRAME_NS / 1e3
    figures = [
        Figure("server, 6 robots, 1 page", median(found.server["1 page"]), "% of a core", SERVER_CPU),
        Figure("its own part of that, fed", few_ms * per_cent, "% of a core"),
        Figure(f"its own part, fed, {MANY} robots", step_ms * per_cent, "% of a core", SERVER_CPU),
        Figure(f"a frame of {MANY} robots", frame_bytes, "bytes", FRAME_BYTES, note=f"6 robots: {few_bytes}"),
        Figure(f"a turn of {MANY} robots with all that is new", turn_bytes, "bytes"),
    ]
    for arm, each in found.stops.items():
        note = f"median {median(each.ms):.0f}, of {len(each.ms)}; {each.lost_percent:.1f} % lost"
        name = f"STOP on a page to the last body that brakes, {arm}, p99"
        figures.append(Figure(name, float(np.percentile(each.ms, 99)), "ms", STOP_MS, note=note))
    rows = [
        [arm, spread(found.server[arm]), spread(found.tick_us[arm]), str(found.missed[arm])] for arm in ARMS
    ]
    heading = ("6 robots", "server, % of a core", "tick of the robots, us", "ticks missed")
    return Result(figures, table(heading, rows))


# ---------------------------------------------------------------------- real processes


def _live(found: _Found, folder: Path, rounds: int, window_s: float, count: int) -> None:
    with driving(folder) as (fleet, fleet_file, _, observer), served(fleet_file, folder) as (server, address):
        for number in range(rounds):
            for arm in [*ARMS][:: 1 if number % 2 == 0 else -1]:
                with _pages(address, *ARMS[arm]):
                    _window(found, arm, observer, server, window_s)
        found.stops = stops(fleet, address, rounds, count)


def _window(found: _Found, arm: str, observer: Observer, server: int, window_s: float) -> None:
    observer.watch(SETTLE_S)
    before, begun = cpu_s(server), time.monotonic()
    traffic = observer.watch(window_s)
    found.server[arm].append(100.0 * (cpu_s(server) - before) / (time.monotonic() - begun))
    found.tick_us[arm].append(median(traffic.tick_us))
    found.missed[arm] += traffic.agents_missed


@contextmanager
def _pages(address: str, count: int, frozen: int) -> Iterator[None]:
    command = [sys.executable, "-P", "-m", "tests.benchmarks.view_clients", address, str(count), str(frozen)]
    process = subprocess.Popen(command, env=environment())
    try:
        yield
    finally:
        process.kill()
        process.wait()


# ---------------------------------------------------------------------- fed


class _FedBus:
    """What so many robots say in one frame after the other, made before."""

    def __init__(self, fleet: Fleet, frames: int) -> None:
        self._rounds = [_said(fleet, number) for number in range(frames)]
        self._next = 0

    def declare(self, key: str) -> None: ...
    def subscribe(self, key: str, size: int | None = None) -> None: ...
    def publish(self, key: str, payload: bytes) -> None: ...
    def close(self) -> None: ...

    def watch(self, key: str) -> _FedBus:
        return self

    def update(self) -> list[tuple[str, bool]]:
        return []

    def drain(self) -> Sequence[tuple[str, bytes]]:
        self._next += 1
        return self._rounds[self._next - 1]


BEGUN_NS: Final = time.time_ns()


def _said(fleet: Fleet, number: int) -> list[tuple[str, bytes]]:
    """Of each robot a body's state in every frame and a status in every fourth: what is listened to."""
    name, found = fleet.fleet.name, []
    now_ns = BEGUN_NS + number * FRAME_NS
    if number == 0:
        epoch_ns = now_ns - now_ns % fleet.period_ns
        mission = Mission(BEGUN_NS // 1000, now_ns, epoch_ns, 3600 * NS_PER_S, digest(fleet))
        found.append((key_expressions.mission(name), encode(mission)))
    for robot in fleet.robots:
        x, y = robot.x_m + 0.01 * number, robot.y_m
        body = PlantState(
            *(robot.id, 1000 + number, now_ns, x - 0.1, y, 0.0, 0.2, 0.0, 0.0, 0.0, True, True, True, "")
        )
        found.append((key_expressions.plant_state(name, robot.id), encode(body)))
        if (number + robot.id) % 4 == 0:
            near = tuple(
                NeighbourStatus(other, 20_000, number, 0, 100, 200)
                for edge in fleet.formation.edges
                if robot.id in edge
                for other in edge
                if other != robot.id
            )
            status = Status(
                *(robot.id, number, now_ns, "running", "", "", BEGUN_NS // 1000, 0),
                neighbours=near,
                tick_us=(400,) * 4,
                ages_us=(20_000,) * 8,
                counters=(Total("overruns", 0),),
            )
            found.append((key_expressions.status(name, robot.id), encode(status)))
    return found


def _lattice(count: int) -> Fleet:
    side = round(count**0.5) if count > 6 else 3
    robots = [(k + 1, k % side, k // side) for k in range(count)]
    ids = {(x, y): robot for robot, x, y in robots}
    edges = [
        [robot, ids[x + dx, y + dy]]
        for robot, x, y in robots
        for dx, dy in ((1, 0), (0, 1), (1, 1))
        if (x + dx, y + dy) in ids
    ]
    text = "".join(f"[[robot]]\nid = {robot}\nx_m = {x}\ny_m = {y}\n" for robot, x, y in robots)
    offsets = [[float(x), float(y)] for _, x, y in robots]
    return resolved(
        parse_fleet(
            'fleet = { name = "fed", rate_hz = 20 }\n'
            'trajectory = { kind = "line", velocity_mps = [0.2, 0.0] }\n'
            f"formation = {{ edges = {edges}, offsets = {offsets}, safe_distance_m = 0.3 }}\n{text}",
            source="fed",
        )
    )


def _fed(count: int) -> tuple[float, float, float]:
    """CPU of one frame (ms), bytes of a frame, and of a turn with all that is new, for one page."""
    frames = 200
    fleet = _lattice(count)
    live = LiveFleet(fleet, cast("OperatorBus", _FedBus(fleet, frames)))
    page = _Page(None)  # type: ignore[arg-type]
    sizes = []
    begun = time.process_time()
    for _ in range(frames):
        live.step()
        sizes.append(len(page.news(live)) + len(live.frame(forces=False)))
    took = time.process_time() - begun
    live.close()
    return took / frames * 1e3, len(live.frame(forces=False)), float(np.mean(sizes[1:]))
