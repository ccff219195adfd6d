"""``python -m handfast.deploy.processes.fork_server PARENT``: has loaded what robots' processes need, and
forks them.

An interpreter that starts and imports all of it costs half a second of processor time for each process, and
memory of its own; one that is forked has both from here. Asked for is over the socket that is its standard
input (`deploy.processes.forking`): one message each way for each process, and one more when that has ended.

It has one thread and never opens Zenoh: a fork has one thread, and what others held it holds for good. It
ends when the other end of its socket is gone, and those that it forked end with it.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from handfast.agent.common.errors import Error
from handfast.agent.fleet.plants import DEFAULT, KINDS
from handfast.agent.messages import codec
from handfast.agent.runtime import preloaded
from handfast.deploy.processes import command_line, scheduling
from handfast.deploy.processes.command_line import ROOM, words_of
from handfast.deploy.processes.forking import MESSAGE_MAX, SERVER

MODULES: Final = frozenset(
    (
        "handfast.agent",
        *filter(None, (module for kind in KINDS.values() for module in (kind.program, kind.simulator))),
    )
)
"""Programs that can be forked: each has a `main(argv)` in its `__main__`."""
PRELOADED: Final = "handfast.agent", KINDS[DEFAULT].program
"""Those that every fleet has; others are imported when they are asked for."""
STARTING_MAX: Final = 2 + (os.cpu_count() or 1)
"""So many processes are forked and not yet on the bus: more would only take each other's time, and robots
that come later in the file connect to those before them, who should be there by then."""
START_S: Final = 0.3
"""Who takes longer waits for something else than processor time, and no other process waits for it."""
LOOK_S: Final = 0.25
"""How often who started this process is looked for."""
_PR_SET_PDEATHSIG: Final = 1


class Forked(NamedTuple):
    """What a process that has just been forked is to be."""

    module: str
    arguments: list[str]

    def run(self) -> int:
        """Runs the program; returns its exit status."""
        program = _program(self.module)
        sys.argv = [str(program.__file__), *self.arguments]
        status: int = program.main(self.arguments)
        return status


def _program(module: str) -> Any:
    return importlib.import_module(f"{module}.__main__")


class Server:
    """Forks processes for `parent`, the process at the other end of `asked`, and tells how they end."""

    def __init__(self, asked: socket.socket, parent: int) -> None:
        self._asked, self._parent = asked, parent
        self._pid = os.getpid()
        self._numbers: dict[int, int] = {}
        """Who asked for a process gave it a number: those of the system are given again."""
        self._yields = 0
        """How much nicer what it forks is than others, once it has started."""
        self._starting: dict[int, float] = {}
        """Pipes whose other end a process closes when it has started, and until when that is waited for."""
        self._null = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
        # An end of a process wakes `select`: the handler has nothing to do but to be there.
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)

    def serve(self) -> Forked | None:
        """Until nobody asks any more: None. In every process that it forks: what that is to be."""
        self._say({"ready": os.getpid()})
        while True:
            full = len(self._starting) >= STARTING_MAX
            asked = [] if full else [self._asked.fileno()]
            left_s = min(self._starting.values()) - time.monotonic() if full else LOOK_S
            waits = [*asked, self._woken, *self._starting]
            ready, _, _ = select.select(waits, [], [], min(max(0.0, left_s), LOOK_S))
            if os.getppid() != self._parent:
                return None  # whoever else holds the other end of the socket does not use it
            now = time.monotonic()
            for pipe in [pipe for pipe, until in self._starting.items() if pipe in ready or now >= until]:
                del self._starting[pipe]
                os.close(pipe)
            if self._woken in ready:
                self._bury()
            if self._asked.fileno() in ready:
                message, handles, _, _ = socket.recv_fds(self._asked, MESSAGE_MAX, 1)
                if not message:
                    return None
                forked = self._answer(json.loads(message), handles)
                if forked is not None:
                    return forked

    def _bury(self) -> None:
        try:
            while os.read(self._woken, 4096):
                pass
        except BlockingIOError:
            pass
        while self._numbers:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            self._say({"ended": self._numbers.pop(pid), "status": os.waitstatus_to_exitcode(status)})

    def _answer(self, request: Any, handles: Sequence[int]) -> Forked | None:
        if "fleet" in request:
            with suppress(Error):  # whoever needs it says so
                preloaded.preload(request["fleet"])
            self._settle()
            return None
        if "yields" in request:
            scheduling.yield_at_start()
            self._yields = request["yields"]
            return None
        (log,) = handles
        forked = Forked(request["module"], request["arguments"])
        if forked.module not in MODULES:
            os.close(log)
            self._say({"pid": None})
            return None
        if f"{forked.module}.__main__" not in sys.modules:
            _program(forked.module)
            self._settle()
        starting, has_started = os.pipe()
        try:
            pid = os.fork()
        except OSError as error:
            self._say({"errno": error.errno})
            for each in (log, starting, has_started):
                os.close(each)
            return None
        if pid == 0:
            os.close(starting)
            preloaded.on_start(partial(os.close, has_started))
            if self._yields and request["for_many"]:
                scheduling.interrupt()
            elif self._yields:
                preloaded.on_start(partial(scheduling.yield_once_started, self._yields))
            self._become(forked, log)
            os.write(has_started, b".")
            return forked
        os.close(log)
        os.close(has_started)
        os.read(
            starting, 1
        )  # until it is what it is to be, as who starts a program waits: it is seen at once
        self._starting[starting] = time.monotonic() + START_S
        self._numbers[pid] = request["number"]
        handle = os.pidfd_open(pid)  # its number is nobody else's before it is buried
        self._say({"number": request["number"], "pid": pid}, [handle])
        os.close(handle)
        return None

    @staticmethod
    def _settle() -> None:
        """What is there now is there for good: neither this process nor those that it forks look for garbage
        in it, which would copy every page of it."""
        gc.collect()
        gc.freeze()

    def _become(self, forked: Forked, log: int) -> None:
        """In the process that was forked: leaves nothing that was the server's."""
        os.setpgid(0, 0)
        _end_with_parent(self._pid)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for handle, standard in ((self._null, 0), (log, 1), (log, 2)):
            os.dup2(handle, standard)
        self._asked.detach()  # it was standard input
        for handle in (self._null, self._woken, self._wake, log, *self._starting):
            os.close(handle)
        command_line.show(words_of(forked.module, forked.arguments))
        importlib.invalidate_caches()  # of folders as they were
        random = sys.modules.get("numpy.random")
        if random is not None:  # Python's own seeds itself
            random.seed()
        gc.enable()

    def _say(self, message: object, handles: Sequence[int] = ()) -> None:
        socket.send_fds(self._asked, [json.dumps(message).encode()], handles)


