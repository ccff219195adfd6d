"""Starts processes by forking them from one that has loaded what they need.

An interpreter that starts and imports everything takes half a second of processor time for each process, and
memory of its own. Processes here are forked by the standard library's fork server
(`multiprocessing.forkserver`), which has imported `deploy.processes.preloading`. It imports nothing of the
program that starts them.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import io
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from errno import ETIMEDOUT
from functools import partial
from importlib import import_module, invalidate_caches
from multiprocessing import forkserver, process, reduction, resource_tracker
from pathlib import Path
from typing import Any, Final

from handfast.agent.common.closing import Closing
from handfast.agent.fleet.plants import KINDS
from handfast.agent.runtime import preloaded
from handfast.deploy.processes import attributes
from handfast.deploy.processes.attributes import ROOM, words_of

MODULES: Final = {"handfast.agent"} | {
    module for kind in KINDS.values() for module in (kind.program, kind.simulator) if module
}
"""Programs that can be forked: each has a `main(argv)` in its `__main__`."""
PRELOADING: Final = "handfast.deploy.processes.preloading"
PRELOAD: Final = "HANDFAST_PRELOAD"
"""Environment variable of the server: the process with which it ends, a space, the fleet file to read."""
UNSEEN: Final = 1 << 16
"""Exit status of a process whose end nobody saw, as the server ended before it or is stuck."""
STARTING_MAX: Final = 2 + (os.cpu_count() or 1)
"""Maximum number of processes that are starting: more would slow each other down, and robots connect to those
before them in the file, which should be there by then."""
START_S: Final = 0.3
"""Time after which a process that is starting is no longer waited for, s."""
ANSWER_S: Final = 20.0
"""Time after which a server that has not answered is stuck, s: forking takes milliseconds, loading tenths of
a second, and tenfold where hundreds of processes start."""
UNTOLD_S: Final = 1.5
"""Time after which the status of a process that has ended is not waited for, s."""
_PR_SET_PDEATHSIG: Final = 1


class _Program(process.BaseProcess):
    """A program as it goes to the fork server, by pickle; `_bootstrap` runs in the forked process."""

    def __init__(
        self, server: int | None, module: str, arguments: Sequence[str], yields: int, for_many: bool
    ) -> None:
        self.server, self.module, self.arguments = server, module, list(arguments)
        self.yields, self.for_many = yields, for_many

    def _bootstrap(self, parent_sentinel: int | None = None) -> int:
        """Run the program; return its exit status."""
        status = 1
        try:
            started = self._become()
            os.write(started, b".")
            program: Any = import_module(f"{self.module}.__main__")
            sys.argv = [str(program.__file__), *self.arguments]
            status = program.main(self.arguments)
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
            if isinstance(ended.code, str):
                print(ended.code, file=sys.stderr)
        except BaseException:
            sys.excepthook(*sys.exc_info())
        # The end of an interpreter, but for taking everything apart, which would copy all shared pages.
        for thread in threading.enumerate():
            if thread is not threading.main_thread() and not thread.daemon:
                thread.join()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        return status

    def _become(self) -> int:
        """Leave nothing of the server's, and end with it. Return the pipe that tells that it has started."""
        log, started = forkserver.get_inherited_fds() or (2, 2)
        os.setpgid(0, 0)
        end_with(self.server)
        # Only its starter keeps the server alive.
        os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore[attr-defined]
        os.close(resource_tracker._resource_tracker._fd)  # type: ignore[attr-defined]
        with open(os.devnull, "rb") as null:
            for handle, standard in ((null.fileno(), 0), (log, 1), (log, 2)):
                os.dup2(handle, standard)
        os.close(log)
        attributes.show(words_of(self.module, self.arguments))
        if self.yields:
            attributes.yield_at_start()
            if self.for_many:
                attributes.interrupt()
            else:
                preloaded.on_start(partial(attributes.yield_once_started, self.yields))
        preloaded.on_start(partial(os.close, started))
        invalidate_caches()  # of folders as they were
        if random := sys.modules.get("numpy.random"):  # Python's own seeds itself
            random.seed()
        gc.enable()
        return started


def end_with(parent: int | None) -> None:
    """Have the kernel send SIGTERM when the parent ends; end here if it is gone already."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


class _Server(forkserver.ForkServer):
    """The standard library's fork server, which is not started again when it is gone."""

    _forkserver_pid: int | None

    def ensure_running(self) -> None:
        if self._forkserver_pid is None:
            super().ensure_running()


