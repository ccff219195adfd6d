"""Namespaces of Linux for the test hosts: how one is begun, entered and surely removed.

A **space** is a set of namespaces without a name, held by its first process alone. That process
waits on a pipe, the lifeline, whose other end only the test run holds: when the run ends, however it
ends, the process ends, and the kernel takes away the namespaces, their mounts and network devices. What the
kernel does not take away are folders, control groups, and processes outside a pid namespace: they
carry the name of their set (`run_name`), and `sweep` removes those of runs that are no more.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

PREFIX: Final = "handfast-hosts"
MARK: Final = "HANDFAST_TEST_HOSTS"
"""In the environment of every process of a set: the set's name."""
START_S: Final = 60.0
STOP_S: Final = 20.0
_DISABLED, _FORWARDING = 0, 3  # states of a bridge's port
_NSENTER: Final = shutil.which("nsenter", path=f"{os.defpath}:/usr/sbin:/sbin") or "nsenter"
_serial = 0


class HostsFailed(Exception):
    """Test hosts could not be made, or not be removed; the text says why."""


def run_name() -> str:
    """A name for one set of hosts that no other has: it tells the process that owns the set."""
    global _serial
    _serial += 1
    return f"{PREFIX}-{os.getpid()}-{_started(os.getpid())}-{_serial}"


def sweep() -> None:
    """Removes what runs that were killed have left. Touches nothing of a run that still lives."""
    left = {entry.name for entry in Path(tempfile.gettempdir()).glob(f"{PREFIX}-*") if _orphaned(entry.name)}
    with control_groups() as groups:
        left |= {entry.name for entry in groups.glob(f"{PREFIX}-*") if _orphaned(entry.name)}
    for name in left:
        remove_rest(name)


def remove_rest(name: str) -> None:
    """Kills what processes of the set are left, and removes its folder and control groups.

    Raises:
        HostsFailed: when something of it stays.
    """
    deadline = time.monotonic() + STOP_S
    while marked := _marked(name):
        for pid in marked:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        _wait_a_moment(deadline, f"processes of {name} do not end: {marked}")
    with control_groups() as groups:
        for top in groups.glob(f"{name}*"):
            remove_group(top, deadline)
    shutil.rmtree(Path(tempfile.gettempdir()) / name, ignore_errors=True)


def remove_group(top: Path, deadline: float) -> None:
    """Removes a control group and those below it; their processes must have ended."""
    while top.exists():
        for group, _, _ in os.walk(top, topdown=False):
            with contextlib.suppress(OSError):  # busy until the kernel has buried the last process
                os.rmdir(group)
        if top.exists():
            _wait_a_moment(deadline, f"control group {top} does not go")


@contextlib.contextmanager
def control_groups() -> Iterator[Path]:
    """The root of the control groups, version 2, wherever this machine has it, or mounted for the moment."""
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2" and "rw" in options.split(","):
            yield Path(place)
            return
    with tempfile.TemporaryDirectory() as place:
        subprocess.run(["mount", "-t", "cgroup2", "none", place], check=True)
        try:
            yield Path(place)
        finally:
            subprocess.run(["umount", place], check=True)


