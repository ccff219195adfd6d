"""One robot of a large fleet as it runs, on a machine that could not carry the fleet.

The fleet drives in virtual time, from a time that is to come, and what it says is kept. When that time is
there, the agent and the plant of one robot run as processes behind a router, and all that the others had said
is published through it, each message at its time: they cannot tell. What that robot itself had said in
virtual time is left out; its own processes say it. What it hears, and what it costs, is so that of a robot in
a real fleet of that size; how late messages are on a machine that is full is not in it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import tomli_w

from agent.__main__ import main as agent_main
from agent.common.time import NS_PER_S
from agent.fleet.loading import to_dict
from agent.fleet.model import Fleet
from agent.messages import key_expressions
from agent.messages.codec import decode
from agent.messages.types import Status
from agent.supervision.state_machine import State
from agent.transport.bus import Bus
from deploy.processes.placement import place
from deploy.simulate.simulation import Simulation
from tests.benchmarks.processes import ROLES, BenchmarkError, Group, cpu_s, start_routers

LEAD_S: Final = 3.0
"""The processes are started so long before the first message."""
COUNTED: Final = "counted.json"
COUNT_S: Final = 0.2
SETTLE_S: Final = 3.0
TRIAL_S: Final = 0.5
SLACK: Final = 1.6
"""The others' messages are made in at most so many times the processor time that a trial has taken."""


@dataclass
class Cost:
    """What one robot costs, and hears.

    Attributes:
        cpu: by role, share of a core.
        heard: messages a second that its agent takes off the bus, by the last word of their keys.
        state: of its agent in the end.
        overruns: ticks that it missed.
        late_ms: the latest that a message of the others was published after its time.
    """

    cpu: dict[str, float] = field(default_factory=dict)
    heard: dict[str, float] = field(default_factory=dict)
    state: str = ""
    overruns: int = 0
    late_ms: float = 0.0

    @property
    def robot(self) -> float:
        """CPU of agent and plant."""
        return sum(self.cpu.values())

    @property
    def messages(self) -> float:
        return sum(self.heard.values())


Said = list[tuple[int, str, bytes]]


def said_by_others(fleet: Fleet, robot: int, window_s: float, begin_ns: int) -> Said:
    """What all but `robot` and the operator say from `begin_ns` on, as (time ns, key, payload), and what the
    operator does."""
    mine = key_expressions.hand(fleet.fleet.name, robot).removesuffix("hand")
    said: Said = []

    def sink(arrival_ns: int, key: str, payload: bytes) -> None:
        if not key.startswith(mine):
            said.append((arrival_ns, key, payload))

    simulation = Simulation(fleet, sink, begin_ns)
    if not simulation.start(round((window_s + 60.0) * NS_PER_S)):
        raise BenchmarkError("; ".join(simulation.reasons))
    simulation.run_until(simulation.epoch_ns + round(window_s * NS_PER_S))
    return said


def _takes_s(fleet: Fleet, robot: int, window_s: float) -> float:
    """How long `said_by_others` takes at most, from a shorter one."""
    begun = time.perf_counter()
    said = said_by_others(fleet, robot, TRIAL_S, 0)
    trial_s, simulated_s = time.perf_counter() - begun, said[-1][0] / NS_PER_S
    return SLACK * trial_s * (1.0 + (window_s - TRIAL_S) / simulated_s)


