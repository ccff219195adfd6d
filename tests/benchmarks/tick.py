"""One agent tick: drain, decode 4 neighbours and the plant, law, encode.

In one process, without Zenoh: *hot*, tick after tick, and *cold*, where the process sleeps before
each tick as a real one does and finds its caches cold; and at 4 Hz, of a robot that stands now and
then. Then as real agents measure it themselves in `handfast run delta`.
"""

from __future__ import annotations

import gc
import json
import tempfile
import time
import timeit
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from handfast.agent import core
from handfast.agent.control import law, safety_filter
from handfast.agent.control.peers.peers import Peers
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.links import ingress
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import HandState, Outgoing, PlantState
from handfast.agent.supervision import outbox
from handfast.agent.supervision.neighbour_trust import NeighbourTrust
from handfast.agent.supervision.situation import Situation
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.simulate import simulation
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.processes import finish, handfast

ROBOT: Final = 2
"""It has four neighbours."""
TARGET_US: Final = 110.0
TARGET_RUN_US: Final = 300.0
"""Of a tick in a run."""
OVERRUNS: Final = 0.1
"""Percent."""
COLD_SLEEP_S: Final = 0.01
SLOW_HZ: Final = 4.0
HITCHED: Final = 1.25
"""No more than so many times as long may a tick take of a robot that stands now and then."""
COMMAND_TIMEOUT_S: Final = 60.0

# Stage -> functions whose time it is.
STAGES: Final[dict[str, tuple[tuple[Any, str], ...]]] = {
    "decode": ((ingress, "decode"),),
    "accept": ((Peers, "accept"), (core.Agent, "_accept_beacon"), (Situation, "accept_plant")),
    "trust": ((NeighbourTrust, "update"),),
    "predict": ((Peers, "predict"),),
    "law": tuple(
        (law, name)
        for name in dir(law)
        if callable(getattr(law, name)) and name.islower() and getattr(law, name).__module__ == law.__name__
    ),
    "filter": tuple(
        (safety_filter, name)
        for name in ("keep_apart", "keep_clear", "limit_speed", "limit_actuators", "project")
    ),
    "encode": ((outbox, "encode"),),
    "status": ((core.Agent, "_status"),),
}


