"""Processes under measurement: start them, follow them on the bus, read their cost, end every one by pid."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import tomli_w

from handfast.agent.common.compiled import COMPILED
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import next_tick_ns
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, PlantState, Status
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.loop import RealClock
from handfast.agent.supervision.state_machine import State
from handfast.deploy.processes.child import ONE_THREAD
from handfast.deploy.processes.placement import place
from handfast.deploy.session.operator_bus import operator_bus

ROOT: Final = Path(__file__).resolve().parents[2]
ROLES: Final = ("agent", "plant")
POLL_S: Final = 0.04
"""How often the observer empties its inbox, as `handfast run` does."""
READY_TIMEOUT_S: Final = 30.0
END_TIMEOUT_S: Final = 3.0
DRIVE_S: Final = 3600.0
_CPU_OF_PROCESS: Final = 2
"""Low bits of the number of a clock that counts the CPU of a whole process, whose id, inverted, is in the
others: what clock_getcpuclockid(3) makes."""


class BenchmarkError(RuntimeError):
    """A benchmark could not run."""


class NotHereError(BenchmarkError):
    """This machine lacks what a benchmark needs; the text says what."""


def environment(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """Of a child: it finds this checkout's packages wherever it starts, or as this process those that are
    compiled (`forms`). An empty value unsets a variable."""
    path = os.pathsep.join(filter(None, ("" if COMPILED else str(ROOT), os.environ.get("PYTHONPATH"))))
    whole = os.environ | ONE_THREAD | {"PYTHONPATH": path} | dict(extra or {})
    return {name: value for name, value in whole.items() if value}


def handfast(*arguments: str) -> list[str]:
    """The command line of ``handfast`` from this checkout."""
    return [sys.executable, "-P", "-m", "handfast.deploy.cli", *arguments]


def finish(words: Sequence[str], timeout_s: float) -> None:
    """Runs `handfast run` to its end, whatever its verdict.

    Raises:
        BenchmarkError: it did not end in time, or could not run.
    """
    process = subprocess.Popen(
        words,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        _, errors = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise BenchmarkError("handfast run did not end") from None
    finally:
        end(process)
    if process.returncode not in (0, 1):
        raise BenchmarkError(f"handfast run: {errors.decode(errors='replace')[-500:]}")


def descendants(pid: int) -> list[int]:
    """Pids of the processes that it has started, and that those have."""
    found: list[int] = []
    parents = [pid]
    while parents:
        for listing in Path(f"/proc/{parents.pop()}/task").glob("*/children"):
            try:
                children = [*map(int, listing.read_text().split())]
            except OSError:
                continue
            parents += children
            found += children
    return found


def state_of(pid: int) -> str:
    """The kernel's letter for the state of a process, "" when it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def cpu_s(pid: int) -> float:
    """CPU (user and system) that a process has used, s, exact to a nanosecond: also that of threads that are
    gone, as Zenoh's go when a peer does."""
    return time.clock_gettime_ns(~pid << 3 | _CPU_OF_PROCESS) / NS_PER_S


def pss_mb(pid: int) -> float:
    """Proportional memory of a process, MB: shared pages count by share."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024.0
    raise BenchmarkError(f"no Pss of process {pid}")


class Group:
    """A set of processes; leaving it ends every one, by its pid. A context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._members: dict[tuple[int, str], subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self, robot: int, role: str, command: Sequence[str], extra: Mapping[str, str]) -> None:
        with open(self.folder / f"{robot}-{role}.log", "wb") as log:
            self._members[robot, role] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment(extra),
                start_new_session=True,
            )

    def pids(self, role: str) -> list[int]:
        return [process.pid for (_, its), process in self._members.items() if its == role]

    def check(self) -> None:
        """Raises `BenchmarkError` when a process has ended."""
        for (robot, role), process in self._members.items():
            if process.poll() is not None:
                log = (self.folder / f"{robot}-{role}.log").read_text(errors="replace")
                raise BenchmarkError(f"robot {robot}'s {role} ended ({process.returncode}): {log[-500:]}")

    def close(self) -> None:
        for process in self._members.values():
            if process.poll() is None:
                process.terminate()
        deadline = time.monotonic() + END_TIMEOUT_S
        for process in self._members.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._members.clear()


@dataclass
class Traffic:
    """What an observer saw in one window."""

    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    sizes: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    tick_us: list[int] = field(default_factory=list)
    plants_missed: int = 0
    agents_missed: int = 0


@dataclass(frozen=True)
class Cost:
    """CPU over one window and memory after it. Shares of a core per process; MB per process."""

    cpu: Mapping[str, float]
    pss: Mapping[str, float]
    traffic: Traffic
    load: float

    @property
    def robot(self) -> float:
        """Share of a core for one robot, agent and plant."""
        return sum(self.cpu.values())