class Space:
    """The namespaces that one script was started in, and the script's process.

    Args:
        unshare: options of unshare(1) that say which namespaces are new.
        script: text for bash: the first process. It may write lines to descriptor $STATUS: `ready` when it
            is, `inside` before that when others may enter; and must end when $LIFELINE can be read.
        environment: everything its environment has.
        console: the file that takes what its processes print.
        within: a space whose mounts it starts from.
    """

    def __init__(
        self,
        unshare: Sequence[str],
        script: str,
        environment: Mapping[str, str],
        console: Path,
        within: Space | None = None,
    ) -> None:
        self._console = console
        self._forks = "--fork" in unshare
        self._said = b""
        lifeline, self._lifeline = os.pipe()
        self._status, status = os.pipe()
        enter = [] if within is None else [*within.command("mount")]
        given = {**environment, "LIFELINE": str(lifeline), "STATUS": str(status), "SCRIPT": script}
        try:
            with console.open("a") as output:
                # Orphaned at once: it belongs to the set of hosts, not to the test that happens to start it.
                subprocess.run(
                    [
                        *("setsid", "--fork", *enter, "bash", "-c"),
                        'echo $$ >&"$STATUS"; exec unshare "$@" bash -c \'eval "$SCRIPT"\' "$0"',
                        *(environment[MARK], *unshare),
                    ],
                    check=True,
                    cwd="/",
                    env=given,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    pass_fds=(lifeline, status),
                )
        finally:
            os.close(lifeline)
            os.close(status)
        try:
            self.pid = int(self._line(time.monotonic() + START_S))
            self._pidfd = os.pidfd_open(self.pid)
        except (ValueError, OSError):
            os.close(self._lifeline)
            os.close(self._status)
            raise self._failed("it ended") from None

    def wait_inside(self) -> None:
        """Until the namespaces are there and can be entered; `pid` is then their first process."""
        self._expect("inside")
        if self._forks:
            children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text().split()
            self.pid = int(children[0])
            os.close(self._pidfd)
            self._pidfd = os.pidfd_open(self.pid)

    def wait_ready(self) -> None:
        """Until the script says that all of it runs."""
        self._expect("ready")

    def command(self, *kinds: str) -> list[str]:
        """What to put before a command so that it runs in these namespaces (net, mount, ...)."""
        return [_NSENTER, f"--target={self.pid}", *(f"--{kind}" for kind in kinds), "--"]

    def links(self, lines: str) -> None:
        """Gives ip(8) commands, one a line, in this network namespace."""
        self._batch("ip", lines)

    def forward(self, port: str, *, through: bool) -> None:
        """Whether the bridge lets anything through a port of it; who is behind it is not told."""
        self._batch("bridge", f"link set dev {port} state {_FORWARDING if through else _DISABLED}")

    def _batch(self, program: str, lines: str) -> None:
        done = subprocess.run(
            [*self.command("net"), program, "-batch", "-"], input=lines, text=True, capture_output=True
        )
        if done.returncode != 0:
            raise HostsFailed(f"{program}: {done.stderr.strip()} in\n{lines}")

    def pids(self, kind: str) -> set[int]:
        """Processes in its namespace of a kind, such as ``pid`` or ``net``."""
        wanted = _namespace(self.pid, kind)
        return {pid for pid in _all_pids() if wanted and _namespace(pid, kind) == wanted}

    def end(self) -> None:
        """Kills its first process, and with that all in its pid namespace, and waits for that."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        if not select.select([self._pidfd], [], [], STOP_S)[0]:
            raise HostsFailed(f"process {self.pid} does not end")
        for descriptor in (self._pidfd, self._lifeline, self._status):
            os.close(descriptor)

    def _expect(self, word: str) -> None:
        deadline = time.monotonic() + START_S
        if (line := self._line(deadline)) != word:
            raise self._failed(line or "it ended")

    def _failed(self, why: str) -> HostsFailed:
        told = self._console.read_text(errors="replace")[-4000:]
        return HostsFailed(f"a test host did not start ({why}):\n{told}")

    def _line(self, deadline: float) -> str:
        while b"\n" not in self._said:
            if not select.select([self._status], [], [], max(0.0, deadline - time.monotonic()))[0]:
                return "no answer in time"
            more = os.read(self._status, 4096)
            if not more:
                return ""
            self._said += more
        line, _, self._said = self._said.partition(b"\n")
        return line.decode()


def _orphaned(name: str) -> bool:
    """Whether the process that the name tells has ended."""
    parts = re.match(rf"{PREFIX}-(\d+)-(\d+)-", name)
    return parts is not None and _started(int(parts[1])) != int(parts[2])


def _started(pid: int) -> int | None:
    """When the process started, in clock ticks since boot: tells it from a later one of the same number."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except OSError:
        return None


def _marked(name: str) -> set[int]:
    wanted = f"{MARK}={name}".encode()
    found = set()
    for pid in _all_pids():
        with contextlib.suppress(OSError):
            if wanted in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                found.add(pid)
    return found


def _all_pids() -> list[int]:
    return [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]


def _namespace(pid: int, kind: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/ns/{kind}")
    except OSError:
        return ""


def _wait_a_moment(deadline: float, failure: str) -> None:
    if time.monotonic() > deadline:
        raise HostsFailed(failure)
    time.sleep(0.01)