class ForkServer(Closing):
    """A fork server of this process's own. A context manager: at its end the server ends, and with it all
    that it has forked.

    Args:
        environment: of all that it forks.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = dict(environment) | {"PYTHONSAFEPATH": "1"}
        self._server: Any = _Server()
        # The second one is no module: it makes the command line long enough for those of programs.
        self._server.set_forkserver_preload([PRELOADING, "x" * ROOM])
        self._yields = 0
        self._starting: dict[int, float] = {}
        """Pipes that processes close when they have started, and the time until which that is waited for."""
        self._is_ready = False
        self._is_closed = not hasattr(os, "pidfd_open")

    @property
    def pid(self) -> int | None:
        """The server's; None where there is none."""
        pid: int | None = self._server._forkserver_pid
        return pid

    def close(self) -> None:
        """End the server; safe to call twice."""
        self._is_closed = True
        if self.pid is not None:
            if not self._is_ready:  # it may be loading still, and has forked nothing
                os.kill(self.pid, signal.SIGKILL)
            with suppress(OSError):
                self._server._stop()
        for pipe in self._starting:
            os.close(pipe)
        self._starting.clear()

    def preload(self, fleet_file: Path) -> None:
        """Start the server, which reads a fleet file for all processes."""
        self._run(str(fleet_file))

    def yields(self, niceness: int) -> None:
        """Have all later processes share processors as many robots do (`deploy.processes.attributes`)."""
        self._yields = niceness

    def start(
        self, module: str, arguments: Sequence[str], log: int, *, for_many: bool = False
    ) -> ForkedProcess | None:
        """Start ``python -P -m MODULE ARGUMENTS`` in a process group of its own; None where it cannot be
        forked.

        Args:
            log: where its output goes, an open file.
            for_many: robots wait for it, so it goes first where others yield.

        Raises:
            OSError: the system has no room for another process, or the server is stuck.
        """
        is_known = module in MODULES and attributes.room(words_of(module, arguments)) <= ROOM
        if self._is_closed or not is_known:
            return None
        self._wait_for_room()
        self._run()
        program = _Program(self.pid, module, arguments, self._yields, for_many)
        starting, has_started = os.pipe()
        try:
            found = self._fork(program, [log, has_started])
        finally:
            os.close(has_started)
            self._starting[starting] = time.monotonic() + START_S
        if found is not None and _readable(starting, ANSWER_S):
            os.read(starting, 1)  # as after the start of a program, its command line can be seen now
        return found

    def _fork(self, program: _Program, handles: list[int]) -> ForkedProcess | None:
        request = io.BytesIO()
        reduction.dump({"name": program.module, "dir": os.getcwd()}, request)
        reduction.dump(program, request)
        try:
            answers, data = self._server.connect_to_new_process(handles)
        except ConnectionError:  # the server is gone
            self.close()
            return None
        with suppress(BrokenPipeError), open(data, "wb") as stream:
            stream.write(request.getbuffer())
        try:
            if not _readable(answers, ANSWER_S):
                if not self._is_ready:
                    raise EOFError
                self._is_ready = False
                raise TimeoutError(ETIMEDOUT, f"the process that forks others ({self.pid}) does not answer")
            pid = forkserver.read_signed(answers)
        except EOFError:
            os.close(answers)
            self.close()
            return None
        self._is_ready = True
        return ForkedProcess(pid, answers)

    def _wait_for_room(self) -> None:
        """Wait until another process may start."""
        left_s = 0.0
        while self._starting:
            ready, _, _ = select.select([*self._starting], [], [], left_s)
            now = time.monotonic()
            for pipe in [pipe for pipe, until in self._starting.items() if pipe in ready or now >= until]:
                del self._starting[pipe]
                os.close(pipe)
            if len(self._starting) < STARTING_MAX:
                return
            left_s = max(0.0, min(self._starting.values()) - now)

    def _run(self, fleet_file: str = "") -> None:
        """Start the server unless it runs."""
        if self.pid is None and not self._is_closed:
            with _environment(self._environment | {PRELOAD: f"{os.getpid()} {fleet_file}"}):
                self._server.ensure_running()


class ForkedProcess:
    """A forked process: what is needed of `subprocess.Popen`.

    Signals go by a handle (pidfd_open(2)), never to another process that has got its number since.

    Args:
        answers: pipe on which the server tells its status.
    """

    def __init__(self, pid: int, answers: int) -> None:
        self.pid: Final = pid
        self.returncode: int | None = None
        self._answers = answers
        self._handle: int | None = None
        """None once it has ended: the server may have taken its status already."""
        with suppress(ProcessLookupError):
            self._handle = os.pidfd_open(pid)
        self._ended_s: float | None = None

    def __del__(self) -> None:
        self._close()

    def poll(self) -> int | None:
        """Its exit status, None while it runs."""
        if self.returncode is None and self._has_ended(0.0):
            self._ended_s = self._ended_s or time.monotonic()
            if _readable(self._answers, 0.0):
                try:
                    self.returncode = forkserver.read_signed(self._answers)
                except EOFError:
                    self.returncode = UNSEEN
            elif time.monotonic() - self._ended_s > UNTOLD_S:
                self.returncode = UNSEEN
            if self.returncode is not None:
                self._close()
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit status.

        Raises:
            subprocess.TimeoutExpired: it runs still.
        """
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            if self._has_ended(left_s):
                _readable(self._answers, min(left_s, UNTOLD_S / 10))
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None and self._handle is not None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._handle, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _has_ended(self, timeout_s: float) -> bool:
        return self._handle is None or _readable(self._handle, timeout_s)

    def _close(self) -> None:
        if self._answers >= 0:
            os.close(self._answers)
        if self._handle is not None:
            os.close(self._handle)
        self._answers, self._handle = -1, None


@contextmanager
def _environment(wanted: Mapping[str, str]) -> Iterator[None]:
    """Meanwhile this process has another environment, which processes that it starts take over."""
    before = dict(os.environ)
    os.environ.update(wanted)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _readable(handle: int, timeout_s: float) -> bool:
    return bool(select.select([handle], [], [], timeout_s)[0])