def _end_with_parent(parent: int) -> None:
    """Has the kernel send SIGTERM when `parent` ends: `Shutdown` looks for it too, but only once it runs."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


def can_fork() -> bool:
    """Whether this process is as it has to be: it has one thread, and its command line can be written."""
    return command_line.area()[1] >= ROOM and len(os.listdir("/proc/self/task")) == 1


def leave(run: Callable[[], int]) -> None:
    """Ends the process with the status of `run`, after what the interpreter does at its end but for taking
    everything apart, which copies all pages that it shares."""
    status = 1
    try:
        status = run()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    try:
        for thread in threading.enumerate():
            if thread is not threading.main_thread() and not thread.daemon:
                thread.join()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    finally:
        os._exit(status)


def main() -> None:
    """Serves until its standard input is closed."""
    if not Path("/proc/self/task").exists():
        return
    command_line.show(words_of(SERVER, []))
    gc.disable()
    for module in PRELOADED:
        _program(module)
    codec.be_ready()
    if not can_fork():
        return
    gc.collect()
    gc.freeze()
    forked = Server(socket.socket(fileno=0), int(sys.argv[1])).serve()
    if forked is None:
        os._exit(0)  # its processes hear of it from the kernel
    leave(forked.run)


if __name__ == "__main__":
    main()
