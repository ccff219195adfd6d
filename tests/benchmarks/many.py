"""Large fleets on one machine: do they start, hear, drive and end, what does a robot of them cost, and what
happens beyond what the machine carries.

Fleets are triangular lattices of 1 m (`deploy.analysis.lattice`), driven by `handfast run`. Where no machine
at hand carries the fleet, one robot of it runs for real and hears what all others say in virtual time
(`tests.benchmarks.fed_robot`). What the machine did meanwhile is in the load that is told with each.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from math import nan
from pathlib import Path
from statistics import median
from typing import Final

from agent.common.time import NS_PER_S
from agent.core import Agent
from agent.fleet.loading import parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.supervision.state_machine import DRIVING_NAMES
from deploy.analysis.lattice import lattice
from deploy.check.capacity import FULL, RATES_HZ, carried, cost_of, settings, slower, used
from deploy.console.data_files import FLEETS
from deploy.processes.machine import measured
from deploy.recording.recording import Recording
from deploy.simulate.simulation import Simulation
from tests.benchmarks import fed_robot, router_curve
from tests.benchmarks.commands import STOP_S, braked, command
from tests.benchmarks.figures import Figure, Options, Result, number, spread, table
from tests.benchmarks.local_runs import Found, Running, recorded, run_once, write_lattice
from tests.benchmarks.processes import BenchmarkError
from tests.benchmarks.scaling import ring

START: Final = 30, 10.0
STARTS: Final = 50
STARTS_QUICK: Final = 2
START_S: Final = 5.0
SIZES: Final = ((24, 10.0), (45, 10.0), (60, 10.0), (100, 10.0), (200, 4.0))
SIZES_QUICK: Final = SIZES[:2]
DRIVE_S: Final = 15.0
MISSED: Final = 0.001
DRIVING_S: Final = {12: 1.5, 90: 8.0, 200: 15.0}
"""How soon after the command so many processes are to drive."""
FED: Final = (6, 25, 100)
FED_QUICK: Final = (6, 25)
FED_HZ: Final = 10.0
VIRTUAL: Final = (6, 25, 100)
VIRTUAL_QUICK: Final = (6, 25, 50)
VIRTUAL_AFTER_S: Final = 3.0
HOG_ROBOTS: Final = 24
HOG_AFTER_S, HOG_S, HOG_THEN_S = 8.0, 10.0, 12.0
BACK_S: Final = 5.0
BEYOND_ROBOTS: Final = 45
LIMIT_HZ: Final = (10.0, 5.0)
LIMIT_TRIES: Final = 2
NEXT: Final = 48, 52
NEXT_HZ: Final = 5.0
ROUTED: Final = (25, 50, 100, 200, 400, 800)
ROUTED_QUICK: Final = (50, 200)
HEADING: Final = (
    "fleet", "alive s", "drives s", "missed %", "tick p99 ms", "settled", "deaf", "anew", "not ended", "exit",
    "agent / model", "plant / model", "routers / model", "run / model, ms/s", "load",
)  # fmt: skip


def row(name: str, found: Found) -> list[str]:
    """One run, in words."""
    tick_ms = found.metrics["tick"]["p99_us"] if found.metrics else None
    return [
        name,
        number(found.alive_s),
        number(found.drive_s),
        number(100.0 * found.missed) if found.drove else "-",
        number(tick_ms / 1000.0) if tick_ms is not None else "-",
        "yes" if found.settled else "no",
        f"{found.deaf} of {found.directions}",
        str(found.opened_anew),
        str(found.killed),
        str(found.status),
        *(_against_model(found, role) for role in ("agent", "plant", "router", "run")),
        number(found.load),
    ]


def _against_model(found: Found, role: str) -> str:
    """What a role took, and by the model of `handfast check`, ms/s."""
    return f"{number(1000.0 * found.cpu.get(role, nan))} / {number(1000.0 * found.model.get(role, nan))}"


def is_good(found: Found) -> bool:
    """Whether a run is what a lattice is to do: settled, and hardly a tick missed."""
    return found.drove and found.missed < MISSED and found.settled


def starts(folder: Path, count: int) -> tuple[list[Figure], list[str]]:
    """Starts of one fleet, one after the other."""
    robots, rate_hz = START
    file = write_lattice(folder, robots, rate_hz)
    found = [run_once(file, folder / f"start{k}", START_S, "--no-check") for k in range(count)]
    name = f"starts of {robots} at {rate_hz:g} Hz"
    shares = (
        (
            "all hear all neighbours, drive, end when asked",
            lambda run: run.drove and run.heard_all and run.ended,
        ),
        ("all hear all neighbours", lambda run: run.heard_all),
        ("all drive", lambda run: run.drove),
        ("all end when asked", lambda run: run.ended),
    )
    figures = [
        Figure(
            f"{name}: {what}", sum(map(is_so, found)), f"of {count}", count if k == 0 else None, at_most=False
        )
        for k, (what, is_so) in enumerate(shares)
    ]
    drive_s = [run.drive_s for run in found if run.drove]
    if drive_s:
        figures.append(Figure(f"{name}: command to driving", median(drive_s), "s", note=spread(drive_s)))
    anew = sum(run.opened_anew for run in found)
    figures.append(
        Figure(f"{name}: links opened anew", anew, "", note=f"{sum(r.killed for r in found)} killed")
    )
    return figures, table(HEADING, [row(f"start {k}", run) for k, run in enumerate(found, 1)])


def sizes(folder: Path, fleets: Sequence[tuple[int, float]]) -> tuple[list[Figure], list[str]]:
    """The same lattice, larger and larger; beside it the small one that all know."""
    delta = run_once("delta", folder / "delta", DRIVE_S)
    rows, figures = [row("delta", delta)], []
    driving = {12: delta.drive_s}
    best = {10.0: 0.0, 4.0: 0.0}
    for robots, rate_hz in fleets:
        name = f"{robots} at {rate_hz:g} Hz"
        found = run_once(
            write_lattice(folder, robots, rate_hz), folder / f"drive{robots}", DRIVE_S, "--no-check"
        )
        rows.append(row(name, found))
        if is_good(found):
            best[rate_hz] = max(best[rate_hz], robots)
        driving[2 * robots] = found.drive_s
    aims = {10.0: 100, 4.0: 200}
    for rate_hz in sorted({rate_hz for _, rate_hz in fleets}, reverse=True):
        what = f"largest lattice at {rate_hz:g} Hz that settles, of 1,000 ticks less than 1 missed"
        tried = ", ".join(str(robots) for robots, its_hz in fleets if its_hz == rate_hz)
        figures.append(
            Figure(what, best[rate_hz], "robots", aims[rate_hz], at_most=False, note=f"tried {tried}")
        )
    for processes, limit_s in DRIVING_S.items():
        if processes in driving:
            figures.append(
                Figure(f"command to driving, {processes} processes", driving[processes], "s", limit_s)
            )
    return figures, table(HEADING, rows)


def at_the_limit(folder: Path, tries: int) -> tuple[list[Figure], list[str]]:
    """As many robots as `handfast run` says that this machine carries, at some rates: do they drive?"""
    rows, good, count = [], 0, 0
    for rate_hz in LIMIT_HZ:
        for k in range(tries):
            # Asked each time, as who starts a fleet does: the machine is not as fast at all times.
            robots = carried(slower(_lattice(100, 10.0), rate_hz), measured())
            found = _run_slower(folder, robots, rate_hz, f"limit{rate_hz:g}-{k}")
            rows.append(row(f"{robots} at {rate_hz:g} Hz", found))
            good, count = good + is_good(found), count + 1
    what = "fleets as large as the model says that this machine carries that settle, hardly a tick missed"
    return [Figure(what, good, f"of {count}", count, at_most=False)], table(HEADING, rows)


def with_a_few_more(folder: Path) -> tuple[list[Figure], list[str]]:
    """What a robot and its router cost in two fleets of almost the same size: hardly more in the larger."""
    found = [_run_slower(folder, robots, NEXT_HZ, f"next{robots}") for robots in NEXT]
    few, more = NEXT
    name = f"lattices of {few} and of {more} robots at {NEXT_HZ:g} Hz"
    figures = [
        *(
            Figure(
                f"{name}: CPU of {who}, ratio",
                found[1].cpu.get(role, nan) / found[0].cpu.get(role, nan),
                "",
                1.3,
            )
            for who, role in (("an agent", "agent"), ("the router", "router"))
        ),
        Figure(f"{name}: the larger one settles", float(is_good(found[1])), "", 1, at_most=False),
    ]
    return figures, table(
        HEADING, [row(f"{robots} at {NEXT_HZ:g} Hz", run) for robots, run in zip(NEXT, found, strict=True)]
    )


def _run_slower(folder: Path, robots: int, rate_hz: float, name: str) -> Found:
    """Drives a lattice at a lower rate, with what `handfast run` proposes for that."""
    fleet = _lattice(robots, 10.0)
    words = [word for each in settings(fleet, slower(fleet, rate_hz)) for word in ("--set", each)]
    file = write_lattice(folder, robots, 10.0)
    return run_once(file, folder / name, DRIVE_S, "--no-check", *words)


def bundled(folder: Path) -> tuple[list[Figure], list[str]]:
    """Every bundled fleet as it is, for a few seconds, without judging whether it gets to its places."""
    rows, good = [], 0
    names = sorted(path.stem for path in FLEETS.glob("*.toml"))
    for name in names:
        found = run_once(name, folder / f"bundled-{name}", START_S, "--no-check")
        rows.append(row(name, found))
        good += found.drove and found.missed < 0.01 and found.ended
    what = "bundled fleets that drive as they are, of 100 ticks less than 1 missed"
    return [Figure(what, good, f"of {len(names)}", len(names), at_most=False)], table(HEADING, rows)


def in_fleets(folder: Path, fleets: Sequence[int], window_s: float) -> tuple[list[Figure], list[str]]:
    """What one robot costs and hears in fleets of these sizes, with four neighbours in each."""
    costs: dict[int, fed_robot.Cost] = {}
    heard: dict[int, fed_robot.Cost] = {}
    for robots in fleets:
        fleet = _routed(ring(robots, FED_HZ))
        costs[robots] = fed_robot.measure(fleet, robots // 2, folder / f"fed{robots}", window_s)
        heard[robots] = fed_robot.measure(
            fleet, robots // 2, folder / f"counted{robots}", window_s, count=True
        )
    kinds = sorted({kind for each in heard.values() for kind in each.heard})
    rows = [
        [
            f"{robots} robots",
            *(number(1000.0 * costs[robots].cpu[role]) for role in ("agent", "plant")),
            *(number(heard[robots].heard.get(kind, 0.0)) for kind in kinds),
            str(costs[robots].overruns),
            number(costs[robots].late_ms),
        ]
        for robots in fleets
    ]
    heading = [
        f"ring at {FED_HZ:g} Hz, fed", "agent ms/s", "plant ms/s", *(f"{kind} /s" for kind in kinds),
        "missed", "fed late ms",
    ]  # fmt: skip
    small, large = fleets[0], fleets[-1]
    figures = [
        Figure(
            f"CPU of a robot in a fleet of {large} / {small}, same degree and density",
            costs[large].robot / costs[small].robot,
            "",
            1.2,
        )
    ]
    if 25 in heard and large > 25:
        ratio = heard[large].messages / heard[25].messages
        figures.append(Figure(f"messages a second that a robot hears, fleet of {large} / 25", ratio, "", 1.1))
    return figures, table(heading, rows)


def in_virtual_time(fleets: Sequence[int], window_s: float) -> tuple[list[Figure], list[str]]:
    """What one robot hears in the same fleets in virtual time, and the processor time of one there: agent and
    plant without bus and processes."""
    heard: dict[int, Counter[str]] = {}
    cpu_ms: dict[int, float] = {}
    for robots in fleets:
        simulation = Simulation(_routed(ring(robots, FED_HZ)))
        if not simulation.start(round(2.0 * (VIRTUAL_AFTER_S + window_s) * NS_PER_S)):
            raise BenchmarkError("; ".join(simulation.reasons))
        simulation.run_until(simulation.epoch_ns + round(VIRTUAL_AFTER_S * NS_PER_S))
        counts = heard[robots] = _counted(simulation.agents[robots // 2])
        used = time.process_time()
        simulation.run_until(simulation.now_ns + round(window_s * NS_PER_S))
        cpu_ms[robots] = 1000.0 * (time.process_time() - used) / window_s / robots
        for kind in counts:
            counts[kind] = round(counts[kind] / window_s)
    kinds = sorted({kind for each in heard.values() for kind in each})
    rows = [
        [f"{robots} robots", *(str(heard[robots][kind]) for kind in kinds), number(cpu_ms[robots])]
        for robots in fleets
    ]
    heading = [
        f"ring at {FED_HZ:g} Hz, virtual time", *(f"{kind} /s" for kind in kinds), "CPU of a robot ms/s",
    ]  # fmt: skip
    base, large = min(robots for robots in fleets if robots >= 25), fleets[-1]
    what = f"messages a second that a robot hears in virtual time, fleet of {large} / {base}"
    ratio = heard[large].total() / heard[base].total()
    return [Figure(what, ratio, "", 1.1 if large > base else None)], table(heading, rows)


def _counted(agent: Agent) -> Counter[str]:
    """Counts from now on what an agent takes off the bus, by the last word of the keys."""
    counts: Counter[str] = Counter()
    receive = agent.receive

    def counting(now_ns: int, key: str, payload: bytes) -> None:
        counts[key.rpartition("/")[2]] += 1
        receive(now_ns, key, payload)

    agent.receive = counting  # type: ignore[method-assign]
    return counts


def _routed(fleet: Fleet) -> Fleet:
    return replace(fleet, network=replace(fleet.network, topology="routed"))


@contextmanager
def hogs() -> Iterator[None]:
    """A busy loop on each core."""
    with ExitStack() as stack:
        for core in sorted(os.sched_getaffinity(0)):
            words = ["-c", f"import os\nos.sched_setaffinity(0, {{{core}}})\nwhile True: pass"]
            hog = subprocess.Popen([sys.executable, *words])
            stack.callback(hog.wait)
            stack.callback(hog.kill)
        yield


def hogged(folder: Path) -> tuple[list[Figure], list[str]]:
    """A drive while other programs take the machine for a while."""
    spans: list[float] = []

    def meanwhile(running: Running) -> None:
        time.sleep(HOG_AFTER_S)
        spans.append(time.time())
        with hogs():
            time.sleep(HOG_S)
        spans.append(time.time())

    out = folder / "hogged"
    duration_s = HOG_AFTER_S + HOG_S + HOG_THEN_S
    file = write_lattice(folder, HOG_ROBOTS, 10.0)
    found = run_once(file, out, duration_s, "--no-check", meanwhile=meanwhile)
    recording = recorded(out)
    if recording is None or not found.drove or recording.epoch_ns is None:
        return [], ["the fleet beside which hogs were to run did not drive"]
    begin_s, end_s = (at - recording.epoch_ns / 1e9 for at in spans)
    silent = _said(recording, begin_s, end_s + BACK_S, r"silent|deaf|gone|not heard|plant")
    back_s = max((at_s - end_s for at_s in _not_driving(recording, begin_s)), default=0.0)
    closest = found.metrics["min_distance_m"]["any"]
    figures = [
        Figure("CPU hogs: reasons that name silent robots or plants", len(silent), "", 0),
        Figure(
            "CPU hogs: closest pair", closest, "m", recording.fleet.formation.safe_distance_m, at_most=False
        ),
        Figure("CPU hogs: the last robot drives again after their end", max(0.0, back_s), "s", BACK_S),
    ]
    return figures, [*table(HEADING, [row("beside hogs", found)]), *sorted(set(silent))[:8]]


def _said(recording: Recording, begin_s: float, end_s: float, words: str) -> list[str]:
    """Reasons in that time that have one of these words."""
    told = []
    for robot in recording.ids:
        status = recording.robots[robot].status
        for t, state, reason in zip(status.t.tolist(), status.states, status.reasons, strict=True):
            if begin_s <= t <= end_s and re.search(words, reason):
                told.append(f"robot {robot}: {state} ({reason})")
    return told


def _not_driving(recording: Recording, begin_s: float) -> Iterator[float]:
    """Times from `begin_s` to the end of the drive at which a robot said that it does not drive, or that it
    drives more slowly than it should."""
    for robot in recording.ids:
        status = recording.robots[robot].status
        for t, state, reason in zip(status.t.tolist(), status.states, status.reasons, strict=True):
            if begin_s <= t < recording.end_s and (state not in DRIVING_NAMES or reason):
                yield t


def beyond(folder: Path, robots: int, rate_hz: float) -> tuple[list[Figure], list[str]]:
    """A fleet of twice what the machine carries: what it does, and whether it can be stopped."""
    stops: list[tuple[int, float]] = []
    told: list[str] = []

    def meanwhile(_: Running) -> None:
        time.sleep(0.5 * DRIVE_S)
        took_s, status, said = command("stop", f"lattice{robots}")
        told.append(f"handfast stop: {took_s:.1f} s, exit status {status}")
        stops.append(braked(said))

    out = folder / "beyond"
    file = write_lattice(folder, robots, rate_hz)
    found = run_once(file, out, DRIVE_S, "--no-check", meanwhile=meanwhile)
    rows = table(HEADING, [row(f"{robots} at {rate_hz:g} Hz", found)])
    name = f"beyond what it carries ({robots} at {rate_hz:g} Hz)"
    figures = [Figure(f"{name}: drives at all", float(found.drove), "", 1, at_most=False)]
    if not found.metrics:
        return figures, rows
    closest, verdict = found.metrics["min_distance_m"]["any"], found.metrics["verdict"]
    said = sum("too slow for its processes" in each for each in [*verdict["warnings"], *verdict["reasons"]])
    took, last_s = stops[-1] if stops else (0, nan)
    figures += [
        Figure(f"{name}: closest pair", nan if closest is None else closest, "m", 0.22, at_most=False),
        Figure(f"{name}: says that the machine is too slow", float(said), "", 1, at_most=False),
        Figure(f"{name}: a stop is taken by the last robot after", last_s, "s", STOP_S),
        Figure(f"{name}: robots that took the stop", took, f"of {robots}", robots, at_most=False),
    ]
    return figures, [*rows, *told]


def carries() -> tuple[int, float]:
    """How many robots of a lattice this machine carries at 10 Hz by the model, and the rate at which
    `BEYOND_ROBOTS` need about twice what it has."""
    machine = measured()
    large = _lattice(BEYOND_ROBOTS, 10.0)
    rates = [
        rate_hz
        for rate_hz in sorted(RATES_HZ)
        if used(cost_of(slower(large, rate_hz)), machine) >= 2.0 * FULL
    ]
    return carried(_lattice(100, 10.0), machine), rates[0] if rates else RATES_HZ[0]


def _lattice(robots: int, rate_hz: float) -> Fleet:
    return resolved(parse_fleet(lattice(f"lattice{robots}", robots, rate_hz=rate_hz), source="lattice"))


def run(options: Options) -> Result:
    result = Result()
    quick = options.quick
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        folder = Path(name)
        robots, rate_hz = carries()
        result.figures.append(
            Figure("robots of a lattice that this machine carries at 10 Hz, by the model", robots)
        )
        parts = [
            starts(folder, options.count or (STARTS_QUICK if quick else STARTS)),
            sizes(folder, SIZES_QUICK if quick else SIZES),
            at_the_limit(folder, 1 if quick else LIMIT_TRIES),
            with_a_few_more(folder),
            in_virtual_time(VIRTUAL_QUICK if quick else VIRTUAL, 3.0 if quick else 10.0),
            in_fleets(folder, FED_QUICK if quick else FED, 8.0 if quick else 20.0),
            hogged(folder),
            beyond(folder, BEYOND_ROBOTS, rate_hz),
        ]
        if not quick:
            parts.append(bundled(folder))
    curve, lines = router_curve.curve(ROUTED_QUICK if quick else ROUTED, 5.0 if quick else 10.0)
    for figures, details in parts:
        result.figures += figures
        result.details += [*details, ""]
    good = [each.robots for each in curve if each.lost + each.late < MISSED and each.slipped < 0.01]
    result.figures.append(
        Figure(
            "robots' traffic that a router carries at 10 Hz, less than 0.1 % lost or late",
            max(good, default=0),
            "robots",
            note=f"tried {', '.join(str(each.robots) for each in curve)}",
        )
    )
    result.details += lines
    return result