class Probe:
    """A node that is timed in a simulation; with `sleep_s` the process sleeps before each of its ticks.

    Attributes:
        node: the one (`agent.node.Node`); to be set before the simulation runs.
    """

    node: Any

    def __init__(self, sleep_s: float) -> None:
        self._sleep_s = sleep_s
        self.ticks_us: list[float] = []
        self.stages_us: list[dict[str, float]] = []
        self._now: dict[str, float] = defaultdict(float)
        self._spent_ns = 0
        self._depth: str | None = None
        self.active = False

    def __getattr__(self, name: str) -> Any:
        if name == "node":
            raise AttributeError(name)
        return getattr(self.node, name)

    def receive(self, now_ns: int, key: str, payload: bytes) -> None:
        if not self.active:
            self.active = True
            self._now.clear()
            self._spent_ns = 0
            if self._sleep_s:
                time.sleep(self._sleep_s)
        begun = time.perf_counter_ns()
        self.node.receive(now_ns, key, payload)
        self._spent_ns += time.perf_counter_ns() - begun

    def tick(self, now_ns: int) -> list[Outgoing]:
        begun = time.perf_counter_ns()
        out: list[Outgoing] = self.node.tick(now_ns)
        self._spent_ns += time.perf_counter_ns() - begun
        if self.active and self.node.condition[0] == State.RUNNING.value:
            self.ticks_us.append(self._spent_ns / 1e3)
            self.stages_us.append(dict(self._now))
        self.active = False
        return out

    def timed(self, duration_ns: int, missed: int) -> None:
        self.node.timed(duration_ns, missed)

    def wrapped(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function` with its time added to `stage`, unless another stage called it."""

        def timed(*arguments: Any, **options: Any) -> Any:
            if not self.active or self._depth is not None:
                return function(*arguments, **options)
            self._depth = stage
            begun = time.perf_counter_ns()
            try:
                return function(*arguments, **options)
            finally:
                self._now[stage] += (time.perf_counter_ns() - begun) / 1e3
                self._depth = None

        return timed


def probe(
    duration_s: float, *, sleep_s: float = 0.0, stages: bool = False, fleet: Fleet | None = None
) -> Probe:
    """Drives the delta, or another fleet, for a while and times the agent of `ROBOT`."""
    if fleet is None:
        fleet = resolved(load_fleet(fleet_path("delta"), [f"fleet.duration_s={duration_s}"]))
    probe = Probe(sleep_s)
    replaced: list[tuple[Any, str, Any]] = []
    try:
        if stages:
            for stage, functions in STAGES.items():
                for owner, name in functions:
                    function = getattr(owner, name)
                    replaced.append((owner, name, function))
                    setattr(owner, name, probe.wrapped(stage, function))
        # Only now: its agents keep some of these functions.
        driven = simulation.Simulation(fleet)
        (probe.node,) = (agent for agent in driven.agents if agent.robot == ROBOT)
        probe.node._ingress._decode = vars(ingress)["decode"]  # nobody in its process has read it before
        for host in driven._hosts:
            if host.node is probe.node:
                host.node = probe
        gc.collect()
        gc.freeze()  # as agents do
        driven.run()
    finally:
        gc.unfreeze()
        for owner, name, function in replaced:
            setattr(owner, name, function)
    return probe


def in_process(options: Options) -> Result:
    duration_s = 5.0 if options.quick else 20.0
    hot, cold = probe(duration_s), probe(duration_s, sleep_s=COLD_SLEEP_S)
    result = Result(
        [
            Figure("tick in one process, hot, median", median(hot.ticks_us), "us", TARGET_US),
            Figure("tick in one process after a sleep, median", median(cold.ticks_us), "us"),
        ]
    )
    split = [probe(duration_s, stages=True), probe(duration_s, sleep_s=COLD_SLEEP_S, stages=True)]
    rows = []
    totals = [median(each.ticks_us) for each in split]
    rest = list(totals)
    for stage in STAGES:
        found = [
            median([ticks[stage] for ticks in each.stages_us if stage in ticks] or [0.0]) for each in split
        ]
        often = sum(stage in ticks for ticks in split[0].stages_us) / len(split[0].stages_us)
        if often > 0.5:
            rest = [left - us for left, us in zip(rest, found, strict=True)]
        note = "" if often > 0.5 else f"in one tick of {1.0 / often:.0f}" if often else "not found"
        rows.append([stage, *(f"{us:.1f}" for us in found), note])
    rows.append(["the rest", *(f"{us:.1f}" for us in rest), ""])
    rows.append(["tick (timers included)", *(f"{us:.1f}" for us in totals), ""])
    result.details += table(["stage", "hot us", "cold us", ""], rows)
    return result


def after_a_hitch(options: Options) -> Result:
    """A fleet at 4 Hz, one of whose robots stands for a moment every few seconds: what its ticks take then.

    What makes ticks longer because the last one was late has a full machine stand for good.
    """
    medians = []
    for share in (0, 5):
        text = lattice("slow", 20, rate_hz=SLOW_HZ, duration_s=15.0 if options.quick else 60.0)
        hitches = f'[[faults.rule]]\nrobot = {ROBOT}\ntick_jitter = "600ms {share}%"\n'
        found = probe(0.0, fleet=resolved(parse_fleet(f"{text}\n{hitches}", source="slow")))
        medians.append(median(found.ticks_us))
    ratio = medians[1] / medians[0]
    note = f"{medians[1]:.0f} and {medians[0]:.0f} us"
    return Result([Figure("tick at 4 Hz of one that stands at times / never", ratio, "", HITCHED, note=note)])


def codec() -> Result:
    """Bytes of the messages of every tick to checked messages, and back, tick after tick."""
    multipliers = tuple((robot, 0.5 / robot) for robot in range(1, 5))
    place = (1.25, -0.5, 0.3, 0.01)
    hand = HandState.placed(2, FIRST_ROUND + 500, 10**18, True, 4, place)._replace(multipliers=multipliers)
    plant = PlantState(2, FIRST_ROUND + 500, 10**18, *place, 0.2, 1.5, 0.1, True, True, True, "")
    result = Result([])
    for name, message in (("hand state of 4 multipliers", hand), ("plant state", plant)):
        payload = encode(message)
        for what, call in (("decode", partial(decode, payload)), ("encode", partial(encode, message))):
            times = timeit.repeat(call, number=20_000, repeat=7)
            result.figures.append(Figure(f"{what} a {name}", 1e6 * min(times) / 20_000, "us"))
    return result


def in_a_run(options: Options) -> Result:
    """`handfast run delta` for a minute: what its agents say of their ticks, what its plants left out."""
    duration_s = 15 if options.quick else 60
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        out = Path(folder) / "run"
        command = handfast("run", "delta", "--quiet", "--no-report", "--out", str(out))
        finish([*command, "--duration", str(duration_s)], duration_s + COMMAND_TIMEOUT_S)
        metrics = json.loads((out / "metrics.json").read_text())
        recording = read_run(out)
    ticks = sum(len(robot.status.tick_us) for robot in recording.robots.values())
    overruns = metrics["tick"]["overruns"]
    period_s = recording.fleet.period_ns / 1e9
    plants = missed = 0
    for robot in recording.robots.values():
        times = robot.plant.t[(robot.plant.t > 0.0) & (robot.plant.t <= recording.end_s)]
        plants += len(times)
        missed += int(np.rint(np.diff(times) / period_s - 1.0).clip(min=0).sum())
    messages = metrics["messages"]
    return Result(
        [
            Figure("tick in a run, median", metrics["tick"]["p50_us"], "us", TARGET_RUN_US),
            Figure("tick in a run, 99th percentile", metrics["tick"]["p99_us"], "us"),
            Figure(
                "ticks missed by agents",
                100.0 * overruns / (ticks + overruns),
                "%",
                OVERRUNS,
                note=f"{overruns} of {ticks + overruns}, 12 processes, {duration_s} s",
            ),
            Figure(
                "ticks missed by plants",
                100.0 * missed / (plants + missed),
                "%",
                OVERRUNS,
                note=f"{missed} of {plants + missed}, by gaps in their states",
            ),
            Figure(
                "hand states lost on the way",
                100.0 * messages["lost"] / max(1, messages["sent"]),
                "%",
                note="loopback",
            ),
        ]
    )


def run(options: Options) -> Result:
    first, *others = in_process(options), after_a_hitch(options), codec(), in_a_run(options)
    return Result(first.figures + [figure for each in others for figure in each.figures], first.details)
