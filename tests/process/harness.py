"""A fleet of real processes under a test's eyes, and how to wait for what they do.

Nothing here sleeps for luck: `wait_for` and its users wait for a condition, with a deadline that
only a fault reaches, and then say what the processes said last.
"""

from __future__ import annotations

import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

import numpy as np
import tomli_w

from agent import keys
from agent.bus import Bus, Presence
from agent.clock import NS_PER_S
from agent.fleet import Fleet, digest, load_fleet, to_dict
from agent.formation import resolved
from agent.messages import Malformed, Message, Mission, PlantState, Status, Wrench, decode, encode
from deploy.arguments import FLEETS
from deploy.ports import Reservation
from deploy.recording import Recording

ROOT: Final = Path(__file__).parents[2]
ADDRESS: Final = "127.0.0.1"
BASE_PORT: Final = 21_120
"""Tests look for ports from here on: clear of the bundled fleets' own."""
PATIENCE_S: Final = 15.0
"""How long a test waits for what has no bound of its own; only a fault takes so long."""
POLL_S: Final = 0.002
MISSION_PERIOD_S: Final = 0.2
TROUBLE: Final = ("Traceback", "Error:", "Exception", "panicked", "Warning:")
"""What no process of ours ever prints."""
T = TypeVar("T")


def wait_for(
    look: Callable[[], T], what: str, timeout_s: float = PATIENCE_S, report: Callable[[], str] | None = None
) -> T:
    """Calls `look` until it gives something true, and returns that; fails the test after `timeout_s`.

    Args:
        what: what is waited for, for the failure's text.
        report: more for that text, such as the last lines of the processes.
    """
    deadline = time.monotonic() + timeout_s
    while not (found := look()):
        if time.monotonic() > deadline:
            more = f"\n{report()}" if report is not None else ""
            raise AssertionError(f"{what}: not within {timeout_s:g} s{more}")
        time.sleep(POLL_S)
    return found


def measured(what: str, value: float) -> float:
    """Leaves a number in the test's output (``pytest -rP`` shows it); returns it."""
    print(f"measured {what}: {value:.3g}")
    return value


def environment() -> dict[str, str]:
    """For a process of this source tree, whichever is installed."""
    return os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1"}


