"""What befalls a fleet on hosts in mid-drive, and how soon it is well again by what its robots recorded.

Robots drive by themselves (`handfast drive --detach`), so that nobody's listening is part of a time. All
moments are by the one clock that test hosts share. A robot is back when its own status says so.
"""

from __future__ import annotations

import os
import select
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.control.peers.lateness import UNSURE_NS
from agent.supervision.state_machine import State
from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from tests.benchmarks.processes import BenchmarkError
from tests.hosts.fleet_on_hosts import FleetOnHosts

SETTLE_S: Final = 4.0
RETURN_S: Final = 10.0
"""A fault has the drive for itself for so long."""
CUT_S: Final = 5.0
ROUTER_AWAY_S: Final = 3.0
_ROUTER_START_S: Final = 30.0
_AGAIN_S: Final = 30.0
_POLL_S: Final = 0.05


class Struck(NamedTuple):
    """An agent that got a signal at `at_ns`; s until its process had ended, and until there was another."""

    robot: int
    at_ns: int
    gone_s: float
    born_s: float


def strike(fleet: FleetOnHosts, robot: int, how: signal.Signals) -> Struck:
    """Sends an agent a signal that its process does not survive, if only by its watchdog."""
    pid = fleet.process(robot, "agent")
    handle = os.pidfd_open(pid)
    try:
        at_ns = time.time_ns()
        os.kill(pid, how)
        if not select.select([handle], [], [], _AGAIN_S)[0]:
            raise BenchmarkError(f"robot {robot}'s agent lives {_AGAIN_S:.0f} s after {how.name}")
        gone_ns = time.time_ns()
    finally:
        os.close(handle)
    deadline = time.monotonic() + _AGAIN_S
    while not (new := agents(fleet, robot) - {pid}):
        if time.monotonic() > deadline:
            raise BenchmarkError(f"robot {robot}'s agent is not started again within {_AGAIN_S:.0f} s")
        time.sleep(_POLL_S)  # the kernel knows when it started: looking seldom leaves the machine to it
    born_ns = min(map(_born_ns, new))
    _rest(at_ns)
    return Struck(robot, at_ns, (gone_ns - at_ns) / NS_PER_S, max(0.0, born_ns - at_ns) / NS_PER_S)


def agents(fleet: FleetOnHosts, robot: int) -> set[int]:
    """The processes of a robot's agent."""
    found = fleet.host_of(robot).pids("-m agent ")
    return {pid for pid, words in found.items() if f"--robot {robot} " in f"{words} "}


def cut_off(fleet: FleetOnHosts, host: int, more_s: float) -> int:
    """Cuts a host off for `CUT_S` and `more_s`; gives the moment (ns) of its return."""
    fleet.hosts[host].cut()
    time.sleep(CUT_S + more_s)
    at_ns = time.time_ns()
    fleet.hosts[host].restore()
    _rest(at_ns)
    return at_ns


@contextmanager
def router(fleet: FleetOnHosts) -> Iterator[int]:
    """`handfast router` on the operator's computer, killed at the end; gives the moment (ns) at which it said
    that it listens."""
    with tempfile.TemporaryFile() as told:
        process = fleet.hosts.operator.popen(
            fleet.words("router"), env=fleet.environment(), cwd=fleet.folder, stdout=told, stderr=told
        )
        try:
            deadline = time.monotonic() + _ROUTER_START_S
            while "router of" not in (text := _from_start(told.fileno())):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise BenchmarkError(f"the router does not start: {text}")
                time.sleep(0.002)
            yield time.time_ns()
        finally:
            process.kill()
            process.wait()


def _from_start(descriptor: int) -> str:
    """What a file holds; where its writer goes on is left as it is."""
    return os.pread(descriptor, 65_536, 0).decode(errors="replace")


def drive_alone(fleet: FleetOnHosts, seconds: float) -> None:
    """Robots drive by themselves for so long, or to a stop; they have settled when this returns."""
    fleet.handfast("drive", "--detach", "--resume", "--quiet", "--duration", f"{seconds:g}s")
    time.sleep(SETTLE_S)


def fetched(fleet: FleetOnHosts, folder: Path) -> tuple[Recording, float]:
    """What robots recorded of the last drive, and how long it took to fetch, s."""
    begun = time.monotonic()
    fleet.handfast("fetch", "--out", str(folder), "--no-report", status=None)
    took_s = time.monotonic() - begun
    return read_run(folder), took_s


def runs_again_s(recording: Recording, robot: int, at_ns: int) -> float | None:
    """From `at_ns` until a robot's status says that it runs, s; None when it never does."""
    status = recording.robots[robot].status
    since = recording.fleet_time_s(at_ns)
    rows = zip(status.t.tolist(), status.states, strict=True)
    return next((t - since for t, state in rows if t > since and state == State.RUNNING.value), None)


def all_well_again_s(recording: Recording, at_ns: int) -> float | None:
    """From `at_ns` until the last robot runs and hears all its neighbours, s; None when one never does."""
    found = [_well_again_s(recording, robot, at_ns) for robot in recording.ids]
    took = [each for each in found if each is not None]
    return max(took) if len(took) == len(found) else None


def _well_again_s(recording: Recording, robot: int, at_ns: int) -> float | None:
    """By its statuses, which come five times a second and at every change of its state."""
    status = recording.robots[robot].status
    since = recording.fleet_time_s(at_ns)
    row = 0
    for t, state, count in zip(
        status.t.tolist(), status.states, status.neighbour_counts.tolist(), strict=True
    ):
        ages_us = status.neighbours["age_us"][row : row + count]
        row += count
        heard = bool(count and ((ages_us >= 0) & (ages_us < UNSURE_NS // 1000)).all())
        if t > since and state == State.RUNNING.value and heard:
            return float(t - since)
    return None


def _rest(since_ns: int) -> None:
    """Leaves the fleet alone until a fault's time is over."""
    time.sleep(max(0.0, RETURN_S - (time.time_ns() - since_ns) / NS_PER_S))


def _born_ns(pid: int) -> int:
    """When a process was started, wall clock, to a hundredth of a second."""
    ticks = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    booted_ns = time.time_ns() - time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return booted_ns + ticks * NS_PER_S // os.sysconf("SC_CLK_TCK")
