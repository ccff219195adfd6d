"""A stop while strangers flood every port of a fleet on hosts: how soon each body brakes, and by which way.

Failing TLS handshakes keep every new link out (docs/security.md): what is left are ssh and the links of an
operator who lives. When a body brakes is what its own computer's journal says, after the command began. The
hosts are namespaces of this machine; needs root and what test hosts need.
"""

from __future__ import annotations

import re
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import BenchmarkError, NotHereError
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.flood_on_hosts import flood
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts, missing

ROUNDS: Final = 20
QUICK_ROUNDS: Final = 3
BRAKE_S: Final = 1.0
FLOOD_PER_S: Final = 240
"""Twenty a second at each of twelve ports: the least that keeps every new link out is twelve."""
FLOOD_S: Final = 3.0
"""The flood goes on for so long before the stop."""
CALM: Final = {"rate_hz": 25.0}
PATIENT: Final = {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5}
ARMS: Final = ("nobody else", "a live operator")


def run(options: Options) -> Result:
    if (reason := missing()) is not None:
        raise NotHereError(reason)
    rounds, result = QUICK_ROUNDS if options.quick else ROUNDS, Result()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name, Hosts(3) as hosts:
        stranger = hosts[2]
        fetch_wheels(hosts[0], Path(name) / "cache")
        tables = delta(list(hosts)[:2], fleet=CALM, control=PATIENT)
        fleet = FleetOnHosts(hosts, Path(name), tables, Path(name) / "cache")
        fleet.handfast("keys")
        fleet.handfast("up", timeout=UP_TIMEOUT_S)
        for arm in ARMS:
            tries = [_round(fleet, stranger, live=arm == ARMS[1]) for _ in range(rounds)]
            slowest = [max(times) for times, _ in tries]
            within = sum(each <= BRAKE_S for each in slowest)
            ways = sorted({way for _, told in tries for way in re.findall(r"\((over [^)]*)\)", told)})
            result.figures += [
                Figure(f"{arm}: the last body brakes", max(slowest), "s", BRAKE_S, note=spread(slowest)),
                Figure(f"{arm}: within {BRAKE_S:g} s", within, f"of {rounds}", rounds, at_most=False),
            ]
            result.details.append(f"{arm}: {', '.join(ways)}")
        fleet.handfast("down")
    return result


def _round(fleet: FleetOnHosts, stranger: Host, *, live: bool) -> tuple[list[float], str]:
    """When each body braked after the command began (s), and what the command said."""
    with _driving(fleet, live=live), flood(stranger, fleet, FLOOD_PER_S, FLOOD_S):
        begun_s = time.time()
        told = fleet.handfast("stop", "--reason", f"round {begun_s:.3f}", status=None)
        reason = f"braking: stop: round {begun_s:.3f}"
        return [_braked(fleet, robot, reason) - begun_s for robot in range(1, 7)], told.stdout


def _braked(fleet: FleetOnHosts, robot: int, words: str) -> float:
    """When a robot's plant said that it brakes, wall clock, s."""
    unit = f"handfast-{fleet.name}-robot-{robot}-plant"
    told = fleet.host_of(robot).run(
        ["journalctl", "-q", "-t", unit, "-o", "short-unix", "--no-pager", "-n", "50"], check=True
    )
    for line in told.stdout.splitlines():
        if words in line:
            return float(line.split()[0])
    raise BenchmarkError(f"robot {robot} did not brake: {told.stdout[-300:]}")


@contextmanager
def _driving(fleet: FleetOnHosts, *, live: bool) -> Iterator[None]:
    """The fleet drives: left alone, or with a command that goes on, of an operator who watches."""
    deadline = time.monotonic() + 120.0
    while fleet.handfast("drive", "--detach", "--resume", "--duration", "300", status=None).returncode:
        if time.monotonic() > deadline:  # after a flood, ports take some time to get through what waits there
            raise BenchmarkError("no drive begins")
    if not live:
        time.sleep(2.0)
        yield
        return
    fleet.handfast("stop", status=None)
    out = fleet.folder / f"drive-{time.monotonic_ns()}"
    watcher = fleet.start("drive", "--resume", "--duration", "300", "--out", str(out))
    try:
        recording = out / "run.mcap"
        while not (recording.exists() and recording.stat().st_size > 200_000):
            if watcher.poll() is not None or time.monotonic() > deadline:
                raise BenchmarkError(f"no drive begins: {watcher.poll()}")
            time.sleep(0.1)
        yield
    finally:
        watcher.send_signal(signal.SIGINT)
        watcher.communicate()