def running(pid: int) -> bool:
    """Whether a process runs; a zombie, which only waits for its parent to ask, does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X")


def children(pid: int) -> dict[int, str]:
    """The processes that `pid` has started and that run: pid -> command line."""
    found = {}
    for listing in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            for child in map(int, listing.read_text().split()):
                command = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ").decode()
                if running(child):
                    found[child] = command
        except OSError:
            continue
    return found


def last_lines(path: Path, count: int = 8) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()[-count:]
    except OSError:
        return []


def no_trouble(text: str, source: str) -> None:
    """Fails the test when `text` holds a traceback or a warning."""
    for line in text.splitlines():
        assert not any(word in line for word in TROUBLE), f"{source} says:\n{text[-3000:]}"


def no_trouble_in_logs(folder: Path) -> None:
    logs = sorted((folder / "logs").glob("*.log"))
    assert logs, f"{folder} has no logs"
    for log in logs:
        no_trouble(log.read_text(errors="replace"), log.name)


def hands(folder: Path, grid: np.ndarray) -> np.ndarray:
    """Recorded hand points (k, n, 2) of the run in `folder` at the times `grid` (k,)."""
    recording = Recording.from_folder(folder)
    assert recording.data_end_s >= grid[-1] - 0.05, f"{folder} ends after {recording.data_end_s:.2f} s"
    return recording.hand_positions(grid)


def assert_same_way(one: np.ndarray, other: np.ndarray, grid: np.ndarray, limit_m: float) -> None:
    """Fails the test when two sets of hand points at the times `grid` (s) differ by `limit_m` or more."""
    assert one.shape == other.shape
    assert np.isfinite(one).all()
    assert np.isfinite(other).all()
    off = np.hypot(*np.moveaxis(one - other, -1, 0))
    most = measured("apart, m", float(off.max()))
    k, robot = np.unravel_index(int(off.argmax()), off.shape)
    above = grid[(off >= limit_m).any(axis=1)]
    assert most < limit_m, (
        f"{most:.3f} m apart at {grid[k]:.2f} s (the robot of index {robot}: {one[k, robot]} and "
        f"{other[k, robot]}); {limit_m} m or more at {len(above)} times, "
        f"{above[0]:.2f} s to {above[-1]:.2f} s"
    )


# ---------------------------------------------------------------------- the command


class Command:
    """`handfast ARGUMENTS` as a process; leaving it ends whatever is left. Its output is read by file.

    Args:
        folder: where its output goes, and its working directory.
        tty: open file descriptor of a terminal to give it instead, as its controlling terminal.
    """

    _TAKE_TERMINAL: Final = (
        "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
        "os.execv(sys.argv[1], sys.argv[1:])"
    )

    def __init__(self, folder: Path, *arguments: str, tty: int | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.arguments = arguments
        self.out_file, self.err_file = folder / "stdout", folder / "stderr"
        command = [sys.executable, "-P", "-m", "deploy.cli", *arguments]
        self.begun = time.monotonic()
        with open(self.out_file, "wb") as out, open(self.err_file, "wb") as err:
            if tty is None:
                streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": err}
            else:
                streams = {"stdin": tty, "stdout": tty, "stderr": tty}
                command = [sys.executable, "-c", self._TAKE_TERMINAL, *command]
            self.process = subprocess.Popen(
                command, cwd=folder, env=environment(), start_new_session=True, **streams
            )
        self.alive_s = float("nan")
        """How long after the command all were alive, when the test has looked."""
        self.seen: dict[int, str] = {}

    def __enter__(self) -> Command:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        left = self.children()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for pid in {*left, *self.seen}:
            if running(pid) and "--robot" in _command(pid):
                os.kill(pid, signal.SIGKILL)

    @property
    def out(self) -> str:
        return self.out_file.read_text(errors="replace")

    @property
    def err(self) -> str:
        return self.err_file.read_text(errors="replace")

    def children(self) -> dict[int, str]:
        """The processes of its robots that run now; remembered, to be ended in any case."""
        found = {pid: text for pid, text in children(self.process.pid).items() if "--robot" in text}
        self.seen |= found
        return found

    def child(self, robot: int, role: str) -> int:
        """pid of one robot's agent or plant."""
        wanted = f"-m {role} "
        for pid, text in self.children().items():
            if wanted in text and f"--robot {robot} " in f"{text} ":
                return pid
        raise AssertionError(f"no {role} of robot {robot} among {self.children()}")

    def told(self) -> str:
        return (
            f"handfast {' '.join(self.arguments)}: status {self.process.poll()}\n"
            f"--- stdout\n{self.out[-2000:]}\n--- stderr\n{self.err[-2000:]}"
        )

    def wait_for_line(self, pattern: str, timeout_s: float = PATIENCE_S) -> re.Match[str]:
        """Waits until standard error has `pattern`; fails when the command ends without."""

        def look() -> re.Match[str] | None:
            ended = self.process.poll() is not None
            found = re.search(pattern, self.err)
            assert found or not ended, f"ended without a line like {pattern!r}\n{self.told()}"
            return found

        found = wait_for(look, f"a line like {pattern!r}", timeout_s, self.told)
        assert found is not None
        return found

    def wait_until_driving(self) -> None:
        """Waits until the fleet has driven for 2 s: its robots are fast then."""
        self.wait_for_line(r"(?m)^ +2\.\d s .* all running(, faults: .*)?$")
        self.children()

    def wait_until_gone(self, pids: Sequence[int], timeout_s: float) -> float:
        """Waits until none of `pids` runs; returns how long that took, s."""
        begun = time.monotonic()
        wait_for(
            lambda: not any(map(running, pids)),
            f"{len(pids)} processes gone",
            timeout_s,
            lambda: "\n".join([f"{pid}: {_command(pid)}" for pid in pids if running(pid)] + [self.told()]),
        )
        return time.monotonic() - begun

    def wait(self, timeout_s: float = 60.0) -> int:
        """Waits for its end; returns its exit status. No traceback is allowed, nor a process left."""
        try:
            status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout_s:g} s\n{self.told()}") from None
        for source, text in (("stdout", self.out), ("stderr", self.err)):
            no_trouble(text, f"handfast {' '.join(self.arguments)} ({source})")
        left = [f"{pid}: {_command(pid)}" for pid in self.seen if running(pid)]
        assert not left, f"left running: {left}\n{self.told()}"
        return status


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


# ---------------------------------------------------------------------- a fleet without the command


