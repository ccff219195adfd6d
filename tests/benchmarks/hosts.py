"""A fleet on hosts: how long the operator's commands take, where it drives, how it bears what befalls it, and
what security costs.

The hosts are those of `tests.hosts`: namespaces of this one machine, so its cores are shared by all of them,
and by the operator. Needs root and what test hosts need.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from tests.benchmarks import host_cost
from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.host_faults import (
    CUT_S,
    RETURN_S,
    ROUTER_AWAY_S,
    SETTLE_S,
    Struck,
    all_well_again_s,
    cut_off,
    drive_alone,
    fetched,
    router,
    runs_again_s,
    strike,
)
from tests.benchmarks.processes import BenchmarkError, NotHereError, environment, handfast
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.hosts import Hosts, missing

UP_S: Final = 60.0
AGAIN_S: Final = 5.0
APART_M: Final = 0.05
BACK_S: Final = 3.0
RECONNECTED_S: Final = 1.0
OPEN_PORT: Final = 7800
ROUTER_PORT: Final = 7447
_LOCAL_TIMEOUT_S: Final = 90.0


@dataclass(frozen=True)
class _Plan:
    """How thorough to be."""

    hosts: tuple[int, ...]
    drive_s: float
    struck: tuple[int, ...]
    """Robots whose agents are killed, and then frozen, one after the other."""
    cuts: int
    outages: int
    rounds: int
    window_s: float


FULL: Final = _Plan((3, 6), 20.0, (1, 2, 5), 6, 3, 3, 15.0)
QUICK: Final = _Plan((3,), 20.0, (2,), 1, 1, 1, 8.0)


@dataclass
class _Found:
    """Figures, each printed as soon as it is known: all of them take some twenty minutes."""

    hosts: int
    figures: list[Figure] = field(default_factory=list)

    def add(self, name: str, value: float, unit: str, limit: float | None = None, note: str = "") -> None:
        self.take(Figure(name, value, unit, limit, note=note))

    def take(self, figure: Figure) -> None:
        name = f"{self.hosts} hosts: {figure.name}"
        load = f"load {os.getloadavg()[0]:.1f}"
        note = f"{figure.note}; {load}" if figure.note else load
        self.figures.append(Figure(name, figure.value, figure.unit, figure.limit, figure.at_most, note))
        print("  ".join(filter(None, self.figures[-1].row())), flush=True)

    def returns(self, what: str, took: Sequence[float | None], limit: float | None) -> None:
        """Times until all was well again, of which some may not have come."""
        came = [each for each in took if each is not None]
        if came:
            self.add(what, max(came), "s", limit, spread(came) if len(came) > 1 else "")
        if len(came) < len(took):
            self.add(f"{what}: never", len(took) - len(came), f"of {len(took)}", 0.0)


def run(options: Options) -> Result:
    if (reason := missing()) is not None:
        raise NotHereError(reason)
    plan = QUICK if options.quick else FULL
    result = Result()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        cache = Path(name) / "cache"
        for count in plan.hosts:
            folder = Path(name) / str(count)
            folder.mkdir()
            found = _Found(count)
            with Hosts(count) as hosts:
                begun = time.monotonic()
                fetch_wheels(hosts[0], cache)
                if count == plan.hosts[0]:
                    found.add("wheels fetched by the operator", time.monotonic() - begun, "s", note="once")
                _fleet(found, hosts, folder, cache, plan)
            result.figures += found.figures
    return result


def _fleet(found: _Found, hosts: Hosts, folder: Path, cache: Path, plan: _Plan) -> None:
    """All of it, for one set of hosts."""

    def fleet_of(name: str, **tables: dict[str, Any]) -> FleetOnHosts:
        (folder / name).mkdir()
        named = {"fleet": {"name": name}} | tables
        return FleetOnHosts(hosts, folder / name, delta(list(hosts), **named), cache)

    fleet = fleet_of("delta")
    here = _driven_here(fleet, plan.drive_s)
    fleet.handfast("keys")
    found.add("up from nothing", _took_s(fleet, "up"), "s", UP_S)
    found.add("up, nothing to do", _took_s(fleet, "up"), "s", AGAIN_S)
    found.add("status", _took_s(fleet, "status"), "s")
    _drive_compared(found, fleet, here, plan.drive_s)
    _faults(found, fleet, plan)
    bare = fleet_of(host_cost.OPEN, network={"security": "off", "base_port": OPEN_PORT})
    bare.handfast("up", timeout=UP_TIMEOUT_S)
    arms = {host_cost.SECURED: fleet, host_cost.OPEN: bare}
    for figure in host_cost.figures(host_cost.measure(arms, plan.rounds, plan.window_s)):
        found.take(figure)
    bare.handfast("down")
    found.add("down", _took_s(fleet, "down"), "s")
    found.add("processes after down", len(fleet.processes() | bare.processes()), "", 0.0)
    where = f"{hosts.operator.address}:{ROUTER_PORT}"
    _router_killed(found, fleet_of("routed", network={"routers": [where]}), plan.outages)


def _took_s(fleet: FleetOnHosts, command: str) -> float:
    begun = time.monotonic()
    fleet.handfast(command, timeout=UP_TIMEOUT_S)
    return time.monotonic() - begun


def _driven_here(fleet: FleetOnHosts, seconds: float) -> Recording:
    """Driven by `handfast run` on this machine, while nothing is up yet: it would share the cores with it."""
    out = fleet.folder / "here"
    done = subprocess.run(
        handfast("run", str(fleet.file), *_told(seconds), "--out", str(out)),
        env=environment(),
        capture_output=True,
        text=True,
        timeout=_LOCAL_TIMEOUT_S,
    )
    if done.returncode not in (0, 1):  # 1 is a verdict, which a busy machine may earn
        raise BenchmarkError(f"the local run failed: {done.stderr}")
    return read_run(out)


def _told(seconds: float) -> tuple[str, ...]:
    return "--duration", f"{seconds:g}s", "--no-report", "--quiet"


def _drive_compared(found: _Found, fleet: FleetOnHosts, here: Recording, seconds: float) -> None:
    """Driven across hosts, and `here`: how far apart."""
    out = fleet.folder / "there"
    fleet.handfast("drive", *_told(seconds), "--out", str(out), status=None)
    there = read_run(out)
    # Not to the very end: there it depends on when the stop arrived.
    grid = np.arange(0.0, seconds - 0.1, 0.05)
    if min(there.data_end_s, here.data_end_s) < grid[-1]:
        raise BenchmarkError(f"a drive ended early: {there.data_end_s:.1f} and {here.data_end_s:.1f} s")
    apart = np.linalg.norm(there.hand_positions(grid) - here.hand_positions(grid), axis=-1)
    k, robot = np.unravel_index(int(np.argmax(apart)), apart.shape)
    note = f"robot {there.ids[int(robot)]} at {grid[k]:.1f} s"
    found.add("hand points, across hosts and here, furthest", float(np.max(apart)), "m", APART_M, note)


def _faults(found: _Found, fleet: FleetOnHosts, plan: _Plan) -> None:
    """Agents killed and frozen, hosts cut off, in one drive."""
    each_s = RETURN_S + CUT_S
    faults = 2 * len(plan.struck) + plan.cuts
    drive_alone(fleet, SETTLE_S + faults * (each_s + 1.0) + 30.0)
    killed = [strike(fleet, robot, signal.SIGKILL) for robot in plan.struck]
    frozen = [strike(fleet, robot, signal.SIGSTOP) for robot in plan.struck]
    # Attempts to connect come at regular times: hosts return at other moments between two of them.
    returns_ns = [cut_off(fleet, number % found.hosts, 0.1 * number) for number in range(plan.cuts)]
    fleet.handfast("stop")
    recording, fetch_s = fetched(fleet, fleet.folder / "faults")

    def again(struck: Sequence[Struck]) -> list[float | None]:
        return [runs_again_s(recording, each.robot, each.at_ns) for each in struck]

    found.returns("SIGKILL of an agent to its unit's next process", [each.born_s for each in killed], None)
    found.returns("SIGKILL of an agent until it runs", again(killed), BACK_S)
    found.returns("SIGSTOP of an agent to the watchdog's kill", [each.gone_s for each in frozen], None)
    found.returns("SIGSTOP of an agent until it runs", again(frozen), None)
    back = [all_well_again_s(recording, at_ns) for at_ns in returns_ns]
    found.returns(f"a host back after {CUT_S:g} s until all hear and run", back, RECONNECTED_S)
    found.add("fetch of that drive", fetch_s, "s", note=f"{recording.data_end_s:.0f} s of 6 robots")


def _router_killed(found: _Found, fleet: FleetOnHosts, outages: int) -> None:
    """The one router of a fleet, killed in mid-drive and started again."""
    fleet.handfast("keys", "--router")
    returns_ns = []
    with router(fleet):
        fleet.handfast("up", timeout=UP_TIMEOUT_S)
        drive_alone(fleet, SETTLE_S + outages * (ROUTER_AWAY_S + RETURN_S + 10.0))
    for _ in range(outages):
        time.sleep(ROUTER_AWAY_S)
        with router(fleet) as listens_ns:
            returns_ns.append(listens_ns)
            time.sleep(RETURN_S)
    with router(fleet):
        recording, _ = fetched(fleet, fleet.folder / "outages")
        back = [all_well_again_s(recording, at_ns) for at_ns in returns_ns]
        found.returns("a router back until all hear and run", back, RECONNECTED_S)
        fleet.handfast("down")
