"""Starts processes by having them forked from one that has loaded what they need
(`deploy.processes.fork_server`)."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from errno import ETIMEDOUT
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from handfast.deploy.processes import command_line
from handfast.deploy.processes.command_line import ROOM, words_of

MESSAGE_MAX: Final = 1 << 17
SERVER: Final = "handfast.deploy.processes.fork_server"
UNSEEN: Final = 1 << 16
"""Exit status of a process that has ended after the server, so that nobody saw how."""
END_TIMEOUT_S: Final = 5.0
UNTOLD_S: Final = 1.5
"""A process that has ended and of which the server has not said how for so long ended unseen: it stands."""
ANSWER_S: Final = 20.0
"""A server that has answered nothing for so long stands: forking takes it some ms, loading some tenths of a
second, and tenfold where hundreds of processes start."""


class ForkServer:
    """A fork server of this process's own. A context manager: at its end the server ends, and with it what
    it has forked.

    It is started as any other program is, so it does not matter which threads this process has.

    Args:
        environment: its own, and so that of all that it forks.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._is_ready = False
        self._count = 0
        self._ended: dict[int, int] = {}
        self._owes_since: float | None = None
        """Since when it has told nothing, though something has ended."""
        if not hasattr(os, "pidfd_open"):
            return  # a system where nothing is forked
        self._socket, asked = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with asked:
            self._process = subprocess.Popen(
                words_of(SERVER, [str(os.getpid()), "." * ROOM]),
                stdin=asked.fileno(),
                # What keeps it from loading them keeps processes from it too: they say it in their logs.
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=dict(environment),
                process_group=0,
            )

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """The server's; None where there is none."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """Ends the server; safe to call twice."""
        self._is_gone()
        if self._process is not None:
            if not self._is_ready or self.stands:  # it may be loading still, and has forked nothing
                self._process.kill()
            try:
                self._process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def preload(self, fleet_file: Path) -> None:
        """Has a fleet file read now, for all processes that will be forked."""
        if self._can_be_asked():
            self._ask({"fleet": str(fleet_file)})

    def yields(self, niceness: int) -> None:
        """Has all that it will fork share processors as many robots do (`deploy.processes.scheduling`)."""
        if self._can_be_asked():
            self._ask({"yields": niceness})

    def start(
        self, module: str, arguments: Sequence[str], log: int, *, for_many: bool = False
    ) -> ForkedProcess | None:
        """A process that is as ``python -P -m MODULE ARGUMENTS``, in a process group of its own; None where
        it cannot be had.

        Args:
            log: where its output goes, an open file.
            for_many: robots wait for it: it leaves them no more once it has started than before (`yields`).

        Raises:
            OSError: the system has no room for another process, or the server stands.
        """
        if command_line.room(words_of(module, arguments)) > ROOM or not self._can_be_asked():
            return None
        self._count += 1
        what = {"module": module, "arguments": list(arguments), "for_many": for_many}
        self._ask({"number": self._count, **what}, [log])
        while (answer := self._next(ANSWER_S)) is not None:
            message, handles = answer
            if "errno" in message:
                raise OSError(message["errno"], os.strerror(message["errno"]))
            if "pid" in message:
                if not handles:  # it is no program that it knows
                    return None
                return ForkedProcess(self, message["number"], message["pid"], handles[0])
        if self._socket is not None:  # nor may another start it: it would be there twice, once this goes on
            raise TimeoutError(ETIMEDOUT, f"the process that forks others ({self.pid}) does not answer")
        return None

    @property
    def stands(self) -> bool:
        """Whether something has ended long ago of which it has not told how."""
        return self._owes_since is not None and time.monotonic() - self._owes_since > UNTOLD_S

    def owes(self) -> None:
        """It has not told yet how a process ended that has."""
        if self._owes_since is None:
            self._owes_since = time.monotonic()

    def status(self, number: int) -> int | None:
        """The exit status of one of its processes, once; None while it is not known."""
        while self._socket is not None and self._next(0.0) is not None:
            pass
        return self._ended.pop(number, None)

    @property
    def news(self) -> socket.socket | None:
        """What can be read when a process has ended; None when the server is gone."""
        return self._socket

    def _can_be_asked(self) -> bool:
        """Waits until the server has loaded everything, the first time. One that does not is ended: nothing
        has been forked by it."""
        while self._socket is not None and not self._is_ready:
            if self._next(ANSWER_S) is None:
                self.close()
        return self._socket is not None

    def _is_gone(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _ask(self, request: object, handles: Sequence[int] = ()) -> None:
        if self._socket is not None:
            with suppress(OSError):  # its end is found where it should answer
                socket.send_fds(self._socket, [json.dumps(request).encode()], handles)

    def _next(self, timeout_s: float) -> tuple[dict[str, Any], list[int]] | None:
        """The server's next message, with what it handed over; None when there is none, or no server."""
        if self._socket is None or not select.select([self._socket], [], [], timeout_s)[0]:
            return None
        try:
            data, handles, _, _ = socket.recv_fds(self._socket, MESSAGE_MAX, 1)
        except OSError:
            data, handles = b"", []
        if not data:
            self._is_gone()
            return None
        message: dict[str, Any] = json.loads(data)
        self._is_ready, self._owes_since = True, None
        if "ended" in message:
            self._ended[message["ended"]] = message["status"]
        return message, handles


class ForkedProcess:
    """A process that a fork server has forked: what is needed of `subprocess.Popen`.

    Signals go by a handle (pidfd_open(2)), never to another process that has got its number since.

    Args:
        number: by which the server tells of it.
        handle: belongs to this from now on.
    """

    def __init__(self, server: ForkServer, number: int, pid: int, handle: int) -> None:
        self.pid: Final = pid
        self.returncode: int | None = None
        self._server, self._number, self._handle = server, number, handle

    def __del__(self) -> None:
        self._forget()

    def poll(self) -> int | None:
        """Its exit status, None while it runs."""
        if self.returncode is None:
            server = self._server
            self.returncode = server.status(self._number)
            if self.returncode is None and _readable(self._handle, 0.0):
                server.owes()
                if server.news is None or server.stands:
                    self.returncode = UNSEEN
            if self.returncode is not None:
                self._forget()
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit status.

        Raises:
            subprocess.TimeoutExpired: it runs still.
        """
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            news = self._server.news
            if news is None or not _readable(self._handle, 0.0):
                waited: list[int | socket.socket] = [self._handle]
                select.select(waited if news is None else [*waited, news], [], [], left)
            else:
                _readable(news, min(left, UNTOLD_S / 10))
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._handle, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _forget(self) -> None:
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def _readable(what: int | socket.socket, timeout_s: float) -> bool:
    return bool(select.select([what], [], [], timeout_s)[0])