def make_fleet(base: str = "pair", *overrides: str) -> Fleet:
    """A bundled fleet under a name of its own, resolved."""
    name = f"t-{secrets.token_hex(4)}"
    return resolved(load_fleet(FLEETS / f"{base}.toml", [f'fleet.name="{name}"', *overrides]))


@contextmanager
def placed(fleet: Fleet, address: str = ADDRESS) -> Iterator[Fleet]:
    """`fleet` on ports that no other test or run has, reserved while the context lasts."""
    ports = Reservation(ADDRESS, BASE_PORT, 2 * len(fleet.robots))
    try:
        yield replace(fleet, network=replace(fleet.network, address=address, base_port=ports.base))
    finally:
        ports.close()


@dataclass(frozen=True)
class Heard:
    """One message off the bus and when it came, wall-clock ns."""

    at_ns: int
    key: str
    message: Message


class Robots:
    """Agents and plants of a fleet as processes, and an operator that listens and gives the mission.

    Unlike `handfast run` it goes on when a process dies. A context manager: leaving ends everything.

    Args:
        fleet: resolved and placed.
        folder: for the fleet file and the logs.
    """

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        self.fleet, self.folder = fleet, folder
        self.name = fleet.fleet.name
        self.heard: list[Heard] = []
        self.latest: dict[str, Message] = {}
        self.processes: dict[tuple[int, str], subprocess.Popen[bytes]] = {}
        self._all: list[subprocess.Popen[bytes]] = []
        self.mission: Mission | None = None
        self._mission_due_s = 0.0
        self.fleet_file = folder / "fleet.toml"
        (folder / "logs").mkdir(parents=True)
        self.fleet_file.write_text(tomli_w.dumps(to_dict(fleet)))

    def __enter__(self) -> Robots:
        fleet = self.fleet
        endpoints = [
            endpoint
            for robot in fleet.ids
            for endpoint in (fleet.agent_endpoint(robot), fleet.plant_endpoint(robot))
        ]
        self.bus = Bus(listen=[], connect=endpoints)
        for key in (keys.mission(self.name), keys.stop(self.name)):
            self.bus.declare(key)
        self.bus.subscribe(keys.everything(self.name), 65_536)
        self.presence: Presence = self.bus.watch(keys.alive(self.name, "*", "*"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._all:
            if process.poll() is None:
                process.kill()  # a frozen one too
        for process in self._all:
            process.wait()
        self.bus.close()

    # ---------------------------------------------------------------- processes

    def log(self, robot: int, role: str) -> Path:
        return self.folder / "logs" / f"robot-{robot}-{role}.log"

    def start(self, robot: int, role: str) -> None:
        self.run(robot, role, role, "--fleet", str(self.fleet_file), "--robot", str(robot))

    def run(self, robot: int, role: str, module: str, *arguments: str) -> None:
        """Starts one process; its last words are in `log(robot, role)`."""
        with open(self.log(robot, role), "ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, *arguments, "--exit-with-parent"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment(),
                start_new_session=True,
            )
        self.processes[robot, role] = process
        self._all.append(process)

    def start_all(self) -> None:
        for robot in self.fleet.ids:
            for role in keys.ROLES:
                self.start(robot, role)

    def signal(self, robot: int, role: str, number: int) -> int:
        """Sends a signal to one process; returns when, wall-clock ns."""
        now_ns = time.time_ns()
        self.processes[robot, role].send_signal(number)
        return now_ns

    def end(self, robot: int, role: str) -> int:
        """Asks one process to end and waits for it; returns its exit status."""
        process = self.processes[robot, role]
        process.terminate()
        return process.wait(PATIENCE_S)

    def died(self) -> list[str]:
        return [
            f"robot {robot}'s {role} ended with {process.returncode}"
            for (robot, role), process in self.processes.items()
            if process.poll() is not None
        ]

    def told(self) -> str:
        """What the processes said last, and what the bus did."""
        out = self.died()
        for robot, role in self.processes:
            out.append(f"--- robot {robot} {role}")
            out += last_lines(self.log(robot, role))
        out.append("--- bus")
        out += [f"{key}: {message}"[:300] for key, message in sorted(self.latest.items())]
        return "\n".join(out)

    # ---------------------------------------------------------------- bus

    def collect(self) -> None:
        """Takes what came; says the mission again to agents that lack it."""
        now_ns = time.time_ns()
        for key, payload in self.bus.drain():
            try:
                message = decode(payload)
            except Malformed:
                continue
            self.heard.append(Heard(now_ns, key, message))
            self.latest[key] = message
        self.presence.update()
        if self.mission is not None and time.monotonic() >= self._mission_due_s:
            lacking = [
                robot
                for robot in self.fleet.ids
                if (status := self.status(robot)) is None or status.mission_version != self.mission.version
            ]
            if lacking:
                self._mission_due_s = time.monotonic() + MISSION_PERIOD_S
                self.bus.publish(keys.mission(self.name), encode(self.mission))

    def wait(self, look: Callable[[], T], what: str, timeout_s: float = PATIENCE_S) -> T:
        """`wait_for`, with the bus at work and the processes' last words on failure."""

        def collect_and_look() -> T:
            self.collect()
            return look()

        return wait_for(collect_and_look, what, timeout_s, self.told)

    def status(self, robot: int) -> Status | None:
        found = self.latest.get(keys.status(self.name, robot))
        return found if isinstance(found, Status) else None

    def plant(self, robot: int) -> PlantState | None:
        found = self.latest.get(keys.plant_state(self.name, robot))
        return found if isinstance(found, PlantState) else None

    def wrench(self, robot: int) -> Wrench | None:
        found = self.latest.get(keys.wrench(self.name, robot))
        return found if isinstance(found, Wrench) else None

    def counters(self, robot: int) -> dict[str, int]:
        status = self.status(robot)
        return dict(status.counters) if status is not None else {}

    def states(self) -> dict[int, str]:
        """State of every robot whose agent has spoken."""
        return {
            robot: status.state
            for robot in self.fleet.ids
            if (status := self.status(robot)) is not None
        }  # fmt: skip

    def alive(self, robot: int, role: str) -> bool:
        return keys.alive(self.name, robot, role) in self.presence.alive

    def wait_until_alive(self, robot: int, role: str, timeout_s: float = PATIENCE_S) -> None:
        self.wait(lambda: self.alive(robot, role), f"robot {robot}'s {role} alive", timeout_s)

    def wait_until_all(self, state: str, timeout_s: float = PATIENCE_S) -> None:
        self.wait(
            lambda: self.states() == dict.fromkeys(self.fleet.ids, state), f"every robot {state}", timeout_s
        )

    def since(self, from_ns: int, kind: type[Any], robot: int) -> Iterator[tuple[int, Any]]:
        """Messages of one class by one robot that were made after `from_ns`: (came at, message)."""
        for each in self.heard:
            if (
                type(each.message) is kind
                and each.message[0] == robot
                and each.message.time_ns > from_ns
                and each.at_ns > from_ns
            ):
                yield each.at_ns, each.message

    def first(
        self,
        from_ns: int,
        kind: type[Any],
        robot: int,
        which: Callable[[Any], bool],
        what: str,
        timeout_s: float = PATIENCE_S,
    ) -> tuple[float, Any]:
        """Waits for a message after `from_ns` that fits; returns how long after it came (s), and it."""

        def look() -> tuple[int, Any] | None:
            found = ((at, message) for at, message in self.since(from_ns, kind, robot) if which(message))
            return next(found, None)

        found = self.wait(look, what, timeout_s)
        assert found is not None
        return (found[0] - from_ns) / NS_PER_S, found[1]

    def drive(self, duration_s: float = 600.0, ahead_s: float = 0.3) -> int:
        """Gives the mission to a fleet that is ready, waits until it drives; returns its epoch, ns."""
        self.wait_until_all("ready")
        now_ns = time.time_ns()
        period_ns = self.fleet.period_ns
        epoch_ns = (now_ns + round(ahead_s * NS_PER_S)) // period_ns * period_ns
        version = epoch_ns // 1_000_000
        self.mission = Mission(version, now_ns, epoch_ns, round(duration_s * NS_PER_S), digest(self.fleet))
        self.bus.publish(keys.mission(self.name), encode(self.mission))
        self._mission_due_s = time.monotonic() + MISSION_PERIOD_S
        self.wait_until_all("running")
        return epoch_ns


@contextmanager
def robots(folder: Path, base: str = "pair", *overrides: str) -> Iterator[Robots]:
    """Every process of a bundled fleet, ready for a mission."""
    with placed(make_fleet(base, *overrides)) as fleet, Robots(fleet, folder) as all_robots:
        all_robots.start_all()
        all_robots.wait_until_all("ready")
        yield all_robots