class Observer:
    """The operator's side, the same for every arm: links to every process, listens to everything."""

    def __init__(self, fleet: Fleet, group: Group) -> None:
        self._fleet, self._group = fleet, group
        self._clock = RealClock()
        self._states: dict[int, str] = {}
        self._missed: dict[int, int] = {}
        self._plants: dict[int, int] = {}
        name = fleet.fleet.name
        self._bus = operator_bus(fleet)
        self._bus.declare(key_expressions.mission(name))
        self._bus.subscribe(key_expressions.everything(name), 65_536)
        self._presence = self._bus.watch(key_expressions.alive(name, "*", "*"))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bus.close()

    def _until(self, done: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not done():
            if time.monotonic() > deadline:
                raise BenchmarkError(f"not {what} within {READY_TIMEOUT_S:.0f} s")
            self._group.check()
            time.sleep(POLL_S)
            self._collect(Traffic())

    def wait_alive(self) -> None:
        expected = {
            key_expressions.alive(self._fleet.fleet.name, robot, role)
            for robot in self._fleet.ids
            for role in ROLES
        }

        def alive() -> bool:
            self._presence.update()
            return expected <= self._presence.alive

        self._until(alive, "alive")

    def drive(self) -> None:
        """Sends a mission that outlasts every window; returns when every agent runs."""

        def all_are(state: State) -> bool:
            return all(self._states.get(robot) == state.value for robot in self._fleet.ids)

        self._until(lambda: all_are(State.READY), "ready")
        now_ns = self._clock.now_ns()
        epoch_ns = next_tick_ns(now_ns + NS_PER_S // 2, self._fleet.period_ns, 0)
        mission = Mission(1, now_ns, epoch_ns, round(DRIVE_S * NS_PER_S), digest(self._fleet))
        self._bus.publish(key_expressions.mission(self._fleet.fleet.name), encode(mission))
        self._until(lambda: all_are(State.RUNNING), "running")

    def watch(self, seconds: float) -> Traffic:
        """Listens for a while, decoding only what says something of missed ticks."""
        traffic = Traffic()
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            time.sleep(min(POLL_S, remaining))
            self._collect(traffic)
        self._group.check()
        return traffic

    def _collect(self, traffic: Traffic) -> None:
        for key, payload in self._bus.drain():
            traffic.counts[key] += 1
            traffic.sizes[key] += len(payload)
            if not key.endswith(("/status", "/plant/state")):
                continue
            try:
                message = decode(payload)
            except Malformed:  # a bare program's
                continue
            if type(message) is Status:
                self._status(message, traffic)
            elif type(message) is PlantState:
                self._plant(message, traffic)

    def _status(self, status: Status, traffic: Traffic) -> None:
        self._states[status.robot] = status.state
        traffic.tick_us.extend(status.tick_us)
        missed = dict(status.counters).get("overruns", 0)
        traffic.agents_missed += missed - self._missed.get(status.robot, missed)
        self._missed[status.robot] = missed

    def _plant(self, state: PlantState, traffic: Traffic) -> None:
        # By gaps in time. Numbers do not tell: they count rounds once the mission is known, skipped or not.
        since_ns = state.time_ns - self._plants.get(state.robot, state.time_ns)
        traffic.plants_missed += max(0, round(since_ns / self._fleet.period_ns) - 1)
        self._plants[state.robot] = state.time_ns


Starter = Callable[[Group, Fleet, Path], None]


def start_routers(group: Group, fleet: Fleet, fleet_file: Path) -> None:
    """The routers of a fleet that is placed; none for a mesh."""
    for number, router in enumerate(fleet.network.routers, 1):
        command = [sys.executable, "-P", "-m", "handfast.agent.runtime.router", "--fleet", str(fleet_file)]
        group.start(number, "router", [*command, "--number", str(number), "--exit-with-parent"], {})
        host, _, port = router.rpartition(":")
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not _listens(host, int(port)):
            group.check()
            if time.monotonic() > deadline:
                raise BenchmarkError(f"router {number} does not listen")
            time.sleep(POLL_S)


def _listens(host: str, port: int) -> bool:
    with socket.socket() as found:
        return found.connect_ex((host, port)) == 0


def start_handfast(
    group: Group, fleet: Fleet, fleet_file: Path, extra: Mapping[str, str] | None = None
) -> None:
    """The product's own processes, as `handfast run` starts them."""
    for robot in fleet.ids:
        for role in ROLES:
            command = [sys.executable, "-P", "-m", f"handfast.{role}", "--fleet", str(fleet_file)]
            command += ["--robot", str(robot), "--exit-with-parent"]
            group.start(robot, role, command, extra or {})


def measure(
    fleet: Fleet,
    folder: Path,
    start: Starter,
    *,
    drive: bool,
    settle_s: float,
    window_s: float,
) -> Cost:
    """Starts all processes of `fleet` on free ports, measures one window after they settled, ends them.

    Args:
        fleet: resolved.
        folder: empty, for logs and the fleet file.
        start: starts the processes.
        drive: send a mission and wait until it is driven, as real agents do.
    """
    folder.mkdir(parents=True)
    fleet, ports, _ = place(fleet)
    try:
        fleet_file = folder / "fleet.toml"
        fleet_file.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
        with Group(folder) as group:
            start_routers(group, fleet, fleet_file)
            start(group, fleet, fleet_file)
            with Observer(fleet, group) as observer:
                observer.wait_alive()
                if drive:
                    observer.drive()
                observer.watch(settle_s)
                before, begun = _cpu(group), time.monotonic()
                traffic = observer.watch(window_s)
                after, took = _cpu(group), time.monotonic() - begun
                load = os.getloadavg()[0]
                memory = {role: mean(map(pss_mb, group.pids(role))) for role in ROLES}
        robots = len(fleet.robots)
        cpu = {role: (after[role] - before[role]) / took / robots for role in ROLES}
        return Cost(cpu, memory, traffic, load)
    finally:
        ports.close()


def _cpu(group: Group) -> dict[str, float]:
    return {role: sum(map(cpu_s, group.pids(role))) for role in ROLES}


def mean(values: Iterable[float]) -> float:
    values = list(values)
    return sum(values) / len(values)


def end(process: subprocess.Popen[bytes], timeout_s: float = END_TIMEOUT_S) -> None:
    """Ends one process in order, or kills it."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()
