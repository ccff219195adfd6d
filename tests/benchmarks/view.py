"""The page of a running fleet: what its server costs, what a frame is, what pages cost the fleet, and how
soon a STOP on a page is obeyed.

Of 6 robots on real processes, with and without pages in turns; of 100 by a server that is fed what they would
say, without links.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Final, cast

import numpy as np
import tomli_w
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from agent.common.time import NS_PER_S
from agent.fleet.loading import digest, load_fleet, parse_fleet, to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages import key_expressions
from agent.messages.codec import decode, encode
from agent.messages.types import Mission, NeighbourStatus, PlantState, Status, Total
from deploy.console.arguments import fleet_path
from deploy.processes.placement import place
from deploy.session.joined_bus import OperatorBus
from deploy.session.operator_bus import operator_bus
from deploy.view.live_fleet import FRAME_NS, LiveFleet
from deploy.view.pages import _Page
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import (
    BenchmarkError,
    Group,
    Observer,
    cpu_s,
    environment,
    handfast,
    start_handfast,
)

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
    stops_ms: list[float] = field(default_factory=list)


def run(options: Options) -> Result:
    rounds, window_s, stops = (2, 8.0, 10) if options.quick else (5, 20.0, 100)
    found = _Found()
    fleet, ports, _ = place(resolved(load_fleet(fleet_path("delta"))))
    try:
        with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
            _live(found, fleet, Path(name), rounds, window_s, stops)
    finally:
        ports.close()
    step_ms, frame_bytes, turn_bytes = _fed(MANY)
    few_ms, few_bytes, _ = _fed(6)
    per_cent = 100.0 * NS_PER_S / FRAME_NS / 1e3
    p99 = float(np.percentile(found.stops_ms, 99))
    figures = [
        Figure("server, 6 robots, 1 page", median(found.server["1 page"]), "% of a core", SERVER_CPU),
        Figure("its own part of that, fed", few_ms * per_cent, "% of a core"),
        Figure(f"its own part, fed, {MANY} robots", step_ms * per_cent, "% of a core", SERVER_CPU),
        Figure(f"a frame of {MANY} robots", frame_bytes, "bytes", FRAME_BYTES, note=f"6 robots: {few_bytes}"),
        Figure(f"a turn of {MANY} robots with all that is new", turn_bytes, "bytes"),
        Figure("STOP on a page to the last body that brakes, p99", p99, "ms", STOP_MS,
               note=f"median {median(found.stops_ms):.0f}, of {len(found.stops_ms)}"),
    ]  # fmt: skip
    rows = [
        [arm, spread(found.server[arm]), spread(found.tick_us[arm]), str(found.missed[arm])] for arm in ARMS
    ]
    heading = ("6 robots", "server, % of a core", "tick of the robots, us", "ticks missed")
    return Result(figures, table(heading, rows))


# ---------------------------------------------------------------------- real processes


def _live(found: _Found, fleet: Fleet, folder: Path, rounds: int, window_s: float, stops: int) -> None:
    fleet_file = folder / "fleet.toml"
    fleet_file.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
    with Group(folder) as robots:
        start_handfast(robots, fleet, fleet_file)
        with Observer(fleet, robots) as observer:
            observer.wait_alive()
            observer.drive()
            with _server(fleet_file, folder) as (server, address):
                for number in range(rounds):
                    for arm in [*ARMS][:: 1 if number % 2 == 0 else -1]:
                        with _pages(address, *ARMS[arm]):
                            _window(found, arm, observer, server, window_s)
                found.stops_ms += _stops(fleet, address, stops)


def _window(found: _Found, arm: str, observer: Observer, server: int, window_s: float) -> None:
    observer.watch(SETTLE_S)
    before, begun = cpu_s(server), time.monotonic()
    traffic = observer.watch(window_s)
    found.server[arm].append(100.0 * (cpu_s(server) - before) / (time.monotonic() - begun))
    found.tick_us[arm].append(median(traffic.tick_us))
    found.missed[arm] += traffic.agents_missed


@contextmanager
def _server(fleet_file: Path, folder: Path) -> Iterator[tuple[int, str]]:
    """The process of ``handfast view`` and the address of its page."""
    out = folder / "view.out"
    with open(out, "wb") as stream:
        command = handfast("view", str(fleet_file), "--no-browser")
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())
    try:
        end = time.monotonic() + 20.0
        while not (address := re.search(r"http://\S+", out.read_text())):
            if time.monotonic() > end or process.poll() is not None:
                raise BenchmarkError(f"no page: {out.read_text()[-500:]}")
            time.sleep(0.05)
        yield process.pid, address[0]
    finally:
        process.kill()
        process.wait()


@contextmanager
def _pages(address: str, count: int, frozen: int) -> Iterator[None]:
    command = [sys.executable, "-P", "-m", "tests.benchmarks.view_clients", address, str(count), str(frozen)]
    process = subprocess.Popen(command, env=environment())
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _stops(fleet: Fleet, address: str, count: int) -> list[float]:
    """How long after a page has said STOP the last body said that it brakes, ms, time and again."""
    where, _, token = address.partition("#token=")
    origin = where.rstrip("/")
    found = []
    where = f"{origin.replace('http', 'ws', 1)}/live"
    with operator_bus(fleet) as bus, connect(where, origin=Origin(origin), proxy=None, max_size=None) as talk:
        bus.subscribe(key_expressions.plant_state(fleet.fleet.name, "*"), 65_536)
        talk.send(json.dumps({"token": token}))
        threading.Thread(target=_read, args=(talk,), daemon=True).start()
        for number in range(count):
            _until(fleet, bus, driving=True)
            begun = time.monotonic()
            _say(talk, {"id": f"stop {number}", "kind": "stop"})
            _until(fleet, bus, driving=False)
            found.append((time.monotonic() - begun) * 1e3)
            _say(talk, {"id": f"resume {number}", "kind": "resume", "seen_s": time.time()})
    return found


def _read(talk: ClientConnection) -> None:
    """Reads what comes, as pages do: who answers nothing is gone."""
    with suppress(ConnectionClosed):
        for number, _ in enumerate(each for each in talk if isinstance(each, bytes)):
            talk.send(str(number + 1))


def _say(talk: ClientConnection, order: dict[str, str | float]) -> None:
    talk.send(json.dumps({"order": order}))


def _until(fleet: Fleet, bus: OperatorBus, *, driving: bool) -> None:
    """Waits until all bodies drive, or all brake."""
    states: dict[int, bool] = {}
    end = time.monotonic() + 20.0
    while len(states) < len(fleet.ids) or set(states.values()) != {driving}:
        if time.monotonic() > end:
            raise BenchmarkError(f"not all bodies {'drive' if driving else 'brake'}: {states}")
        time.sleep(0.001)
        for _, payload in bus.drain():
            message = decode(payload)
            if type(message) is PlantState:
                states[message.robot] = message.driving


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
