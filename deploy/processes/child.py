"""Processes of a fleet: what a drive needs of them, whoever started them, and those that this process
starts, watches and ends itself."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol

from handfast.agent.control.hand import Pose
from handfast.deploy.faults.process_actions import Action, Process
from handfast.deploy.processes.attributes import words_of
from handfast.deploy.processes.forking import UNSEEN, ForkServer

LAST_LINES: Final = 5
LINE_MAX: Final = 300
END_TIMES: Final = 5.0
"""Where processes end one after the other, so many times as long as for the next one is waited in all."""
END_LOOK_S: Final = 0.1

ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of a process with one thread for its linear algebra: matrices are tiny, threads are not."""


def environment() -> dict[str, str]:
    """Of every process: that of this one, with one thread for linear algebra."""
    return os.environ | ONE_THREAD


def name_of(robot: int, role: str) -> str:
    """How one of a robot's processes is called."""
    return f"robot {robot}'s {role}"


class Child:
    """One process of one robot, a process group of its own so that a Ctrl-C reaches only its starter.

    Args:
        robot: the robot's id.
        role: ``agent``, ``plant``, ``vehicle`` or ``router``.
        module: what ``python -m`` runs.
        arguments: of its command line.
        log: where its output goes, after what is there.
        server: has it forked, where that can be had.
        name: how it is called, unless it is one of the robot's.
        for_many: many robots wait for it, not one.
    """

    def __init__(
        self,
        robot: int,
        role: str,
        module: str,
        arguments: Sequence[str],
        log: Path,
        server: ForkServer | None = None,
        name: str = "",
        *,
        for_many: bool = False,
    ) -> None:
        self.robot, self.role, self.log = robot, role, log
        self.name = name or name_of(robot, role)
        ends_with = "--exit-with-parent"
        with open(log, "ab") as output:
            forked = None
            if server is not None:
                forked = server.start(module, [*arguments, ends_with], output.fileno(), for_many=for_many)
            # Which may be gone before the other has come as far as to look who it is.
            self._process = forked or subprocess.Popen(
                words_of(module, [*arguments, f"{ends_with}={os.getpid()}"]),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment(),
                process_group=0,
            )
        self._guard: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        return self._process.pid

    def ended(self) -> str | None:
        """How the process ended, in words; None while it runs."""
        status = self._process.poll()
        if status is None:
            return None
        if status == UNSEEN:
            return "by the end of the fork server"
        if status < 0:
            return f"killed by {signal.Signals(-status).name}"
        return f"exit status {status}"

    def last_lines(self) -> list[str]:
        """The end of its output."""
        try:
            text = self.log.read_bytes()[-4096:].decode(errors="replace")
        except OSError:
            return []
        return [line[:LINE_MAX] for line in text.splitlines() if line.strip()][-LAST_LINES:]

    def pause(self) -> None:
        """Freezes it; `resume` lets it go on, and so does the end of this process, however it ends."""
        if self._process.poll() is not None or self._guard is not None:
            return
        # A frozen process cannot see that its parent is gone: a guard waits for the end of a pipe.
        self._guard = subprocess.Popen(
            ["/bin/sh", "-c", 'read -r _; kill -CONT "$0"', str(self.pid)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Lets it go on after `pause`; does nothing to one that others have frozen."""
        if self._guard is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
        self._dismiss_guard()

    def _dismiss_guard(self) -> None:
        if self._guard is not None:
            self._guard.kill()
            self._guard.communicate()
            self._guard = None

    def terminate(self) -> None:
        """Asks it to brake and end."""
        if self._process.poll() is None:
            self._process.terminate()
        self.resume()

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._dismiss_guard()

    def wait(self, timeout_s: float) -> bool:
        """Waits for its end; False when it still runs after `timeout_s`."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True


def end_all(children: Iterable[Child], timeout_s: float) -> list[Child]:
    """Ends every child: SIGTERM to all, and SIGKILL to those that are left when for `timeout_s` none has
    ended. Where many end on a machine that has little time for them they do so one after the other; what is
    frozen is not waited for longer than `END_TIMES` as long. Returns those that needed it."""
    left = list(children)
    for child in left:
        child.terminate()
    began_s = ended_s = time.monotonic()
    while left:
        now_s = time.monotonic()
        until_s = min(ended_s + timeout_s, began_s + END_TIMES * timeout_s)
        ended = {child for child in left if child.wait(0.0)}
        if ended:
            ended_s = now_s
            left = [child for child in left if child not in ended]
        elif now_s >= until_s:
            break
        else:
            left[0].wait(min(END_LOOK_S, until_s - now_s))
    for child in left:
        child.kill()
    for child in left:
        child.wait(10.0)
    return left


class Ended(Protocol):
    """A process that has ended of its own."""

    name: str

    def last_lines(self) -> list[str]:
        """The end of its output."""
        ...


class FleetProcesses(Protocol):
    """The processes of a fleet, as who drives it sees them.

    Attributes:
        names: all agents and plants, and how each is called.
        count: of how many processes they are.
        ours: whether they end with the drive: then one that dies ends it, and it ends with a stop in any
            case. Others' are left as they were found when no mission was given.
        begun_s: since when they are started, or waited for (monotonic clock, s).
    """

    @property
    def names(self) -> Mapping[Process, str]: ...

    @property
    def count(self) -> int: ...

    @property
    def ours(self) -> bool: ...

    @property
    def begun_s(self) -> float: ...

    def up(self, robot: int, role: str) -> bool:
        """Whether a process should run."""
        ...

    def look(self, present: Collection[Process], time_s: float | None) -> list[str]:
        """Takes which processes have liveliness tokens, and the fleet time (s; None before the epoch is set);
        gives sentences about processes that came or went."""
        ...

    def deaths(self) -> Sequence[tuple[Ended, str]]:
        """Processes that have ended since the last call without a rule's order, and how."""
        ...

    def lacking(self, members: Collection[int]) -> list[str]:
        """Sentences for the verdict on a drive that ends now: who is not there of those that have a place."""
        ...

    def carry_out(self, action: Action, pose: Pose | None) -> bool:
        """Does what a rule orders; False when nothing was done. `pose`: where the robot's body was seen."""
        ...

    def resume_all(self) -> None:
        """Lets the processes go on that rules have paused."""
        ...