def measure(fleet: Fleet, robot: int, folder: Path, window_s: float, *, count: bool = False) -> Cost:
    """What `robot` of `fleet` (resolved, routed) costs while the fleet drives, in a window of so long.

    Args:
        folder: new, for logs and the fleet file.
        count: counts what its agent hears, which costs a little: not to be taken for what it costs.
    """
    folder.mkdir(parents=True)
    fleet, ports, _ = place(fleet)
    span_s = SETTLE_S + window_s
    try:
        begin_ns = time.time_ns() + round((_takes_s(fleet, robot, span_s + 1.0) + LEAD_S) * NS_PER_S)
        said = said_by_others(fleet, robot, span_s + 1.0, begin_ns)
        if time.time_ns() > begin_ns - round(LEAD_S * NS_PER_S / 2):
            raise BenchmarkError("this machine was too slow to make the others' messages in time")
        path = folder / "fleet.toml"
        path.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
        with ExitStack() as stack:
            group = stack.enter_context(Group(folder))
            words = ["--fleet", str(path), "--exit-with-parent"]
            start_routers(group, fleet, path)
            routers = [f"tcp/{router}" for router in fleet.network.routers]
            bus = stack.enter_context(Bus(listen=[], connect=[], routers=routers, robots=len(fleet.ids)))
            for role in ROLES:
                module = ["tests.benchmarks.fed_robot", str(folder / COUNTED)] if count else [role]
                module = module if role == "agent" else [role]
                command = [sys.executable, "-P", "-m", *module, *words, "--robot", str(robot)]
                group.start(robot, role, command, {})
            return _fed(fleet, robot, group, bus, said, window_s, folder / COUNTED)
    finally:
        ports.close()


def _fed(
    fleet: Fleet,
    robot: int,
    group: Group,
    bus: Bus,
    said: Said,
    window_s: float,
    counted: Path,
) -> Cost:
    name, cost = fleet.fleet.name, Cost()
    for key in {key for _, key, _ in said}:
        bus.declare(key)
    bus.subscribe(key_expressions.status(name, robot), 1024)
    for other in fleet.ids:
        for role in ROLES if other != robot else ():
            bus.announce(key_expressions.alive(name, other, role))
    epoch_ns = said[-1][0] - round((SETTLE_S + window_s + 1.0) * NS_PER_S)
    edges = iter((epoch_ns + round(SETTLE_S * NS_PER_S), said[-1][0] - NS_PER_S))
    due_ns: int | None = next(edges)
    used: list[tuple[float, dict[str, float]]] = []
    heard: list[tuple[float, Counter[str]]] = []
    for at_ns, key, payload in said:
        if due_ns is not None and at_ns >= due_ns:
            used.append((time.monotonic(), _used(group)))
            heard.append(_counted(counted))
            due_ns = next(edges, None)
        wait_ns = at_ns - time.time_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / NS_PER_S)
        cost.late_ms = max(cost.late_ms, (time.time_ns() - at_ns) / 1e6)
        bus.publish(key, payload)
    group.check()
    for _, payload in bus.drain():
        status = decode(payload)
        if type(status) is Status:
            cost.state, cost.overruns = status.state, dict(status.counters).get("overruns", 0)
    if cost.state not in (State.RUNNING.value, State.DEGRADED.value):
        raise BenchmarkError(
            f"robot {robot} of {len(fleet.ids)} does not drive, but is {cost.state or 'silent'}"
        )
    (begun, before), (ended, after) = used
    cost.cpu = {role: (after[role] - before[role]) / (ended - begun) for role in ROLES}
    (begun, few), (ended, many) = heard
    cost.heard = {kind: number / (ended - begun) for kind, number in (many - few).items()}
    return cost


def _used(group: Group) -> dict[str, float]:
    return {role: sum(map(cpu_s, group.pids(role))) for role in ROLES}


def _counted(path: Path) -> tuple[float, Counter[str]]:
    """When it was counted last, and what."""
    try:
        at_s, counts = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return 0.0, Counter()
    return at_s, Counter(counts)


def main() -> int:
    """An agent that writes, a few times a second, into the file that is its first argument how many messages
    of which kind it has taken off its bus."""
    path = Path(sys.argv[1])
    counts: Counter[str] = Counter()
    drain: Any = Bus.drain
    wrote_s = 0.0

    def counting(bus: Bus) -> Iterator[tuple[str, bytes]]:
        nonlocal wrote_s
        for key, payload in drain(bus):
            counts[key.rpartition("/")[2]] += 1
            yield key, payload
        if time.monotonic() - wrote_s > COUNT_S:
            wrote_s = time.monotonic()
            new = path.with_suffix(".new")
            new.write_text(json.dumps([wrote_s, counts]), encoding="utf-8")
            os.replace(new, path)

    Bus.drain = counting  # type: ignore[method-assign,assignment]
    return agent_main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
