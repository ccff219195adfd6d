"""How many robots' traffic one router carries at 10 Hz: bare publishers and subscribers over it.

Every robot is a client of the router that says a hand state of 170 bytes ten times a second, to those next to
it in a lattice, six or fewer, and to an operator who hears all. All say it at the same time, as robots' ticks
lie on one grid. Some dozens of them share a process that does nothing else; what these take of the machine is
not the router's, so both are shown, and how often one of them did not get the processor in time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import tomli_w
import zenoh

from agent.common.time import NS_PER_S
from agent.fleet.loading import parse_fleet, to_dict
from agent.formation.geometry import resolved
from agent.transport import bus as robots_bus
from deploy.analysis.lattice import edges, lattice, places
from deploy.processes.placement import place
from tests.benchmarks.figures import number, table
from tests.benchmarks.processes import BenchmarkError, Group, cpu_s, environment, start_routers

PERIOD_NS: Final = NS_PER_S // 10
SIZE: Final = 170
LATE_NS: Final = PERIOD_NS // 2
"""What comes later may come after the tick that it was for."""
SLIPPED_NS: Final = PERIOD_NS // 5
"""A process of robots that wakes so late does not know when messages came."""
EACH: Final = 25
"""Robots of one process."""
AHEAD_NS: Final = 2 * NS_PER_S
OPERATOR: Final = 0


class Carried(NamedTuple):
    """What a router did with the traffic of so many robots.

    Attributes:
        passed: messages passed on a second.
        router, others: its processor time in a second, and that of all robots' processes together.
        lost, late: shares of these messages.
        slipped: share of the rounds in which robots' processes were late themselves.
    """

    robots: int
    passed: float
    router: float
    lost: float
    late: float
    others: float
    slipped: float

    def row(self) -> list[str]:
        shares = (self.lost, self.late, self.slipped)
        lost, late, slipped = (f"{100.0 * share:.2f}" for share in shares)
        cpu = [number(1000.0 * each) for each in (self.router, self.others)]
        return [str(self.robots), number(self.passed), cpu[0], lost, late, cpu[1], slipped]


HEADING: Final = (
    "robots", "passed on /s", "router ms/s", "lost %", "late %", "robots' side ms/s", "it was late %",
)  # fmt: skip


class _Robot:
    """One client of the router: what it says, and whom it hears."""

    def __init__(self, robot: int, heard: Sequence[str], router: str) -> None:
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [f"tcp/{router}"],
            "connect/timeout_ms": 20_000,
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self._inboxes = [
            self.session.declare_subscriber(f"all/{other}", zenoh.handlers.RingChannel(1024))
            for other in heard
        ]
        self._publisher = None
        if robot != OPERATOR:
            drop = zenoh.CongestionControl.DROP
            self._publisher = self.session.declare_publisher(f"all/{robot}", congestion_control=drop)

    def say(self, tick: int) -> None:
        if self._publisher is not None:
            self._publisher.put(tick.to_bytes(8, "little").ljust(SIZE, b"\0"))

    def heard(self) -> list[int]:
        """The ticks of which something has come since the last call."""
        ticks = []
        for inbox in self._inboxes:
            while (sample := inbox.try_recv()) is not None:
                ticks.append(int.from_bytes(sample.payload.to_bytes()[:8], "little"))
        return ticks


def main() -> None:
    """Some of the robots, or the operator; prints how many messages came in time, how many later, in how many
    rounds it was late itself, and its processor time."""
    order = json.loads(sys.argv[1])
    robots = [_Robot(int(robot), heard, order["router"]) for robot, heard in order["robots"].items()]
    print(flush=True)
    begin, end = map(int, sys.stdin.readline().split())
    in_time = later = slipped = 0
    used = time.process_time()
    for tick in range(begin, end):
        _wait(tick * PERIOD_NS)
        for each in robots:
            each.say(tick)
        slipped += _wait(tick * PERIOD_NS + LATE_NS) > SLIPPED_NS
        for each in robots:
            for came in each.heard():
                in_time += came == tick
                later += begin <= came < tick
    time.sleep(1.0)
    later += sum(came < end for each in robots for came in each.heard() if came >= begin)
    print(json.dumps([in_time, later, slipped, time.process_time() - used]), flush=True)
    os._exit(0)


def _wait(until_ns: int) -> int:
    """Returns by how much it is later than that, ns."""
    while (left_ns := until_ns - time.time_ns()) > 0:
        time.sleep(left_ns / NS_PER_S)
    return -left_ns


def carried(count: int, seconds: float) -> Carried:
    """What a router does for so many robots."""
    neighbours: dict[int, list[str]] = {robot: [] for robot in range(1, count + 1)}
    for i, j in edges(places(count)):
        neighbours[i].append(str(j))
        neighbours[j].append(str(i))
    fleet = resolved(parse_fleet(lattice(f"router{count}", count), source="lattice"))
    fleet = replace(fleet, network=replace(fleet.network, topology="routed"))
    fleet, ports, _ = place(fleet)
    try:
        with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name, ExitStack() as stack:
            path = Path(name) / "fleet.toml"
            path.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
            group = stack.enter_context(Group(Path(name)))
            start_routers(group, fleet, path)
            router = fleet.network.routers[0]
            shares: list[dict[str, list[str]]] = [{str(OPERATOR): ["*"]}]
            for first in range(1, count + 1, EACH):
                last = min(first + EACH, count + 1)
                shares.append({str(robot): neighbours[robot] for robot in range(first, last)})
            clients = [_started(stack, {"router": router, "robots": share}) for share in shares]
            _told(clients)
            begin = (time.time_ns() + AHEAD_NS) // PERIOD_NS
            end = begin + round(seconds * NS_PER_S / PERIOD_NS)
            for client in clients:
                assert client.stdin is not None
                client.stdin.write(f"{begin} {end}\n")
                client.stdin.flush()
            _wait(begin * PERIOD_NS)
            (pid,) = group.pids("router")
            used = cpu_s(pid)
            _wait(end * PERIOD_NS)
            used = cpu_s(pid) - used
            rows = [json.loads(line) for line in _told(clients)]
    finally:
        ports.close()
    in_time, later, slipped, others = (sum(column) for column in zip(*rows, strict=True))
    expected = (end - begin) * (count + sum(map(len, neighbours.values())))
    return Carried(
        count,
        expected / seconds,
        used / seconds,
        max(0.0, 1.0 - (in_time + later) / expected),
        later / expected,
        others / seconds,
        slipped / (len(clients) * (end - begin)),
    )


def _started(stack: ExitStack, order: dict[str, Any]) -> subprocess.Popen[str]:
    client = subprocess.Popen(
        [sys.executable, "-P", "-m", "tests.benchmarks.router_curve", json.dumps(order)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment({"ZENOH_RUNTIME": robots_bus.RUNTIME}),
        text=True,
    )
    stack.callback(client.wait)
    stack.callback(client.kill)
    return client


def _told(clients: Sequence[subprocess.Popen[str]]) -> list[str]:
    lines = []
    for client in clients:
        assert client.stdout is not None
        lines.append(client.stdout.readline())
    if not all(lines):
        raise BenchmarkError("one of the processes of robots has failed")
    return lines


def curve(sizes: Sequence[int], seconds: float) -> tuple[list[Carried], list[str]]:
    """What a router does for fleets of these sizes, and a table of it."""
    found = [carried(size, seconds) for size in sizes]
    return found, table(HEADING, [each.row() for each in found])


if __name__ == "__main__":
    main()
